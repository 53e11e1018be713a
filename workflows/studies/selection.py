"""A study that compares material models: tests with their data, candidates, and the method."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, ValidationError, model_validator

from forward.bodies.geometry import Vector
from forward.materials.admissible import Materials
from forward.materials.material import MATERIALS, constants, incompressible, of_volume
from forward.materials.material_point import HELD, Component, HomogeneousModel, MaterialTest, Mode, named, unfit
from forward.model import Finding, FloatArray, ForwardModel
from forward.registry import KindError
from forward.scalars import Mistake
from forward.settings import Settings, nearest, shown
from inverse.criticism.comparison import Candidate, Data
from inverse.criticism.weights import resampled
from inverse.data.observations import DataError, Table, read_table
from inverse.low_dimensional.posterior import NOISE
from inverse.methods.selection import Select
from uq.inputs.distributions import Distribution
from uq.inputs.random_parameters import Inputs
from workflows.config.blocks import Correlation, Parallel
from workflows.config.mistakes import StudyError, lines, refused
from workflows.config.priors import findings_of_materials, mistakes_of_factor, mistakes_of_materials
from workflows.config.report import Report
from workflows.studies.study import StudyKind

if TYPE_CHECKING:
    import xarray as xr

    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from workflows.studies.job import Job

COMPONENTS: tuple[Component, ...] = ("P1", "P2", "P1-P2")
MODES: tuple[Mode, ...] = ("uniaxial", "equibiaxial", "biaxial", "pure-shear", "simple-shear")
SECONDS_PER_STRESS = 4e-4  # of a material point with its derivatives
DRAWS = 1000  # of the constants, that are left for ArviZ
WHOLE = "all"  # name of the group where there is one


class MeasuredTest(MaterialTest):
    """A test with what was measured.

    Parameters
    ----------
    measured
        Stresses (Pa) at each stretch or amount of shear.
    sigma
        Standard deviations (Pa) of their errors, where they are known.
    group
        Specimen, region, …: each group has constants of its own.
    """

    measured: tuple[float, ...]
    sigma: tuple[Annotated[float, Field(gt=0)], ...] | None = None
    group: str = WHOLE

    @model_validator(mode="after")
    def _check_sizes(self) -> MeasuredTest:
        for name, values in (("measured", self.measured), ("sigma", self.sigma)):
            if values is not None and len(values) != len(self.at):
                message = f"{name}: {len(values)} values, expected as many as in at: {len(self.at)}"
                raise ValueError(message)
        return self


LARGEST_STRETCH = 20.0  # beyond, a column holds per cent or lengths


class DataFile(Settings):
    """Tests in a table of comma-separated values; lines that begin with # say where they are from.

    Parameters
    ----------
    file
        The table, beside the study.
    mode, at, across, measured, sigma, group
        Names of the columns: kind of test, stretch or amount of shear, second stretch (of biaxial tests), stress and,
        if there are any, its standard deviation and the group. Where rows hold both stresses, or their difference,
        `measured` (and `sigma`) name a column for each: ``{ P1 = "force_x", P2 = "force_y" }``; empty cells are left
        out. Each stress is a test of its own: "biaxial", "biaxial P2", "biaxial P1-P2".
    component
        Column that says which stress a row holds, where there is one in each: P1, P2 or P1-P2.
    modes
        What the words of the column of modes mean, where they are not modes themselves.
    unit
        Pa in the unit of stresses.
    stress
        "nominal" or "cauchy".
    where
        Rows that are kept: by column, the word that stands there.
    between
        Smallest and largest stretch or amount of shear that are kept.
    """

    file: str
    mode: str = "mode"
    at: str = "stretch"
    across: str | None = None
    measured: str | dict[Component, str] = "stress"
    sigma: str | dict[Component, str] | None = None
    component: str | None = None
    group: str | None = None
    modes: dict[str, Mode] = Field(default={})
    unit: Annotated[float, Field(gt=0)] = 1.0
    stress: Literal["nominal", "cauchy"] = "nominal"
    where: dict[str, str] = Field(default={})
    between: tuple[float, float] | None = None

    def read(self, folder: Path) -> dict[str, Any]:
        """Return the block `data` with the tests themselves.

        Raises
        ------
        StudyError
            If the table cannot be read, lacks a column, or holds what is no number.
        """
        path = folder / self.file
        try:
            table = read_table(path)
        except DataError as error:
            raise StudyError(*(f"data.file: {line}" for line in error.args)) from None
        stresses = self.stresses
        columns = [self.mode, self.at, self.across, self.component, self.group, *self.where]
        columns += [column for pair in stresses.values() for column in pair]
        for column in columns:
            if column is not None and column not in table.columns:
                message = f"data: {path} has no column '{column}'; {nearest(column, table.columns)}"
                raise StudyError(message)
        tests: dict[tuple[str, str, Component], dict[str, list[float]]] = {}
        _refuse_repeats(table, path)
        for line, row in zip(table.lines, table.rows, strict=True):
            if any(row[column] != word for column, word in self.where.items()):
                continue
            word = row[self.mode]
            mode = self.modes.get(word, word)
            sheared = mode == "simple-shear"
            place = f"{path}, line {line}"
            at = _stretch(row[self.at], f"{place}, {self.at}", positive=not sheared)
            if self.between is not None and not self.between[0] <= at <= self.between[1]:
                continue
            if mode not in MODES:
                message = f"data: {place}: unknown mode '{word}'; {nearest(word, (*MODES, *self.modes))}"
                raise StudyError(message)
            across = None
            if self.across is not None and mode == "biaxial":
                across = _stretch(row[self.across], f"{place}, {self.across}", positive=True)
            held = mode in HELD
            for component, (measured, sigma) in self._in_row(row, place, held=held).items():
                test = tests.setdefault((row[self.group] if self.group else WHOLE, word, component), {})
                test.setdefault("at", []).append(at)
                if across is not None:
                    test.setdefault("across", []).append(across)
                value = _number(row[measured], f"{place}, {measured}")
                test.setdefault("measured", []).append(self.unit * value)
                if sigma is not None:
                    width = _number(row[sigma], f"{place}, {sigma}", positive=True)
                    test.setdefault("sigma", []).append(self.unit * width)
        if not tests:
            message = f"data: {path}: no row is left; data.where and data.between say which ones are kept"
            raise StudyError(message)
        return {
            "source": list(table.remarks),
            "tests": [
                {
                    "mode": self.modes.get(word, word),
                    "name": named(word, component),
                    "group": group,
                    "stress": self.stress,
                    "component": component,
                    **columns,
                }
                for (group, word, component), columns in tests.items()
            ],
        }

    @property
    def stresses(self) -> dict[Component, tuple[str, str | None]]:
        """Columns of each stress and of its standard deviation."""
        measured: dict[Component, str] = {"P1": self.measured} if isinstance(self.measured, str) else self.measured
        sigma = self.sigma if isinstance(self.sigma, dict) else dict.fromkeys(measured, self.sigma)
        return {component: (column, sigma.get(component)) for component, column in measured.items()}

    def _in_row(self, row: Mapping[str, str], place: str, *, held: bool) -> dict[Component, tuple[str, str | None]]:
        """Columns of the stresses that a row holds; where something acts across, there may be two."""
        stresses = self.stresses
        if self.component is not None:
            word = row[self.component] or "P1"
            component = next((name for name in COMPONENTS if name == word), None)
            if component is None:
                message = f"data: {place}, {self.component}: '{word}'; {nearest(word, COMPONENTS)}"
                raise StudyError(message)
            return {component: next(iter(stresses.values()))}
        found = {c: pair for c, pair in stresses.items() if len(stresses) == 1 or row[pair[0]].strip()}
        strange = next((pair[0] for c, pair in found.items() if c != "P1" and not held), None)
        if strange is not None:
            message = f"data: {place}, {strange}: a stress across, expected an empty cell: nothing acts across there"
            raise StudyError(message)
        if not found:
            message = f"data: {place}: no stress, expected one in {' or '.join(c for c, _ in stresses.values())}"
            raise StudyError(message)
        return found

    @model_validator(mode="after")
    def _check_stresses(self) -> DataFile:
        stresses = self.stresses
        if not stresses:
            message = "measured: no column, expected one for each stress: { P1 = ..., P2 = ... }"
            raise ValueError(message)
        if self.component is not None and len(stresses) > 1:
            message = "component: stands beside several columns of stresses, expected one column of them"
            raise ValueError(message)
        lacking = [c for c, (_, sigma) in stresses.items() if sigma is None]
        if self.sigma is not None and lacking:
            message = f"sigma: no column for {', '.join(lacking)}, expected one for each stress"
            raise ValueError(message)
        return self


class Measurements(Settings):
    """What was measured.

    Parameters
    ----------
    tests
        Material tests with their data.
    source
        Where they are from, line by line.
    """

    tests: tuple[MeasuredTest, ...] = Field(min_length=1)
    source: tuple[str, ...] = ()

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the groups."""
        return tuple(dict.fromkeys(test.group for test in self.tests))


