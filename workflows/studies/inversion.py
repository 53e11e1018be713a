"""Studies of what is inside: a specimen in several load cases with measured displacements, and synthetic ones."""

from __future__ import annotations

import csv
import io
import json
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter, field_validator, model_validator
from pydantic.json_schema import SkipJsonSchema

from forward.bodies.geometry import tolerance
from forward.bodies.inclusions import Inclusion, derived
from forward.scalars import Mistake
from forward.settings import Settings, nearest
from forward.specimen import Specimen
from inverse.data.errors import NORMAL, Errors
from inverse.data.observations import DataError, Observations, files, read
from inverse.low_dimensional.posterior import NOISE
from inverse.methods.inversion import ENDS, Invert, Synthesize, names_of, sentence, variables
from uq.inputs.distributions import Distribution, Normal
from uq.inputs.random_parameters import Inputs
from workflows.config.priors import findings_of_materials, mistakes_of_materials
from workflows.config.study import (
    Correlation,
    Parallel,
    StudyError,
    mistakes_of_factor,
    mistakes_of_parameters,
    ranges,
    refused,
)
from workflows.studies.findings_inversion import judged

if TYPE_CHECKING:
    import xarray as xr

    from forward.bodies.geometry import Body
    from forward.model import Finding, FloatArray
    from forward.specimen import SpecimenModel
    from inverse.methods.inversion import Variables
    from uq.evaluation.evaluate import Evaluations

PRIOR_DRAWS = 1024
SOLVES_OF_FIELD = 12  # for a mode


class DataSet(Settings):
    """A file of data, as a study that ran knows it.

    Parameters
    ----------
    name
        The name of the file without its ending.
    file
        The name of the file.
    digest
        Of its bytes.
    refused
        What is wrong with it, if anything.
    """

    name: str
    file: str
    digest: str = ""
    refused: str = ""


class DataFiles(Settings):
    """Where measured displacements are.

    Parameters
    ----------
    files
        Names of files, folders of files, or patterns such as ``data/*.csv``, beside the study or else in the working
        directory; one alone may be given as a word. Each file is a data set, which is inverted by itself.
    sigma
        Standard deviation (m) of the errors where a file does not say.
    unit
        m per unit of the files.
    tolerance
        How far (m) points may lie outside the body, by default a thousandth of its diagonal; they are taken at the
        nearest place of it, and counted.
    errors
        Their distribution: { kind = "normal" }, or { kind = "student-t", degrees = 4 } where a few data may be far off.
    truth
        By path: what is inside, where that is known beside what the files say of it.
    sets
        What the files were when the study ran; written by the run.
    """

    files: tuple[str, ...] = Field(min_length=1)
    sigma: Annotated[float, Field(gt=0)] | None = None
    unit: Annotated[float, Field(gt=0)] = 1.0
    tolerance: Annotated[float, Field(ge=0)] | None = None
    errors: Errors = NORMAL
    truth: dict[str, float] = Field(default={})
    sets: tuple[DataSet, ...] = ()

    def allowed(self, body: Body) -> float:
        """How far (m) points may lie outside a body."""
        return tolerance(body) if self.tolerance is None else self.tolerance

    @field_validator("files", mode="before", json_schema_input_type=tuple[str, ...] | str)
    @classmethod
    def _one_alone(cls, given: Any) -> Any:
        return (given,) if isinstance(given, str) else given


@dataclass(frozen=True, eq=False)
class Measurement:
    """A data set that can be used.

    Attributes
    ----------
    observations
        On the body.
    moved
        How far (n,) its points were moved (m).
    truth
        Numbers that it was made of, by path.
    inclusions
        Those that were really there.
    places, stiffness
        Where (k, 3) ln of the true stiffness factor (k,) is known beside that.
    """

    observations: Observations
    moved: FloatArray
    truth: dict[str, float]
    inclusions: tuple[Any, ...]
    places: FloatArray
    stiffness: FloatArray


