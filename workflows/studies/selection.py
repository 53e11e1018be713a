"""A study that compares models by data: materials in homogeneous tests, or models of which something was measured."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

from pydantic import ValidationError

from forward.findings import Finding
from forward.scalars import Mistake
from forward.settings import Settings, nearest, shown
from forward.spec import ModelSpec
from inverse.criticism.assessment import NEEDED, only_needed, own_seconds
from inverse.criticism.doubts import not_estimable
from inverse.data.measurements import AXES
from inverse.data.table import DataError
from inverse.methods.selection import StatedNoise
from workflows.config.mistakes import StudyError, not_installed, refused
from workflows.config.priors import findings_of_materials, mistakes_of_factor
from workflows.data.material_tests import DataFile, expanded
from workflows.data.measured import DisplacementFile, digest_of
from workflows.run.from_python import FromPython
from workflows.studies.assumptions import of_none
from workflows.studies.candidates import mistakes_of_truth
from workflows.studies.selection_blocks import SelectionBlocks
from workflows.studies.study import NOT_ASKED, StudyKind, bytes_of, duration, mesh_check, never_estimable

if TYPE_CHECKING:
    import xarray as xr

    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from workflows.studies.job import MethodJob

SECONDS = 1e-3  # of a solve about which nothing is known
# What data of a quantity are called, and what they are of.
DATA = {
    "stress": ("stresses", "tests"),
    "displacement": ("displacements", "load cases"),
    "output": ("values", "outputs"),
}


class Selection(SelectionBlocks, FromPython, StudyKind):
    """What to compare: candidates that change one model, and are observed in the same way; or materials.

    Parameters
    ----------
    model
        The model, as far as the candidates have it in common; without one, it is the tests of which there are data, and
        each candidate a material.
    data
        What was measured: a file, or tests of materials.
    candidates
        Models by name.
    predict
        Tests of materials that are predicted besides the measured ones, in every group.
    uncertain
        Standard deviations of what is taken for granted, as of inversions; candidates without such a number have none.
    method
        How the candidates are compared.
    """

    stopped: ClassVar[str] = "all evidences found"
    data_in_file: ClassVar[tuple[type[Settings], ...]] = (DataFile,)

    @classmethod
    def made(cls, blocks: Mapping[str, Any], folder: Path) -> Self:
        """Check the blocks of a comparison, and read its data: those of a model by that of the first candidate."""
        model = blocks.get("model", {})
        if not isinstance(model, Mapping):
            raise StudyError(f"model: expected a table, {{ key = value }}; given {shown(model)}")
        return cls.model_validate(expanded(blocks, folder)).with_data(folder)

    @property
    def recorded(self) -> bool:
        """As in every study: its file is named, and not read."""
        return self.model is not None and self.measurements is None

    def with_data(self, folder: Path) -> Self:
        """Return the same with its data, read by the model of the first candidate; a StudyError for what is wrong."""
        data: Any = self.data
        if self.model is None or data.digest:
            return self
        try:
            found = data.read(folder, next(iter(self.of_candidates.values())))
        except DataError as error:
            raise StudyError(*(f"data: {line}" for line in error.args)) from None
        source = (*found.source, *(f"truth: {name} = {value}" for name, value in found.truth.items()))
        digest = digest_of(folder / data.file) if data.file else ""
        data = data.model_copy(update={"digest": digest, "source": source})
        study = self.model_copy(update={"data": data, "measurements": found})
        refused(type(self).__name__, [*study._unobserved(), *study.mistakes_of_data()])
        return study

    # --- what it costs -----------------------------------------------------------------------------------------------

    @property
    def specs(self) -> tuple[ModelSpec, ...]:
        truths = (self.truth(name) for name in self.learnt)
        return *self.of_candidates.values(), *truths, *(fine for several in self.finer_meshes for fine in several)

    @property
    def memory(self) -> float:
        """Memory (bytes) of a group of ranks: of all candidates, and of the finer meshes of one of them at a time."""
        truths = [self.truth(name) for name in self.learnt]
        return bytes_of([*self.of_candidates.values(), *truths]) + max(
            (bytes_of(several) for several in self.finer_meshes), default=0.0
        )

    @property
    def evidences(self) -> int:
        """Number of evidences that are found."""
        counts = [len(self.tests(group)) for group in self.data_groups]
        held_out = sum(count for count in counts if count > 1) if self.method.held_out else 0
        return len(self.pairs) * self.method.variants + len(self.candidates) * held_out

    @property
    def planned(self) -> int:
        """Approximate number of solves: the searches for the modes are not predictable."""
        searches = sum(self.searches(name) for name, _ in self.pairs)
        chains = sum(self.chain_solves(name) for name, _ in self.pairs)
        pairs = sum(2 * one.solves for one in self.learnt.values())
        return (self.method.samples * len(self.pairs) + searches) * self.evidences // len(self.pairs) + chains + pairs

    def chain_solves(self, name: str) -> int:
        """Most solves of the chains of a candidate in a group of data."""
        noise = self.method.noise.factor is not None
        return self.method.chain_solves(len(self.candidates[name].parameters) + noise)

    def searches(self, name: str) -> int:
        """Number of solves that the searches for the mode of a candidate take, roughly."""
        return 10 * self.method.starts + 2 * len(self.candidates[name].parameters)

    @property
    def seconds_of_solves(self) -> float:
        """Processor time of all solves and their derivatives, roughly: searches for modes have no reference."""
        seconds = chains = 0.0
        for name, spec in self.of_candidates.items():
            cost, solves = spec.cost(), self.searches(name) + self.method.samples
            if cost is None:
                seconds += SECONDS * solves
                chains += SECONDS * self.chain_solves(name) * len(self.data_groups)
                continue
            derivatives = cost.tangents_of_sample(len(self.candidates[name].parameters))
            seconds += self.searches(name) * (cost.textbook if spec.placed else cost.sample)
            seconds += self.method.samples * cost.sample + solves * derivatives
        return seconds * self.evidences / len(self.of_candidates) + chains

    def plan(self, rank_groups: int) -> list[str]:
        method, evidences = self.method, self.evidences
        sizes = {group: len(one.seen()) for group, one in self.data_groups.items()}
        own = sum(
            own_seconds(len(self.candidates[name].parameters), sizes[group], method.samples)
            for name, group in self.pairs
        )
        seconds = self.seconds_of_solves + own * evidences / len(self.pairs)
        if method.chains == "hmc":
            seconds += len(self.pairs) * own_seconds(0, 0, 0, "hmc")
        meshes = [mesh_check(spec) for spec in self.of_candidates.values() if spec.bodies]
        if self.unchecked and method.treatment is None:
            meshes = [(0.0, NOT_ASKED)]
        seconds += sum(once for once, _ in meshes)
        check = " and nested sampling, which takes minutes" if method.check else ""
        tests = sum(len(self.tests(group)) for group in self.data_groups)
        among = f" in {len(sizes)} groups" if len(sizes) > 1 else ""
        kind, parts = DATA[self.data.quantity]
        count = f"{sum(sizes.values())} {kind} of {tests} {parts}"
        return [
            f"method      {method.kind}",
            f"candidates  {', '.join(f'{name} ({len(c.parameters)})' for name, c in self.candidates.items())}",
            f"data        {count}{among}",
            f"evidences   {evidences}{check}",
            *(f"mesh check  {words}" for words in dict.fromkeys(words for _, words in meshes)),
            *only_needed(method.chains, method.chains_when, sum(self.chain_solves(name) for name, _ in self.pairs)),
            f"solves      about {self.planned:,}",
            f"time        about {duration(seconds)} on 1 core (rough)",
        ]

    def arviz_groups(self, found: xr.Dataset) -> Mapping[str, xr.Dataset]:
        from workflows.results.comparison import arviz_groups

        return arviz_groups(self.models, self.method.noise.factor, self.method.seed, found)

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> MethodJob:
        from workflows.studies.selection_job import job

        return job(self, ensemble, checkpoint)

    # --- what is said ------------------------------------------------------------------------------------------------

    @property
    def findings(self) -> tuple[Finding, ...]:
        of_all = [found.of(name) for name, inputs in self.priors.items() for found in findings_of_materials(inputs)]
        return tuple(dict.fromkeys([*self.findings_of_models, *of_all, *self._of_outputs()]))

    def _of_outputs(self) -> Iterator[Finding]:
        """Say of which measured outputs nothing tells the error of the mesh."""
        known = self.measurements is not None and self.measurements.some
        measured = self.measurements.names.tolist() if known else ()
        never = (never_estimable(spec, measured) for spec in self.of_candidates.values())
        names = tuple(dict.fromkeys(name for several in never for name in several))
        yield from not_estimable(names) if names and self.unchecked else ()

    def mistakes(self) -> Iterator[Mistake]:
        if self.model is None:
            yield from self._of_tests()
            yield from self.mistakes_of_data()
        elif self.predict:
            yield ("predict",), "tests of materials are predicted, expected none with a model", list(self.predict)
        if self.data.quantity == DisplacementFile.quantity and self.method.check is not None:
            message = "nested sampling takes ten thousand solves for each candidate, expected none of finite elements"
            yield ("method", "check"), message, self.method.check
        for spec, mistakes in self.models_and_mistakes():
            yield from mistakes
            if spec is not None:
                yield from self.mistakes_of_ranks(spec)
        yield from self._of_method()
        if self.uncertain:
            yield from of_none([self.takes(name, []) for name in self.candidates])
        yield from self._of_model_errors()

    def _of_model_errors(self) -> Iterator[Mistake]:
        """Find what is wrong with models against which errors of candidates are learnt."""
        for name in self.learnt:
            place = ("candidates", name, "model_error")
            if self.model is None:
                yield place, "tests of materials have no model that it changes, expected none", name
                continue
            with suppress(ValidationError):  # of the candidate, which is said elsewhere
                spec = self.of_candidates[name]
                unknown = self.candidates[name].parameters
                for where, message, given in mistakes_of_truth(partial(self.truth, name), spec, unknown):
                    yield (*place, *where), message, given

    def _of_tests(self) -> Iterator[Mistake]:
        """Find several tests of one name in a group, words about meshes, and candidates that are no materials."""
        data: Any = self.data
        for group in data.data_groups:
            labels = [test.label for test in self.tests_in(group)]
            twice = next((label for label in labels if labels.count(label) > 1), None)
            if twice is not None:
                yield ("data", "tests"), f"several tests of group '{group}' have this name, expected one", twice
        if self.method.treatment != "correct":
            message = "tests of materials have no mesh, expected nothing said of it"
            yield ("method", "mesh_error"), message, self.method.mesh_error
        for name, one in self.candidates.items():
            if one.model:
                yield ("candidates", name, "model"), "there is no model that it changes, expected a material", one.model

    def _of_method(self) -> Iterator[Mistake]:
        """Find what of the method does not fit the candidates."""
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
    def _noises(self) -> list[tuple[tuple[str, ...], StatedNoise]]:
        others = self.method.other_noises.items()
        return [(("noise",), self.method.noise), *((("other_noises", name), noise) for name, noise in others)]

    def mistakes_of_data(self) -> Iterator[Mistake]:
        """Find what of the method does not fit the data."""
        known = tuple(dict.fromkeys(test for group in self.data_groups for test in self.tests(group)))
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

    def _unobserved(self) -> Iterator[Mistake]:
        """Find what candidates do not have of what was measured."""
        found = self.measurements
        spec: Any
        for name, spec in self.of_candidates.items():
            place = ("candidates", name, "model")
            if found.some:
                known = [output.name for output in spec.returned]
                lost = next((output for output in found.names.tolist() if output not in known), None)
                if lost is not None:
                    yield (*place, "outputs"), f"no output '{lost}', of which there are data", known
            elif spec.placed:
                has = spec.observable
                pairs = dict.fromkeys(zip(found.tests.tolist(), found.names.tolist(), strict=True))
                case, what = next(((one, what) for one, what in pairs if what not in has.get(one, ())), ("", ""))
                if case and case not in has:
                    yield (*place, "cases"), f"no load case '{case}', of which there are data", list(has)
                elif case:
                    message = f"load case '{case}' has no output '{what}', of which there are data"
                    yield (*place, "cases"), message, list(has[case][len(AXES) :])
            else:
                yield (*place, "kind"), "displacements were measured, expected 'specimen'", spec.kind