class CandidateModel(Settings):
    """A material that may be the right one, with its prior.

    Parameters
    ----------
    material
        Its kind, and the constants that do not vary; without those of the volume (D1) an energy is
        incompressible. Fibres, where it has them, by their components along the first stretch, along the second one and
        across both.
    parameters
        Priors of the constants that do.
    correlations
        Correlations between them.
    weight
        Its probability before the data, up to a common factor.
    """

    material: dict[str, float | str | tuple[Vector, ...]]
    parameters: dict[str, Distribution] = Field(min_length=1)
    correlations: tuple[Correlation, ...] = ()
    weight: Annotated[float, Field(gt=0)] = 1.0

    @property
    def kind(self) -> str:
        """Kind of the material."""
        return str(self.material["kind"])

    @property
    def inputs(self) -> Inputs:
        """The random constants."""
        pairs = tuple((*c.between, c.value) for c in self.correlations)
        return Inputs(self.parameters, pairs, self.materials)

    @property
    def materials(self) -> Materials:
        """The material as a function of the random constants."""
        return Materials(self.kind, {"material": {**self.fixed, **{name: name for name in self.parameters}}})

    @property
    def fixed(self) -> dict[str, float]:
        """Constants that do not vary."""
        return {name: value for name, value in self.material.items() if isinstance(value, float)}

    @property
    def fibres(self) -> tuple[Vector, ...]:
        """Directions of the families of fibres."""
        return tuple(self.material.get("fibres", ()))  # type: ignore[arg-type]

    @model_validator(mode="after")
    def _check(self) -> CandidateModel:
        kind = self.material.get("kind")
        if kind is None:
            message = "material.kind: missing"
            raise ValueError(message)
        try:
            MATERIALS[str(kind)]
        except KindError as error:
            message = f"material.kind: {shown(kind)}; {str(error).removeprefix('unknown kind; ')}"
            raise ValueError(message) from None
        numbers = {name for name, value in self.material.items() if isinstance(value, float)}
        words = [name for name in self.material if name not in {"kind", "fibres", *numbers}]
        if words:
            message = f"material.{words[0]}: {shown(self.material[words[0]])}, expected a number"
            raise ValueError(message)
        known = constants(self.kind)
        given = dict.fromkeys([*self.fixed, *self.parameters])
        for name in given:
            if name not in known:
                message = f"'{name}' is no constant of '{kind}'; {nearest(name, tuple(known))}"
                raise ValueError(message)
            if name in self.fixed and name in self.parameters:
                message = f"'{name}' stands in material and in parameters, expected one of them"
                raise ValueError(message)
        left_out = of_volume(self.kind) if incompressible(self.kind, given) else ()
        missing = [name for name in known if name not in given and name not in left_out]
        if missing:
            message = f"missing: {', '.join(missing)}, expected in material or parameters"
            raise ValueError(message)
        try:
            wrong = next(mistakes_of_materials(self.inputs, self.materials), None)
        except ValueError:  # correlations, which are told elsewhere
            return self
        if wrong is not None:
            message = f"parameters {', '.join(wrong[2])}: {wrong[1]}"
            raise ValueError(message)
        return self