class Inversion(Settings):
    """What to invert.

    Parameters
    ----------
    model
        The specimen: body, material, inclusions or a field, load cases.
    parameters
        Priors by the paths of the numbers of the specimen that are unknown; nothing for a field of nodal values.
    correlations
        Correlations between them.
    data
        What was measured.
    method
        How it is inverted.
    parallel
        Use of ranks.
    """

    model: Specimen
    parameters: dict[str, Distribution] = Field(default={})
    correlations: tuple[Correlation, ...] = ()
    data: DataFiles
    method: Invert = Invert()
    parallel: Parallel = Parallel()
    measurements: SkipJsonSchema[tuple[Any, ...]] = Field(default=(), exclude=True, repr=False)

    def __eq__(self, other: object) -> bool:
        """Whether the same is asked of the same files."""
        return isinstance(other, Inversion) and self.model_dump() == other.model_dump()

    __hash__ = None  # type: ignore[assignment]

    @cached_property
    def specimen(self) -> Specimen:
        """The specimen, in the formulation that suits all values of its parameters."""
        specimen: Specimen = self.model.over(ranges(self.parameters))
        return specimen

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What is to be said of the specimen before anything is solved."""
        return (*self.model.findings, *self.model.locking(ranges(self.parameters)), *findings_of_materials(self.inputs))

    @property
    def field(self) -> bool:
        """Whether values of a field at the vertices are what is unknown."""
        return any(field.basis == "nodes" for field in self.model.fields)

    @cached_property
    def inputs(self) -> Inputs:
        """The unknown parameters; nothing for a field of nodal values."""
        standard = dict.fromkeys(() if self.field else self.model.coefficients, Normal(mean=0.0, std=1.0))
        pairs = tuple((*c.between, c.value) for c in self.correlations)
        return Inputs(self.parameters | standard, pairs, self.model.materials(self.parameters))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in results: of a field, its mean."""
        if self.field:
            label = f"fields.{self.model.fields[0].label}.mean"
            return names_of(Inputs({label: Normal(mean=0.0, std=1.0)}), self.method)
        return names_of(self.inputs, self.method)

    @property
    def together(self) -> bool:
        """Whether all groups of ranks work on one data set, point by point."""
        return len(self.data.sets) == 1 and not self.model.fields and self.parallel.ranks_per_model == 1

    @property
    def planned(self) -> int:
        """Number of evaluations: data sets, or solves where all groups work on one."""
        return self.solves if self.together else len(self.data.sets) + 1

    @property
    def solves(self) -> int:
        """Number of solves of all data sets, roughly: the searches for the modes take as many as they take."""
        method, field = self.method, self.field
        each = method.solves(field=field) + method.chain_solves(len(self.names), field=field)
        each += SOLVES_OF_FIELD + each if field else 12 * method.starts + 2 * len(self.parameters)
        return each * sum(measurement is not None for measurement in self.measurements)

    @property
    def variables(self) -> Variables:
        """What an inversion leaves."""
        data = max(int(m.observations.measured.sum()) for m in self.measurements if m is not None)
        nodes, cases = self.model.body.vertex_count, len(self.model.cases)
        return variables(self.names, field=self.field, cases=cases, data=data, nodes=nodes, method=self.method)

    def stiffness(self, places: FloatArray, points: FloatArray) -> FloatArray:
        """Return ln of what the inclusions multiply the stiffness by (n, k) at places (k, 3) and parameters (n, d)."""
        return _stiffness(self.model.inclusions, self.inputs.names, places, points)

    def with_data(self, folder: Path) -> Inversion:
        """Return the same with its files read.

        Raises
        ------
        StudyError
            If no file can be used.
        """
        if self.data.sets:
            return self
        try:
            paths = files(self.data.files, [folder, Path()])
        except DataError as error:
            raise StudyError(*(f"data.files: {line}" for line in error.args)) from None
        sets, found, lines = [], [], []
        names = [path.stem for path in paths]
        for path, stem in zip(paths, names, strict=True):
            name = stem if names.count(stem) == 1 else path.name
            try:
                measurement, wrong = self._read(path), ""
            except DataError as error:
                measurement, wrong = None, "; ".join(error.args)
                lines += [f"data: {line}" for line in error.args]
            digest = sha256(path.read_bytes()).hexdigest()[:16] if path.is_file() else ""
            sets.append(DataSet(name=name, file=path.name, digest=digest, refused=wrong))
            found.append(measurement)
        if all(measurement is None for measurement in found):
            raise StudyError(*lines)
        data = self.data.model_copy(update={"sets": tuple(sets)})
        return self.model_copy(update={"data": data, "measurements": tuple(found)})

    def _read(self, path: Path) -> Measurement:
        cases = tuple(case.name for case in self.model.cases)
        found = read(path, cases, self.data.unit).with_sigma(self.data.sigma)
        body = self.model.body
        extent = max(high - low for low, high in body.bounds)
        found, moved = found.on(body.nearest, extent, self.data.allowed(body))
        truth, places, stiffness = dict(self.data.truth), np.zeros((0, 3)), np.zeros(0)
        for name, text in found.truth.items():
            if name not in {"stiffness", "inclusions"}:
                truth.setdefault(name, _known(name, text, path))
        inclusions = _true_inclusions(found.truth["inclusions"], path) if "inclusions" in found.truth else ()
        if "stiffness" in found.truth:
            places, stiffness = _true_stiffness(path.parent / found.truth["stiffness"])
        return Measurement(found, moved, truth, inclusions, places, stiffness)

    @model_validator(mode="after")
    def _check(self) -> Inversion:
        refused("Inversion", list(self._mistakes()))
        return self

    def _mistakes(self) -> Iterator[Mistake]:
        nodal = [i for i, field in enumerate(self.model.fields) if field.basis == "nodes"]
        if nodal and (len(self.model.fields) > 1 or self.parameters):
            message = "a field of nodal values is inverted alone, expected no other fields and no parameters"
            yield ("model", "fields", nodal[0], "basis"), message, "nodes"
        if nodal and self.model.fields[nodal[0]].of != "stiffness":
            yield ("model", "fields", nodal[0], "of"), "expected stiffness", self.model.fields[nodal[0]].of
        if nodal and self.method.chains == "emcee":
            yield ("method", "chains"), "expected 'pcn', the chains for fields", "emcee"
        for package in {"pcn": ("arviz",), "emcee": ("arviz", "emcee")}.get(self.method.chains or "", ()):
            if find_spec(package) is None:
                message = f"needs {package}, which is not installed: pip install {package}"
                yield ("method", "chains"), message, self.method.chains
        if nodal and self.method.noise is not None and self.data.errors.kind != "normal":
            message = "the size of such errors is not inferred with a field, expected { kind = 'normal' } or no noise"
            yield ("data", "errors"), message, self.data.errors.kind
        if not self.parameters and not self.model.fields:
            yield ("parameters",), "nothing is unknown, expected at least one prior, or one of model.fields", {}
        materials = self.model.materials(self.parameters)
        yield from mistakes_of_parameters(self.model.scalars, self.parameters, materials.names)
        yield from mistakes_of_factor(self.method.noise, "method", "noise")
        for name, value in self.data.truth.items():
            if name not in self.model.scalars:
                message = f"not a number of the model; {nearest(name, tuple(self.model.scalars))}"
                yield ("data", "truth", name), message, value
        try:
            inputs = self.inputs
        except ValueError as error:
            yield ("correlations",), str(error), [c.model_dump() for c in self.correlations]
        else:
            yield from mistakes_of_materials(inputs, materials)


