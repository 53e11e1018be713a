"""A study that compares material models: tests with their data, candidates, and the method."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from functools import cache, cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field

from forward.findings import Finding
from forward.materials.material import units
from forward.materials.material_point import HomogeneousModel, MaterialTest, unfit
from forward.model import ForwardModel
from forward.scalars import Mistake
from forward.settings import Settings, nearest
from inverse.criticism import selected as results
from inverse.criticism.assessment import NEEDED, own_seconds
from inverse.criticism.comparison import Candidate
from inverse.criticism.finer import Finer
from inverse.data.measurements import Measurements
from inverse.methods.selection import Noise, Select
from uq.evaluation.evaluate import Recorder, SerialEvaluate
from uq.evaluation.request import Evaluate
from uq.findings import add
from workflows.config.mistakes import not_installed
from workflows.config.priors import findings_of_materials, mistakes_of_factor
from workflows.data.material_tests import DataFile, MeasuredTest, MeasuredTests
from workflows.run.from_python import FromPython
from workflows.studies.candidates import CandidateModel
from workflows.studies.job import MOVED, MethodJob
from workflows.studies.predictions import (
    FINER,
    NOT_ASKED,
    duration,
    has_mesh,
    mesh_check,
    of_file,
    once_on_finer_meshes,
)
from workflows.studies.solves import of_answers
from workflows.studies.study import StudyKind

if TYPE_CHECKING:
    import xarray as xr

    from forward.spec import ModelSpec
    from inverse.data.shared_motion import SharedMotion
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble

SECONDS_PER_STRESS = 4e-4  # of a material point with its derivatives


# What data of a quantity are called, and what they are of.
DATA = {
    "stress": ("stresses", "tests"),
    "displacement": ("displacements", "load cases"),
    "output": ("values", "outputs"),
}


class Comparison(FromPython, StudyKind):
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
    def of_candidates(self) -> Mapping[str, ModelSpec]:
        """Models of the candidates; none of materials."""
        return {}

    @property
    def mesh_checks(self) -> list[tuple[float, str]]:
        """Processor time (s) of solves on finer meshes of each candidate that has a mesh, and what is solved."""
        return [mesh_check(spec) for spec in self.of_candidates.values() if has_mesh(spec)]

    def described(self, name: str) -> str:
        """Describe a candidate."""
        raise NotImplementedError

    def build(self, name: str, group: str, comm: Any = None) -> ForwardModel:
        """Make the model of a candidate in a group on a communicator; collective."""
        raise NotImplementedError

    def build_finer(self, name: str, make: Callable[[], ForwardModel]) -> ForwardModel:
        """Make a candidate's model, which `make` returns, on a finer mesh, if it is checked there; collective."""
        return once_on_finer_meshes(make, self.models[name].inputs.mean)

    def shared(self, name: str, group: str) -> SharedMotion | None:
        """Return the errors that the data share, as a candidate sees them; None if they are independent."""
        return None

    def contradictions(self, name: str, make: Callable[[], ForwardModel]) -> list[Finding]:
        """Find that another program contradicts itself, or states derivatives that are not of its values; on rank 0."""
        spec = self.of_candidates.get(name)
        if spec is None or spec.shareable:
            return []
        return [one.of(f"Candidate '{name}'") for one in of_answers(make(), self.candidates[name].inputs)]

    @property
    def data_groups(self) -> dict[str, Measurements]:
        """Data by group."""
        raise NotImplementedError

    @property
    def group_names(self) -> tuple[str, ...]:
        """Names of the groups."""
        return tuple(self.data_groups)

    def tests(self, group: str) -> tuple[str, ...]:
        """Names of the tests that were measured in a group."""
        return self.data_groups[group].measured_tests

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

    def plan(self, rank_groups: int) -> list[str]:
        """Say what is compared, and how long that will take."""
        method = self.method
        evidences = self.evidences
        sizes = {group: len(one.seen()) for group, one in self.data_groups.items()}
        own = sum(
            own_seconds(len(self.candidates[name].parameters), sizes[group], method.samples)
            for name, group in self.pairs
        )
        seconds = self.seconds_of_solves + own * evidences / len(self.pairs)
        if method.chains == "hmc":
            seconds += len(self.pairs) * own_seconds(0, 0, 0, "hmc")
        meshes = self.mesh_checks
        if self.unchecked and method.treatment is None:
            meshes = [(0.0, NOT_ASKED)]
        seconds += sum(once for once, _ in meshes)
        check = " and nested sampling, which takes minutes" if method.check else ""
        tests = sum(len(self.tests(group)) for group in self.group_names)
        among = f" in {len(sizes)} groups" if len(sizes) > 1 else ""
        kind, parts = DATA[self.data.quantity]
        count = f"{sum(sizes.values())} {kind} of {tests} {parts}"
        return [
            f"method      {method.kind}",
            f"candidates  {', '.join(f'{name} ({len(c.parameters)})' for name, c in self.candidates.items())}",
            f"data        {count}{among}",
            f"evidences   {evidences}{check}",
            *(f"mesh check  {words}" for words in dict.fromkeys(words for _, words in meshes)),
            f"solves      about {self.planned:,}",
            f"time        about {duration(seconds)} on 1 core (rough)",
        ]

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> MethodJob:
        """Make the candidates, each for each group of data; collective."""
        makers = {pair: cache(partial(self.build, *pair, ensemble.group)) for pair in self.pairs}
        recorders: dict[str, Recorder] = {}
        why = self.unchecked
        checked = [pair for pair in self.pairs if not why.get(pair[0], "none")]

        motions = {pair: found for pair in self.pairs if (found := self.shared(*pair)) is not None}

        def task(evaluate: Evaluate) -> xr.Dataset:
            moved = {pair: evaluate.on(f"{'/'.join(pair)}/{MOVED}") for pair in motions}
            shared = {pair: motion.errors_by(moved[pair]) for pair, motion in motions.items()}

            def recorded(name: str, group: str) -> Evaluate:
                recorders[f"{name}/{group}"] = Recorder(evaluate.on(f"{name}/{group}"))
                return recorders[f"{name}/{group}"]

            def free(name: str, group: str) -> Evaluate:
                # What nested sampling solves is too much, and too cheap, to keep.
                return SerialEvaluate(self.build(name, group), ensemble.count)

            def finer(name: str, group: str) -> Finer:
                if (name, group) not in checked:
                    return Finer(None, why[name])
                return Finer.by(recorders[f"{name}/{group}"].on(f"{name}/{group}/{FINER}"))

            look = finer if why else None

            def itself(name: str, group: str) -> ForwardModel:
                return makers[name, group]()

            method = self.method
            return method.run(self.models, self.data_groups, recorded, free, look, ensemble.say, shared or None, itself)

        def labelled(found: xr.Dataset) -> xr.Dataset:
            found = found.assign_attrs(quantity=self.data.quantity)
            if "mesh_checked" in found:
                of_files = [of_file(self.of_candidates[str(name)]) for name in found.model.values]
                found = found.assign(mesh_of_file=("model", of_files))
            candidates = {name: candidate.inputs for name, candidate in self.candidates.items()}
            units = {name: self.units_of(name) for name in candidates}
            doubts = results.doubts_of_selection(found, candidates, self.method.noise.factor, units)
            wrong = {name: self.contradictions(name, make) for (name, _), make in makers.items()}
            of_wrong = [name for name, several in wrong.items() if several]
            judged = results.trusted_on_meshes(results.with_right_derivatives(found, of_wrong))
            add(judged, *results.findings(found), *results.untrusted(found, judged, of_wrong), *doubts)
            add(judged, *(one for several in wrong.values() for one in several))
            return judged

        others: dict[str, Callable[[], ForwardModel]] = {"/".join(pair): make for pair, make in makers.items()}
        finer_ones = {f"{n}/{g}/{FINER}": partial(self.build_finer, n, makers[n, g]) for n, g in checked}
        moved_ones = {f"{n}/{g}/{MOVED}": partial(_moved, makers[n, g], one) for (n, g), one in motions.items()}
        first = makers[self.pairs[0]]()
        return MethodJob(
            first,
            others | finer_ones | moved_ones,
            task,
            recorders,
            labelled=labelled,
            arviz_groups=partial(results.arviz_groups, self.models, self.method.noise.factor, self.method.seed),
            costly=self.costly,
            passing=frozenset(finer_ones),
        )

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
        for name, candidate in self.candidates.items():
            try:
                candidate.inputs  # noqa: B018 - checks the correlations
            except ValueError as error:
                yield ("candidates", name, "correlations"), str(error), name
        for place, noise in self._noises:
            yield from mistakes_of_factor(noise.factor, "method", *place, "factor")

    @property
    def _noises(self) -> list[tuple[tuple[str, ...], Noise]]:
        others = self.method.other_noises.items()
        return [(("noise",), self.method.noise), *((("other_noises", name), noise) for name, noise in others)]

    def mistakes_of_data(self) -> Iterator[Mistake]:
        """Find what of the method does not fit the data."""
        known = tuple(dict.fromkeys(test for group in self.group_names for test in self.tests(group)))
        for name, tests in self.method.subsets.items():
            for test in tests:
                if test not in known:
                    yield ("method", "subsets", name), f"no test has this name; {nearest(test, known)}", test
        for place, noise in self._noises:
            for data in self.data_groups.values():
                try:
                    noise.sigma_of(data.seen())
                except ValueError as error:
                    yield ("method", *place), str(error), noise.model_dump(exclude_none=True)
                    break