class Comparison(StudyKind):
    """What studies that compare models have in common: candidates by name, groups of data, the method."""

    stopped: ClassVar[str] = "all evidences found"
    quantity: ClassVar[str]  # what was measured
    costly: ClassVar[bool]  # whether solves are worth a file
    candidates: Mapping[str, Any]
    method: Select
    parallel: Parallel = Parallel()
    report: Report | None = None

    @property
    def source(self) -> tuple[str, ...]:
        """Where the data are from, line by line."""
        raise NotImplementedError

    @property
    def seconds_of_solves(self) -> float:
        """Processor time of all solves and their derivatives, roughly."""
        raise NotImplementedError

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What is to be said of the study before anything is solved."""
        of_all = (findings_of_materials(one.inputs, f"{name}: ") for name, one in self.models.items())
        return tuple(finding for found in of_all for finding in found)

    @property
    def unchecked(self) -> dict[str, str]:
        """Why each candidate is not looked at on a finer mesh, empty where it is; none where there are no meshes."""
        return {}

    def described(self, name: str) -> str:
        """What a candidate is, in words."""
        raise NotImplementedError

    def build(self, name: str, group: str, comm: Any = None) -> ForwardModel:
        """Make the model of a candidate in a group on a communicator; collective."""
        raise NotImplementedError

    def build_finer(self, name: str, make: Callable[[], ForwardModel], comm: Any = None) -> ForwardModel:
        """Make what a candidate's model is on a finer mesh, where it is looked at (see `unchecked`); collective.

        Parameters
        ----------
        name
            Of the candidate.
        make
            Makes its model, or returns the one that was made before.
        comm
            As of `build`.
        """
        from workflows.studies.finer import once_on_finer_mesh

        return once_on_finer_mesh(make)

    @property
    def group_names(self) -> tuple[str, ...]:
        """Names of the groups."""
        raise NotImplementedError

    @property
    def groups(self) -> dict[str, Data]:
        """Data by group."""
        raise NotImplementedError

    def tests(self, group: str) -> tuple[str, ...]:
        """Names of the tests that were measured in a group."""
        raise NotImplementedError

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Candidates and groups, in the order of the models."""
        return [(name, group) for name in self.candidates for group in self.group_names]

    @property
    def models(self) -> dict[str, Candidate]:
        """The candidates as the method wants them."""
        return {name: Candidate(candidate.inputs, candidate.weight) for name, candidate in self.candidates.items()}

    @property
    def planned(self) -> int:
        """Number of solves, roughly: the searches for the modes take as many as they take."""
        searches = sum(self.searches(name) for name, _ in self.pairs)
        return (self.method.samples * len(self.pairs) + searches) * self.evidences // len(self.pairs)

    def searches(self, name: str) -> int:
        """Number of solves that the searches for the mode of a candidate take, roughly."""
        return 10 * self.method.starts + 2 * len(self.candidates[name].parameters)

    @property
    def evidences(self) -> int:
        """Number of evidences that are found."""
        counts = [len(self.tests(group)) for group in self.group_names]
        held_out = sum(count for count in counts if count > 1) if self.method.held_out else 0
        return len(self.pairs) * self.method.variants + len(self.candidates) * held_out

    @classmethod
    def made(cls, blocks: Mapping[str, Any], folder: Path) -> Comparison:
        """Check the blocks of a comparison on a specimen, on another model, or without one on material points."""
        model = blocks.get("model")
        body = isinstance(model, Mapping) and "outputs" in model and "cases" not in model
        if isinstance(model, Mapping) and model.get("kind", "hyperelastic" if body else "specimen") != "specimen":
            from workflows.studies import output_selection

            return output_selection.OutputSelection.model_validate(output_selection.expanded(blocks, folder))
        if "model" in blocks:
            from workflows.studies import specimen_selection

            return specimen_selection.SpecimenSelection.model_validate(specimen_selection.expanded(blocks, folder))
        return Selection.model_validate(expanded(blocks, folder))

    def plan(self, groups: int) -> list[str]:
        """Say what is compared, and how long that will take."""
        from workflows.studies.selection_plan import plan

        return plan(self)

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> Job:
        """Make the candidates, each for each group of data; collective."""
        from workflows.studies.selection_job import job

        return job(self, ensemble)

    def parameters_of(self, label: str) -> tuple[str, ...]:
        """Names of the parameters of a candidate."""
        return tuple(self.candidates[label.partition("/")[0]].parameters)

    def mistakes_of_method(self) -> Iterator[Mistake]:
        """Find what does not fit the candidates and the data."""
        if self.method.check is not None and find_spec(self.method.check) is None:
            message = f"needs {self.method.check}, which is not installed: pip install {self.method.check}"
            yield ("method", "check"), message, self.method.check
        known = tuple(dict.fromkeys(test for group in self.group_names for test in self.tests(group)))
        for name, tests in self.method.subsets.items():
            for test in tests:
                if test not in known:
                    yield ("method", "subsets", name), f"no test has this name; {nearest(test, known)}", test
        for name, candidate in self.candidates.items():
            try:
                candidate.inputs  # noqa: B018 - checks the correlations
            except ValueError as error:
                yield ("candidates", name, "correlations"), str(error), name
        for place, noise in (
            (("noise",), self.method.noise),
            *((("other_noises", n), v) for n, v in self.method.other_noises.items()),
        ):
            yield from mistakes_of_factor(noise.factor, "method", *place, "factor")
            for data in self.groups.values():
                try:
                    noise.sigma(data.values, data.sigma)
                except ValueError as error:
                    yield ("method", *place), str(error), noise.model_dump(exclude_none=True)
                    break