class Synthesis(Settings):
    """What synthetic data to make.

    Parameters
    ----------
    model
        The specimen that is measured, with what is observed of it.
    parameters
        Distributions of numbers that are drawn for each data set; coefficients of random fields always are.
    correlations
        Correlations between them.
    method
        Errors, and the points that data sets have.
    parallel
        Use of ranks.
    """

    model: Specimen
    parameters: dict[str, Distribution] = Field(default={})
    correlations: tuple[Correlation, ...] = ()
    method: Synthesize
    parallel: Parallel = Parallel()

    @cached_property
    def specimen(self) -> Specimen:
        """The specimen, in the formulation that suits all values of its parameters."""
        specimen: Specimen = self.model.over(ranges(self.parameters))
        return specimen

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What is to be said of the specimen before anything is solved."""
        return (*self.model.findings, *self.model.locking(ranges(self.parameters)))

    @cached_property
    def inputs(self) -> Inputs:
        """What is drawn for each data set."""
        standard = dict.fromkeys(self.model.coefficients, Normal(mean=0.0, std=1.0))
        return Inputs(self.parameters | standard, tuple((*c.between, c.value) for c in self.correlations))

    @property
    def planned(self) -> int:
        """Number of solves."""
        return len(self.method.fraction) + 1

    def stiffness(self, places: FloatArray, points: FloatArray) -> FloatArray:
        """Return ln of what the inclusions multiply the stiffness by (n, k) at places (k, 3) and parameters (n, d)."""
        return _stiffness(self.model.inclusions, self.inputs.names, places, points)

    @model_validator(mode="after")
    def _check(self) -> Synthesis:
        refused("Synthesis", list(self._mistakes()))
        return self

    def _mistakes(self) -> Iterator[Mistake]:
        if not self.model.observed:
            yield ("model", "observed"), "nothing is observed, expected boundaries or points", ()
        for i, field in enumerate(self.model.fields):
            if field.basis == "nodes":
                message = "values at the vertices are not independent, expected 'modes' or 'noise'"
                yield ("model", "fields", i, "basis"), message, field.basis
        materials = self.model.materials(self.parameters)
        yield from mistakes_of_parameters(self.model.scalars, self.parameters, materials.names)
        try:
            inputs = self.inputs
        except ValueError as error:
            yield ("correlations",), str(error), [c.model_dump() for c in self.correlations]
        else:
            yield from mistakes_of_materials(inputs.within(materials), materials)


def made(blocks: Mapping[str, Any], folder: Path) -> Inversion | Synthesis:
    """Check the blocks of a study of one of these kinds; data files are beside the study, in a folder.

    Raises
    ------
    pydantic.ValidationError
        For mistakes in the blocks.
    StudyError
        For mistakes in the data.
    """
    if blocks["method"].get("kind") == "synthesize":
        return Synthesis.model_validate(blocks)
    return Inversion.model_validate(blocks).with_data(folder)


def _stiffness(
    inclusions: tuple[Any, ...], names: tuple[str, ...], places: FloatArray, points: FloatArray
) -> FloatArray:
    found = derived(inclusions, names, points, places)
    columns = [values for path, values in found.items() if path.startswith("stiffness.")]
    return np.log(np.column_stack(columns)) if inclusions else np.zeros((len(points), len(places)))


def _known(name: str, text: str, path: Path) -> float:
    try:
        return float(text)
    except ValueError:
        message = f"{path.name}: truth.{name} is '{text}', expected a number"
        raise DataError(message) from None


def _true_inclusions(text: str, path: Path) -> tuple[Any, ...]:
    try:
        return TypeAdapter(tuple[Inclusion, ...]).validate_python(tuple(json.loads(text)))
    except (ValueError, TypeError):
        message = f"{path.name}: truth.inclusions are not inclusions as of a study, in JSON"
        raise DataError(message) from None


def _true_stiffness(path: Path) -> tuple[FloatArray, FloatArray]:
    """Read ln of the true factor at places: a table x, y, z, factor."""
    try:
        table = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
        return table[:, :3], np.log(table[:, 3])
    except (OSError, ValueError, IndexError):
        message = f"{path.name}: the true stiffness cannot be read, expected a table x, y, z, factor"
        raise DataError(message) from None


# --- results ---------------------------------------------------------------------------------------------------------


def dataset(
    study: Inversion, rows: FloatArray, reasons: Mapping[int, str], vertices: Any, layout: Variables | None = None
) -> xr.Dataset:
    """Put the records of all data sets, as vectors (n, S), into a dataset, with what is known beside them.

    Parameters
    ----------
    study
        What was asked.
    rows
        NaN where an inversion failed.
    reasons
        Why, by the number of the data set.
    vertices
        Places (N, 3) of the vertices, cells (n_cells, k), and VTK's number of their kind.
    layout
        Of the vectors, where they are of a study that has more data sets.
    """
    import xarray as xr

    layout = layout or study.variables
    record = layout.unpack(rows)
    places, cells, kind = vertices
    held: dict[str, Any] = {name: (("data_set", *layout.dims[name]), record[name]) for name in layout.dims}
    held["why"] = ("data_set", [reasons.get(k) or sentence(letters) for k, letters in enumerate(record["why"])])
    held["mesh_why"] = ("data_set", [sentence(letters) for letters in record["mesh_why"]])
    held["ok"] = ("data_set", [k not in reasons for k in range(len(rows))])
    found = list(study.measurements)
    count = len(found)
    held["points_moved"] = ("data_set", [0 if m is None else int((m.moved > 0).sum()) for m in found])
    held["largest_move"] = ("data_set", [0.0 if m is None else float(m.moved.max()) for m in found])
    mean, std, stiffness_std = prior_moments(study, places)
    held["prior_mean"], held["prior_std"] = ("parameter", mean), ("parameter", std)
    held["stiffness_prior_std"] = ("node", stiffness_std)
    true = np.full((count, len(study.names)), np.nan)
    for k, m in enumerate(found):
        for name, value in ({} if m is None else m.truth).items():
            if name in study.names:
                true[k, study.names.index(name)] = value
    held["true"] = (("data_set", "parameter"), true)
    held |= _volumes(study, record, found)
    held["stiffness_true"] = (("data_set", "node"), np.array([_true_at(study, m, places) for m in found]))
    held["node_position"] = (("node", "axis"), places)
    held["cell_nodes"] = (("cell", "corner"), cells, {"vtk_cell_type": kind})
    from inverse.methods.inversion import COLUMNS

    coordinates = {
        "data_set": [item.name for item in study.data.sets],
        "parameter": list(study.names),
        "partner": list(study.names),
        "case": [case.name for case in study.model.cases],
        "axis": ["x", "y", "z"],
        "column": list(COLUMNS["field" if study.field else "parameters"]),
    }
    return xr.Dataset(held, coordinates).drop_dims("letter", errors="ignore")


def _volumes(study: Inversion, record: Mapping[str, FloatArray], found: list[Any]) -> dict[str, Any]:
    """Posterior of the volumes (m³) of inclusions whose radii are unknown, by the draws that are kept."""
    names = study.inputs.names
    before = derived(study.model.inclusions, names, prior_draws(study)) if not study.field else {}
    labels = [label for label, values in before.items() if np.ptp(values) > 0]
    if not labels:
        return {}

    def of(points: FloatArray, inclusions: tuple[Any, ...] = study.model.inclusions) -> FloatArray:
        values = derived(inclusions, names if points.shape[1] else (), points)
        return np.column_stack([values.get(label, np.full(len(points), np.nan)) for label in labels])

    draws = np.array([of(rows[:, : len(names)]) for rows in record["draw"]])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of data sets that could not be inverted there are none
        lower, upper = np.nanquantile(draws, ENDS, axis=1)
        mean, std = np.nanmean(draws, axis=1), np.nanstd(draws, axis=1)
    true = np.array([of(np.zeros((1, 0)), m.inclusions if m is not None else ())[0] for m in found])
    here = {"mode": of(record["mode"][:, : len(names)]), "mean": mean, "std": std, "lower": lower, "upper": upper}
    prior = np.column_stack([before[label] for label in labels])
    return {
        **{f"volume_{name}": (("data_set", "inclusion"), values) for name, values in here.items()},
        "volume_true": (("data_set", "inclusion"), true),
        "volume_prior_mean": ("inclusion", prior.mean(axis=0)),
        "volume_prior_std": ("inclusion", prior.std(axis=0)),
        "inclusion": ("inclusion", [label.split(".")[1] for label in labels]),
    }


def prior_moments(study: Inversion, places: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean and standard deviation (c,) of the parameters before the data, and that of ln stiffness (N,) at places."""
    if study.field:
        field = study.model.fields[0]
        prior = field.prior(study.model.body)
        volumes = prior.matern.mass
        g = volumes / volumes.sum()
        width = float(np.linalg.norm(prior.root_transposed(g)))
        moments = [(float(np.log(field.mean) - field.log_std**2 / 2), width)]
        stiffness_std = np.sqrt(prior.variance)
    else:
        moments = list(zip(study.inputs.mean, study.inputs.std, strict=True))
        stiffness_std = study.stiffness(places, prior_draws(study)).std(axis=0)
    if study.method.noise is not None:
        moments.append(study.method.noise.moments)
    mean, std = np.array(moments).T
    return mean, std, stiffness_std