def _moved(make: Callable[[], Any], motion: SharedMotion) -> ForwardModel:
    """Return the model, on the mesh of a candidate, that tells what uncertain motions do; collective."""
    found: ForwardModel = make().observing(*motion.observed)
    return found


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

    data: MeasuredTests
    candidates: dict[str, CandidateModel] = Field(min_length=1)
    predict: tuple[MaterialTest, ...] = ()
    method: Select

    data_in_file: ClassVar[tuple[type[Settings], ...]] = (DataFile,)
    costly: ClassVar[bool] = False

    @property
    def seconds_of_solves(self) -> float:
        """Processor time of the stresses and their derivatives, roughly."""
        return SECONDS_PER_STRESS * self.planned

    def described(self, name: str) -> str:
        """Material of a candidate."""
        return self.candidates[name].energy

    @cached_property
    def data_groups(self) -> dict[str, Measurements]:
        """Data by group."""
        found, predicted = {}, [(math.nan,) * len(test.at) for test in self.predict]
        for group in self.data.data_groups:
            measured, tests = self._measured(group), self._tests(group)
            sigma = [test.sigma or (math.nan,) * len(test.at) for test in measured]
            found[group] = Measurements.of_tests(
                np.concatenate([*(test.measured for test in measured), *predicted]),
                np.concatenate([*sigma, *predicted]),
                [test.label for test in tests for _ in test.at],
                np.concatenate([test.at for test in tests]),
                np.array([(x, z) for test in tests for x, z in zip(test.at, test.across or test.at, strict=True)]),
            )
        return found

    def build(self, name: str, group: str, comm: Any = None) -> HomogeneousModel:
        """Make the model of a candidate in a group."""
        candidate = self.candidates[name]
        names = tuple(candidate.parameters)
        return HomogeneousModel(candidate.energy, candidate.fixed, self._tests(group), names, candidate.fibres)

    def units_of(self, label: str) -> dict[str, str]:
        """SI units of the constants of a candidate."""
        return units(self.candidates[label.partition("/")[0]].energy)

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
            objections = (unfit(candidate.energy, test.mode, candidate.fibres) for test in self._all_tests)
            objection = next(filter(None, objections), None)
            if objection is not None:
                yield ("candidates", name, "material"), objection, candidate.material
        yield from self.mistakes_of_method()
        yield from self.mistakes_of_data()