class Selection(Comparison):
    """What to compare.

    Parameters
    ----------
    data
        Tests and what was measured.
    candidates
        Models by name.
    predict
        Tests that are predicted beside those that were measured, in every group.
    method
        How the candidates are compared.
    parallel
        Use of ranks.
    report
        Sections of one's own in the report.
    """

    data: Measurements
    candidates: dict[str, CandidateModel] = Field(min_length=1)
    predict: tuple[MaterialTest, ...] = ()
    method: Select
    parallel: Parallel = Parallel()
    report: Report | None = None

    quantity: ClassVar[str] = "stress"
    costly: ClassVar[bool] = False

    @property
    def source(self) -> tuple[str, ...]:
        """Where the data are from."""
        return self.data.source

    @property
    def group_names(self) -> tuple[str, ...]:
        """Names of the groups."""
        return self.data.groups

    def tests(self, group: str) -> tuple[str, ...]:
        """Names of the tests that were measured in a group."""
        return tuple(test.label for test in self._measured(group))

    @property
    def seconds_of_solves(self) -> float:
        """Processor time of the stresses and their derivatives, roughly."""
        return SECONDS_PER_STRESS * self.planned

    def described(self, name: str) -> str:
        """Material of a candidate."""
        return self.candidates[name].kind

    @property
    def groups(self) -> dict[str, Data]:
        """Data by group."""
        found = {}
        for group in self.data.groups:
            tests = self._measured(group)
            known = all(test.sigma is not None for test in tests)
            labels = [test.label for test in self._tests(group) for _ in test.at]
            places = [(x, z) for test in tests for x, z in zip(test.at, test.across or test.at, strict=True)]
            found[group] = Data(
                np.concatenate([test.measured for test in tests]),
                np.concatenate([test.sigma for test in tests if test.sigma is not None]) if known else None,
                tuple(labels),
                np.concatenate([test.at for test in self._tests(group)]),
                np.array(places),
            )
        return found

    def build(self, name: str, group: str, comm: Any = None) -> HomogeneousModel:
        """Make the model of a candidate in a group."""
        candidate = self.candidates[name]
        names = tuple(candidate.parameters)
        return HomogeneousModel(candidate.kind, candidate.fixed, self._tests(group), names, candidate.fibres)

    @property
    def _all_tests(self) -> tuple[MaterialTest, ...]:
        return (*self.data.tests, *self.predict)

    def _measured(self, group: str) -> list[MeasuredTest]:
        return [test for test in self.data.tests if test.group == group]

    def _tests(self, group: str) -> list[MaterialTest]:
        return [*self._measured(group), *self.predict]

    @model_validator(mode="after")
    def _check(self) -> Selection:
        refused("Selection", list(self._mistakes()))
        return self

    def _mistakes(self) -> Iterator[Mistake]:
        for group in self.data.groups:
            labels = [test.label for test in self._tests(group)]
            twice = next((label for label in labels if labels.count(label) > 1), None)
            if twice is not None:
                yield ("data", "tests"), f"several tests of group '{group}' have this name, expected one", twice
                return
        for name, candidate in self.candidates.items():
            objections = (unfit(candidate.kind, test.mode, candidate.fibres) for test in self._all_tests)
            objection = next(filter(None, objections), None)
            if objection is not None:
                yield ("candidates", name, "material"), objection, candidate.material
        yield from self.mistakes_of_method()