def prior_draws(study: Inversion) -> FloatArray:
    """Draws (n, d) of the parameters before the data."""
    rng = np.random.default_rng(study.method.seed)
    kept = np.zeros((0, len(study.inputs.names)))
    while len(kept) < PRIOR_DRAWS:
        points = study.inputs.from_normals(rng.standard_normal((PRIOR_DRAWS, len(study.inputs.names))))[0]
        kept = np.concatenate([kept, points[study.inputs.allowed(points)]])
    return kept[:PRIOR_DRAWS]


def _true_at(study: Inversion, measurement: Measurement | None, places: FloatArray) -> FloatArray:
    """Logarithm (N,) of the true stiffness factor at the vertices; NaN where it is not known."""
    if measurement is None:
        return np.full(len(places), np.nan)
    if measurement.inclusions:
        return np.asarray(_stiffness(measurement.inclusions, (), places, np.zeros((1, 0)))[0])
    if len(measurement.places):
        from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

        linear = LinearNDInterpolator(measurement.places, measurement.stiffness)(places)
        nearest = NearestNDInterpolator(measurement.places, measurement.stiffness)(places)
        return np.asarray(np.where(np.isfinite(linear), linear, nearest))  # beyond the hull, by rounding
    return np.full(len(places), np.nan)


def summary(found: xr.Dataset) -> dict[str, Any]:
    """Return the part of summary.json that follows from the results; that of the only data set stands above it."""
    sets = {str(name): _one(found.sel(data_set=name)) for name in found.data_set.values}
    only = next(iter(sets.values())) if len(sets) == 1 else {}
    return {**only, "solves": int(np.nansum(found["solves"])), "data_sets": sets}


