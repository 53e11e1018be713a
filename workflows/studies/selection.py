"""A study that compares material models: tests with their data, candidates, and the method."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import Field, model_validator

from forward.bodies.geometry import Vector
from forward.findings import Finding
from forward.materials.admissible import Materials
from forward.materials.material import MATERIALS, constants, incompressible, of_volume, units
from forward.materials.material_point import HomogeneousModel, MaterialTest, unfit
from forward.model import ForwardModel
from forward.registry import KindError, named
from forward.scalars import Mistake
from forward.settings import Settings, nearest, shown
from inverse.criticism.assessment import NEEDED
from inverse.criticism.comparison import Candidate, Data
from inverse.methods.selection import Select
from uq.inputs.distributions import Distribution
from uq.inputs.random_parameters import Inputs
from workflows.config.blocks import Correlation
from workflows.config.mistakes import StudyError, not_installed
from workflows.config.priors import findings_of_materials, inputs_of, mistakes_of_factor, mistakes_of_materials
from workflows.studies.material_tests import DataFile, MeasuredTest, Measurements, expanded
from workflows.studies.study import StudyKind

if TYPE_CHECKING:
    from inverse.data.shared_motion import SharedMotion
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from workflows.studies.job import Job

OF_MODELS = "workflows.studies.model_selection:ModelSelection"
SECONDS_PER_STRESS = 4e-4  # of a material point with its derivatives


class CandidateModel(Settings):
    """A candidate material with its prior.

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
        return inputs_of(self.parameters, self.correlations, materials=self.materials)

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
                message = f"'{name}' is given in material and in parameters, expected one of them"
                raise ValueError(message)
        left_out = of_volume(self.kind) if incompressible(self.kind, given) else ()
        missing = [name for name in known if name not in given and name not in left_out]
        if missing:
            message = f"missing: {', '.join(missing)}, expected in material or parameters"
            raise ValueError(message)
        try:
            wrong = next(mistakes_of_materials(self.inputs, self.materials), None)
        except ValueError:  # correlations, which are reported elsewhere
            return self
        if wrong is not None:
            message = f"parameters {', '.join(wrong[2])}: {wrong[1]}"
            raise ValueError(message)
        return self