def expanded(document: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return a document whose table of data, if it names one, has been read.

    Raises
    ------
    StudyError
        If that cannot be done.
    """
    data = document.get("data")
    if not isinstance(data, Mapping) or "file" not in data:
        return dict(document)
    try:
        table = DataFile.model_validate(dict(data))
    except ValidationError as error:
        raise StudyError(*lines(error, "data")) from None
    return {**document, "data": table.read(folder)}


def _refuse_repeats(table: Table, path: Path) -> None:
    seen: dict[tuple[str, ...], int] = {}
    for line, row in zip(table.lines, table.rows, strict=True):
        before = seen.setdefault(tuple(row.values()), line)
        if before != line:
            message = f"data: {path}: lines {before} and {line} are the same, expected each measurement once"
            raise StudyError(message)


def _stretch(text: str, place: str, *, positive: bool) -> float:
    value = _number(text, place, positive=positive)
    if abs(value) > LARGEST_STRETCH:
        message = f"data: {place}: {value:g}, expected a stretch (1 is undeformed), or an amount of shear"
        raise StudyError(message)
    return value


def _number(text: str, place: str, *, positive: bool = False) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        message = f"data: {place}: {text!r}, expected a number"
        raise StudyError(message)
    if positive and value <= 0:
        message = f"data: {place}: {value:g}, expected more than 0"
        raise StudyError(message)
    return value


def groups(study: Comparison, found: xr.Dataset) -> dict[str, xr.Dataset]:
    """Return ArviZ's groups: `arviz.from_netcdf("results.nc")`.

    Draws of the constants of every model before and after the data, in each group of data; ln of the density of each
    datum at these draws, one variable for each model; the data.
    """
    import xarray as xr

    drawn, dense, before = dict[str, Any](), dict[str, Any](), dict[str, Any]()
    measured = np.isfinite(found["measured"].to_numpy())
    of_group = found["output_group"].to_numpy()[measured]
    dims = ("chain", "draw", "group")
    for model in map(str, found.model.values):
        one = found.sel(model=model)
        chosen = {
            str(group): resampled(one["point_weight"].sel(group=group).to_numpy(), DRAWS, 0)
            for group in found.group.values
        }
        for parameter in found.parameter.values:
            points = one["point"].sel(parameter=parameter)
            values = np.array([points.sel(group=group).to_numpy()[which] for group, which in chosen.items()])
            if np.isfinite(values).all():
                drawn[f"{model}.{parameter}"] = (dims, values.T[None])
        dense_at = one["point_log_likelihood"].to_numpy()[:, measured]
        columns = [dense_at[chosen[group], j] for j, group in enumerate(of_group)]
        dense[model] = (("chain", "draw", "output"), np.array(columns).T[None])
        before |= {
            f"{model}.{name}": (dims, np.broadcast_to(values[None, :, None], (1, DRAWS, len(chosen))))
            for name, values in _before(study, model).items()
        }
    where = {"group": found.group.values}
    return {
        "posterior": xr.Dataset(drawn, where),
        "prior": xr.Dataset(before, where),
        "log_likelihood": xr.Dataset(dense),
        "observed_data": xr.Dataset({found.attrs["quantity"]: found["measured"].isel(output=measured)}),
    }


def _before(study: Comparison, model: str) -> dict[str, FloatArray]:
    """Draws of the constants of a model before the data, and of the size of the errors where that is inferred."""
    inputs, factor = study.models[model].inputs, study.method.noise.factor
    rng = np.random.default_rng(study.method.seed)
    kept = np.zeros((0, len(inputs.names)))
    while len(kept) < DRAWS:
        points = inputs.from_normals(rng.standard_normal((DRAWS, len(inputs.names))))[0]
        kept = np.concatenate([kept, points[inputs.allowed(points)]])
    found = dict(zip(inputs.names, kept[:DRAWS].T, strict=True))
    return found if factor is None else found | {NOISE: factor.from_normal(rng.standard_normal(DRAWS))[0]}