def _one(found: xr.Dataset) -> dict[str, Any]:
    if not bool(found["ok"]):
        return {"failed": str(found["why"].item())}
    numbers = ("log_evidence", "log_evidence_error", "determined", "residual_probability")
    return {
        "posterior": {
            str(name): {key: _number(found[key].sel(parameter=name)) for key in ("mode", "std", "lower", "upper")}
            for name in found.parameter.values
        },
        **{key: _number(found[key]) for key in numbers},
        "verdict": str(found["why"].item()),
    }


def _number(value: Any) -> float | None:
    number = float(value)
    return number if np.isfinite(number) else None


def batch_table(found: xr.Dataset) -> str:
    """Return a table of comma-separated values with a row for each data set."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    names = [str(name) for name in found.parameter.values]
    statistics = ("mode", "mean", "std", "lower", "upper", "true")
    numbers = ("log_evidence", "log_evidence_error", "determined", "residual_square", "residual_degrees")
    cases = [str(name) for name in found.case.values]
    writer.writerow(
        [
            "data_set",
            "ok",
            "data",
            "points_moved",
            *(f"{name} {key}" for name in names for key in statistics),
            *numbers,
            "residual_probability",
            *(f"misfit {case}" for case in cases),
            "why",
        ]
    )
    for label in found.data_set.values:
        one = found.sel(data_set=label)
        values = [one[key].sel(parameter=name) for name in names for key in statistics]
        values += [one[key] for key in (*numbers, "residual_probability")]
        values += [one["misfit"].sel(case=case) for case in cases]
        shown = [f"{float(value):.8g}" if np.isfinite(float(value)) else "" for value in values]
        count = int(np.isfinite(one["measured"]).sum())
        moved = int(one["points_moved"])
        writer.writerow([str(label), "yes" if bool(one["ok"]) else "no", count, moved, *shown, str(one["why"].item())])
    return file.getvalue()


class Rows:
    """The table of a batch, written anew whenever a data set is finished; the sets stand in their order.

    Parameters
    ----------
    study
        All data sets.
    vertices
        As of `dataset`.
    write
        Writes the table.
    """

    def __init__(self, study: Inversion, vertices: Any, write: Callable[[str], None]) -> None:
        self._study, self._vertices, self._write = study, vertices, write
        self._layout = study.variables
        self._lines: dict[int, str] = {}
        self._head = ""

    def add(self, block: Evaluations) -> int:
        """Add finished data sets; return how many solves they took."""
        solves = 0.0
        reasons = {failure.index: failure.reason for failure in block.failures}
        for i, (row, number) in enumerate(zip(block.outputs, block.points[:, 0].astype(int).tolist(), strict=True)):
            sets, measurements = self._study.data.sets[number], self._study.measurements[number]
            data = self._study.data.model_copy(update={"sets": (sets,)})
            alone = self._study.model_copy(update={"data": data, "measurements": (measurements,)})
            why = {0: reasons[i]} if i in reasons else {}
            found = judged(dataset(alone, row[None], why, self._vertices, self._layout), alone)
            self._head, line = batch_table(found).splitlines()
            self._lines[number] = line
            solves += float(np.nansum(found["solves"]))
        self._write("\n".join([self._head, *(self._lines[number] for number in sorted(self._lines)), ""]))
        return int(solves)


def groups(study: Inversion, found: xr.Dataset) -> dict[str, xr.Dataset]:
    """Return ArviZ's groups: `arviz.from_netcdf("results.nc")`."""
    import xarray as xr

    of_set = found if found.sizes["data_set"] > 1 else found.isel(data_set=0, drop=True)

    # Draws of chains stand one after the other, as many of each.
    counts = set(found["chains"].to_numpy()[found["ok"].to_numpy()].astype(int).tolist())
    chains = max(counts.pop() if len(counts) == 1 and not study.field else 1, 1)
    each = found.sizes["sample"] // chains

    def draws(name: str) -> Any:
        values = of_set[name].isel(sample=slice(chains * each)).transpose("sample", ...)
        shape = (chains, each, *values.shape[1:])
        dims = ("chain", "draw", *values.dims[1:])
        here = {key: value for key, value in values.coords.items() if "sample" not in value.dims}
        return xr.DataArray(values.to_numpy().reshape(shape), here, dims)

    left: dict[str, xr.Dataset] = {}
    observed = {"displacement": of_set["measured"]}
    left["observed_data"] = xr.Dataset(observed).drop_vars("parameter", errors="ignore")
    if study.field:
        left["posterior"] = xr.Dataset({"stiffness": draws("stiffness_draw")})
        return left
    whole = draws("draw")
    left["posterior"] = xr.Dataset({str(name): whole.sel(parameter=name, drop=True) for name in found.parameter.values})
    before = prior_draws(study)
    columns = {name: (("chain", "draw"), before[None, :, i]) for i, name in enumerate(study.inputs.names)}
    if study.method.noise is not None:
        z = np.random.default_rng([study.method.seed, 1]).standard_normal(PRIOR_DRAWS)
        columns[NOISE] = (("chain", "draw"), study.method.noise.from_normal(z)[0][None])
    left["prior"] = xr.Dataset(columns)
    dense = draws("draw_log_likelihood")
    left["log_likelihood"] = xr.Dataset({"displacement": dense})
    seen = np.isfinite(found["measured"].to_numpy())
    if (
        len(seen) > 1 and not seen.all()
    ):  # data sets of different numbers of data: one variable of each, without what is filled up
        parts = {
            str(name): dense.sel(data_set=name, drop=True)[..., here].rename(datum=f"datum_{name}")
            for name, here in zip(found.data_set.values, seen, strict=True)
            if here.any()
        }
        left["log_likelihood"] = left["log_likelihood"].assign(parts)
    return left