class Comparison(StudyKind):
    """What studies that compare models have in common: candidates by name, groups of data, the method."""

    stopped: ClassVar[str] = "all evidences found"
    costly: ClassVar[bool]  # whether solves are worth a file
    data: Any
    candidates: Mapping[str, Any]
    method: Select

    @property
    def seconds_of_solves(self) -> float:
        """Processor time of all solves and their derivatives, roughly."""
        raise NotImplementedError

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about the study before anything is solved."""
        of_all = ([found.of(name) for found in findings_of_materials(one.inputs)] for name, one in self.models.items())
        return tuple(finding for found in of_all for finding in found)

    @property
    def unchecked(self) -> dict[str, str]:
        """Why each candidate is not checked on a finer mesh, empty if it is; None if there are no meshes."""
        return {}

    @property
    def of_files(self) -> frozenset[str]:
        """Candidates whose meshes are those of files."""
        return frozenset()

    @property
    def mesh_checks(self) -> list[tuple[float, str]]:
        """Processor time (s) of a solve on a finer mesh of each candidate, and what is solved, where that is known."""
        return []

    def described(self, name: str) -> str:
        """Describe a candidate."""
        raise NotImplementedError

    def build(self, name: str, group: str, comm: Any = None) -> ForwardModel:
        """Make the model of a candidate in a group on a communicator; collective."""
        raise NotImplementedError

    def build_finer(self, name: str, make: Callable[[], ForwardModel], comm: Any = None) -> ForwardModel:
        """Make a candidate's model on a finer mesh, if it is checked there (see `unchecked`); collective.

        Parameters
        ----------
        name
            Of the candidate.
        make
            Makes its model, or returns the one that was made before.
        comm
            As of `build`.
        """
        from workflows.studies.finer import once_on_finer_meshes

        return once_on_finer_meshes(make, self.models[name].inputs.mean)

    def shared(self, name: str, group: str) -> SharedMotion | None:
        """Return the errors that the data share, as a candidate sees them; None if they are independent."""
        return None

    def moved(self, model: ForwardModel, motion: SharedMotion) -> ForwardModel:
        """Return the model, given that of a candidate, that tells what they are; collective."""
        raise NotImplementedError

    @property
    def group_names(self) -> tuple[str, ...]:
        """Names of the groups."""
        raise NotImplementedError

    @property
    def data_groups(self) -> dict[str, Data]:
        """Data by group."""
        raise NotImplementedError

    def tests(self, group: str) -> tuple[str, ...]:
        """Names of the tests that were measured in a group."""
        raise NotImplementedError

    def measured_in(self, test: str) -> str:
        """Say what was measured in a test, with its unit."""
        raise NotImplementedError

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Candidates and groups, in the order of the models."""
        return [(name, group) for name in self.candidates for group in self.group_names]

    @property
    def models(self) -> dict[str, Candidate]:
        """The candidates as the method needs them."""
        return {name: Candidate(candidate.inputs, candidate.weight) for name, candidate in self.candidates.items()}

    @property
    def planned(self) -> int:
        """Approximate number of solves: the searches for the modes are not predictable."""
        searches = sum(self.searches(name) for name, _ in self.pairs)
        noise = self.method.noise.factor is not None
        chains = sum(self.method.chain_solves(len(self.candidates[name].parameters) + noise) for name, _ in self.pairs)
        return (self.method.samples * len(self.pairs) + searches) * self.evidences // len(self.pairs) + chains

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
    def forms(cls) -> Iterator[type[StudyKind]]:
        """Comparisons of materials, and of models."""
        yield Selection
        yield named(OF_MODELS)

    @classmethod
    def made(cls, blocks: Mapping[str, Any], folder: Path) -> Comparison:
        """Check the blocks of a comparison on a specimen, on another model, or without one on material points."""
        if not isinstance(blocks.get("model", {}), Mapping):
            message = f"model: expected a table, {{ key = value }}; given {shown(blocks['model'])}"
            raise StudyError(message)
        if "model" in blocks:
            other: type[Comparison] = named(OF_MODELS)
            return other.made(blocks, folder)
        return Selection.model_validate(expanded(blocks, folder))

    def plan(self, rank_groups: int) -> list[str]:
        """Say what is compared, and how long that will take."""
        lines: list[str] = named("workflows.studies.selection_plan:plan")(self)
        return lines

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> Job:
        """Make the candidates, each for each group of data; collective."""
        made: Job = named("workflows.studies.selection_job:job")(self, ensemble)
        return made

    def parameters_of(self, label: str) -> tuple[str, ...]:
        """Names of the parameters of a candidate."""
        return tuple(self.candidates[label.partition("/")[0]].parameters)

    def mistakes_of_method(self) -> Iterator[Mistake]:
        """Find what does not fit the candidates and the data."""
        if self.method.check is not None:
            yield from not_installed("check", self.method.check, (self.method.check,))
        if self.method.chains is not None:
            yield from not_installed("chains", self.method.chains, NEEDED[self.method.chains])
        if self.method.chains == "hmc" and self.parallel.ranks_per_model > 1:
            message = "chains = 'hmc' follow gradients on one rank, expected 1"
            yield ("parallel", "ranks_per_model"), message, self.parallel.ranks_per_model
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
            for data in self.data_groups.values():
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
        Tests that are predicted besides the measured ones, in every group.
    method
        How the candidates are compared.
    """

    data: Measurements
    candidates: dict[str, CandidateModel] = Field(min_length=1)
    predict: tuple[MaterialTest, ...] = ()
    method: Select

    data_in_file: ClassVar[tuple[type[Settings], ...]] = (DataFile,)
    costly: ClassVar[bool] = False

    @property
    def group_names(self) -> tuple[str, ...]:
        """Names of the groups."""
        return self.data.data_groups

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
    def data_groups(self) -> dict[str, Data]:
        """Data by group."""
        found = {}
        for group in self.data.data_groups:
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

    def units_of(self, label: str) -> dict[str, str]:
        """SI units of the constants of a candidate."""
        return units(self.candidates[label.partition("/")[0]].kind)

    @property
    def _all_tests(self) -> tuple[MaterialTest, ...]:
        return (*self.data.tests, *self.predict)

    def _measured(self, group: str) -> list[MeasuredTest]:
        return [test for test in self.data.tests if test.group == group]

    def _tests(self, group: str) -> list[MaterialTest]:
        return [*self._measured(group), *self.predict]

    def mistakes(self) -> Iterator[Mistake]:
        """Find what cannot be asked together."""
        for group in self.data.data_groups:
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