# --- synthetic data --------------------------------------------------------------------------------------------------


def _with_values(inclusion: Any, values: Mapping[str, float]) -> dict[str, Any]:
    """An inclusion with other numbers, by their paths."""
    block: dict[str, Any] = inclusion.model_dump()
    return {key: values.get(f"inclusions.{inclusion.label}.{key}", value) for key, value in block.items()}


def points_of(model: SpecimenModel) -> NDArray[np.int64]:
    """Number (m,) of the point that each output of a specimen is observed at, the same in all load cases."""
    return np.asarray(np.unique(np.round(model.places, 12), axis=0, return_inverse=True)[1].ravel())


def with_factor(study: Synthesis, found: xr.Dataset, places: FloatArray, fields: Any) -> xr.Dataset:
    """Add the true factor on the stiffness at places (k, 3) of each data set, as rows x, y, z, factor.

    Parameters
    ----------
    fields
        Factors (n, k) of the random fields on the stiffness, all together.
    """
    points = found["truth"].to_numpy()
    factor = fields * np.exp(study.stiffness(places, points))
    table = np.concatenate([np.broadcast_to(places, (len(points), *places.shape)), factor[:, :, None]], axis=2)
    return found.assign(factor=(("data_set", "place", "axis"), table))


def synthetic_files(study: Synthesis, name: str, found: xr.Dataset, model: Any) -> dict[str, str]:
    """Return the texts of the files of synthetic data, by their names."""
    texts = {}
    points, cases, axes, places = model
    count = found.sizes["data_set"]
    scalars = {path: scalar.value for path, scalar in study.model.scalars.items()}
    varies = [
        path
        for path in scalars
        if path.startswith(("inclusions.", "material.", "regions.")) or path in study.parameters
    ]
    for k in range(count):
        one = found.isel(data_set=k)
        truth = scalars | dict(zip(map(str, found.parameter.values), one["truth"].values.tolist(), strict=True))
        label = name if count == 1 else f"{name}-{k + 1}"
        file = io.StringIO()
        noise = study.method.noise.model_dump(exclude_none=True)
        body = study.model.body
        file.write(
            f"# Synthetic: {body.cells_in_words} cells ({body.cell}, degree {body.degree}), errors "
            f"{', '.join(f'{key} {value:g}' for key, value in noise.items())}, seed {study.method.seed}.\n"
        )
        file.writelines(f"# truth.{path} = {truth[path]!r}\n" for path in varies)
        if study.model.inclusions and not study.model.fields:
            inclusions = [_with_values(inclusion, truth) for inclusion in study.model.inclusions]
            file.write(f"# truth.inclusions = {json.dumps(inclusions)}\n")
        if study.model.fields:
            file.write(f"# truth.stiffness = truth/{label}.csv\n")
            lines = (",".join(f"{x:.6g}" for x in row) for row in one["factor"].values)
            texts[f"truth/{label}.csv"] = "x,y,z,factor\n" + "\n".join(lines) + "\n"
        file.write("x,y,z,ux,uy,uz,sigma,case\n")
        values, sigma = one["values"].values, one["sigma"].values
        for case, case_name in enumerate(c.name for c in study.model.cases):
            for point in np.unique(points[cases == case]):
                rows = np.flatnonzero((cases == case) & (points == point) & np.isfinite(values))
                if len(rows) == 0:
                    continue
                motion = {int(axes[row]): f"{values[row]:.6e}" for row in rows}
                where = ",".join(f"{x:.8g}" for x in np.round(places[rows[0]], 12) + 0.0)
                cells = ",".join(motion.get(axis, "") for axis in range(3))
                file.write(f"{where},{cells},{sigma[rows[0]]:.4e},{case_name}\n")
        texts[f"{label}.csv"] = file.getvalue()
    return texts
