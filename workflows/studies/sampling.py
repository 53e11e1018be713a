"""A study that samples a model: a written-down constructor call of a model, its random parameters and a method."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

from pydantic import ValidationError, model_validator

from forward.fem.cost import BYTES_OF_PROGRAM, COMPILATION, REPORT, START, Linear
from forward.findings import Finding
from forward.machine import MIB, compiled_forms
from forward.model import ModelError
from forward.scalars import Mistake
from uq.accuracy.budget import FEWEST
from uq.evaluation.request import OWN, company_of
from workflows.config.blocks import MESH
from workflows.config.priors import findings_of_materials, inputs_of, ranges
from workflows.config.tables import at
from workflows.run.from_python import FromPython
from workflows.studies.sampling_blocks import SamplingBlocks
from workflows.studies.study import Sampled, StudyKind, duration, never_estimable, times_of

if TYPE_CHECKING:
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from workflows.studies.job import Job


class Study(SamplingBlocks, FromPython, StudyKind):
    """What to compute.

    Parameters
    ----------
    model
        A body, or a model of another program.
    parameters
        Distributions by the paths of the numbers of the model that they replace; may be left out if the model has
        random fields, whose coefficients are parameters automatically. ``from`` among them names draws (`source`).
    source
        Draws of further numbers; in a file it is ``parameters.from``.
    correlations
        Correlations between them.
    method
        What is computed and how.
    accuracy
        What is asked of errors beside those of sampling. ``mesh_error`` may stand beside the blocks too.
    sensitivity
        What else is asked of derivatives.
    """

    stopped: ClassVar[str] = "one linearisation"
    explains: ClassVar[bool] = False

    @property
    def sampled(self) -> Sampled:
        return Sampled(self.inputs, self.spec)

    @property
    def memory(self) -> float:
        return super().memory + (self.bytes_of_estimates if self.estimates else 0.0)

    @property
    def growth(self) -> tuple[float, str]:
        """Memory (bytes) of the largest mesh that it may make, and what sets it; 0 where it makes none."""
        if self.accuracy.tolerance is None or not self.estimates:
            return super().growth
        from workflows.accuracy.levers import MeshLever

        if not MeshLever.of(self).moves:
            return super().growth
        return MIB * self.accuracy.memory, "what accuracy.memory"

    @property
    def findings(self) -> tuple[Finding, ...]:
        materials = self.spec.materials(self.inputs.names)
        of_draws = () if materials is None else findings_of_materials(self.inputs.within(materials), fail=True)
        found = (*self.model.findings_over(ranges(self.given)), *of_draws, *self._of_estimates())
        if self.source is not None:
            found = (*found, *self.source.findings(self.spec, self.inputs))
        if self.accuracy.tolerance is None:
            return found
        from workflows.accuracy import tolerance_words

        return *found, *tolerance_words.findings(self)

    def _of_estimates(self) -> Iterator[Finding]:
        if self.accuracy.mesh_error and self.spec.hidden:
            yield Finding("mesh-of-body", "note", {"why": self.spec.hidden})
        elif "mesh_error" in self.accuracy.model_fields_set and self.accuracy.mesh_error and not self.spec.meshed:
            yield Finding("no-mesh", "note", {"kind": self.model.kind})
        if self.estimating and self.too_large is not None:
            yield Finding(
                "mesh-estimates-too-large", "warning", {"memory": self.too_large, "limit": self.accuracy.memory}
            )
        if self.accuracy.tolerance is None and 0 < self.estimates < FEWEST:  # a tolerance takes as many as it needs
            yield Finding("mesh-estimates-few", "note", {"points": self.estimates})
        if self.accuracy.mesh_error and self.spec.meshed and self.spec.unestimated_with:
            yield Finding("mesh-with-memory", "warning", {"what": self.spec.unestimated_with})

    def plan(self, rank_groups: int) -> list[str]:
        method, spec, tolerance = self.method, self.spec, self.accuracy.tolerance
        up_to = "up to " if (method.open_ended or tolerance is not None) and not method.undecided else ""
        series = [list(one) for _, one in groupby(spec.coefficients, lambda path: path.rpartition(".")[0])]
        later = f" for {method.undecided}, which decide how many more" if method.undecided else ""
        lines = [
            f"method      {method.kind}",
            *(f"{what:10}  {words}" for what, words in self.model.described(ranges(self.given))),
        ]
        for k, mesh in enumerate(self.meshes[1:], 1):
            cost = mesh.cost()
            taken = "" if cost is None else f" ({cost.sample:.2g} s a solve)"
            lines.append(f"            {mesh.unknowns:,} on mesh {k}{taken}")
        lines += [
            f"parameters  {', '.join([*self.given, *(f'{one[0]} to {len(one) - 1}' for one in series)])}",
            f"outputs     {', '.join(output.name for output in spec.returned)}",
            f"solves      {up_to}{self.planned:,}{later}",
        ]
        estimates = f"{up_to}{self.estimates} estimates"
        if tolerance is not None:
            from workflows.accuracy import tolerance_words

            lines += tolerance_words.plan(self)
            estimates = tolerance_words.ESTIMATES  # the study's number is of a method alone
        if spec.cost() is None:  # the time of a solve is unknown
            return lines
        never = never_estimable(spec)
        if self.estimates:
            lines.append(
                f"mesh error  {estimates} in elements of one degree more; none with accuracy.mesh_error = false"
            )
        if self.estimates and never:
            lines.append(f"            none of {', '.join(never)}, which need not converge as the mesh is refined")
        by_clock = [(part.seconds / (rank_groups if part.shared else 1), part.what) for part in parts(self)]
        whole = f"{duration(sum(seconds for seconds, _ in by_clock))} on {rank_groups} core{'s' * (rank_groups > 1)}"
        more = ", then more" if later else ""
        lines += [
            f"memory      about {(self.memory + BYTES_OF_PROGRAM) / MIB:,.0f} MiB for each group of ranks",
            f"time        {up_to}about {whole}, to a factor of 2{more}:",
            *(f"            {duration(seconds):>8}  {what}" for seconds, what in by_clock),
        ]
        if _compiled_before():
            least = f"and {_compilation(self):.0f} s or more"
            lines.append(f"            {least} where the forms of this kind of body are not compiled yet")
        return lines

    def prepared(self, ensemble: Ensemble, directory: Path, say: Callable[[str], None]) -> Self:
        """Refine the mesh, where that is asked for; collective."""
        found = self
        if self.model.unrefined:
            from workflows.accuracy.tolerance import on_adapted_mesh

            found = on_adapted_mesh(self, ensemble, directory, say)
        if self.accuracy.tolerance is not None and self.estimates:
            from workflows.accuracy.tolerance import on_fine_mesh
            from workflows.run.own_code import identity

            found = on_fine_mesh(found, ensemble, directory, say, identity)
        return found

    @property
    def kept(self) -> Self:
        """The study, with a mesh that was refined where its results are."""
        if not self.model.adaptive:
            return self
        return self.of(self.model.on_mesh(MESH, self.solid.body.contents))

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> Job:
        from workflows.studies.sampling_job import job

        return job(self, ensemble, directory)

    def identity(self) -> dict[str, Any]:
        """Return everything that evaluations depend on; files count by their contents, not their path."""
        others = {name: other.identity() for name, other in self.models.items()}
        return super().identity() | self.by_contents | ({"models": others} if others else {})

    @model_validator(mode="before")
    @classmethod
    def _complete(cls, value: Any) -> Any:
        """Take `mesh_error` from beside the blocks into its own, unless that says it too.

        And say what a tolerance for all errors leaves out of a file: the method, or how many samples it takes.
        """
        match {"accuracy": {}} | value:
            case {"mesh_error": asked, "accuracy": {**block}, **rest} if "mesh_error" not in block:
                value = rest | {"accuracy": block | {"mesh_error": asked}}
        if at(value, "accuracy", "tolerance") is None:
            return value
        from workflows.accuracy.levers import completed

        return completed(value)

    def mistakes(self) -> Iterator[Mistake]:
        if self.source is not None:
            wrong = list(self.source.mistakes(self.model, tuple(self.parameters)))
            yield from wrong
            if wrong:
                return
        unfit = list(self.method.unfit(self.spec))
        yield from unfit
        if not unfit:
            try:
                _ = self.models
            except ValidationError as error:
                message = f"the finest mesh cannot be: {error.errors()[0]['msg']}"
                yield ("method", "levels"), message, getattr(self.method, "levels", None)
            except ModelError as error:
                yield ("method", "kind"), str(error), self.method.kind
        if not self.given and not self.model.coefficients:
            or_field = ", or one of model.fields" if self.spec.meshed else ""
            yield ("parameters",), f"no parameter is random, expected at least one{or_field}", {}
        yield from self.mistakes_of_parameters()
        if self.accuracy.tolerance is not None or self.method.kind == "automatic":
            from workflows.accuracy import tolerance_words

            yield from tolerance_words.mistakes(self)
        not_sampled = list(self.spec.mistakes_of_samples())
        yield from not_sampled
        yield from self.mistakes_of_ranks(self.spec)
        inputs = inputs_of(self.parameters, (), self.model.coefficients)
        with suppress(ValueError):  # correlations, which are reported above
            inputs = self.inputs
        if not not_sampled:
            yield from self.method.mistakes(inputs, self.spec)


# --- what it costs ---------------------------------------------------------------------------------------------------


class Part(NamedTuple):
    """Cost of a part of a study: predicted processor time (s), purpose, and whether groups of ranks share it."""

    seconds: float
    what: str
    shared: bool = False


def parts(study: SamplingBlocks) -> list[Part]:
    """Predict the cost of a study of a body, part by part.

    Samples are the maximum number; those that multilevel methods add after their pilots are unknown.
    """
    method, dimension, estimating = study.method, len(study.inputs.names), study.estimating_cost
    known = ((name, model.cost()) for name, model in study.models.items())
    costs = {OWN: times_of(study.spec)} | {name: cost for name, cost in known if cost is not None}
    found = [times_of(mesh) for mesh in study.meshes]
    samples = study.planned - len(found)
    seconds = min(method.seconds(dimension, costs), getattr(method, "budget_seconds", None) or float("inf"))
    corrected = samples > 0 and found[0].predicted and found[0].linear != Linear.MULTIGRID
    each = found[0].in_company(company_of(samples))
    seconds *= each / found[0].sample
    parts = [Part(START, "start of the program")]
    parts += [] if _compiled_before() else [Part(_compilation(study), "compilation of the forms")]
    parts += [
        Part(sum(one.first for one in found), f"first solve{' on every mesh' if len(found) > 1 else ''}"),
        Part(sum(one.tangents(dimension) for one in found), "its tangents"),
    ]
    if corrected:
        parts.append(Part(sum(one.reference_factor(dimension) for one in found), "reference factor"))
    if samples > 0:
        parts.append(Part(seconds, f"{samples:,} further solves, {each:.2g} s each", shared=True))
    if estimating is not None:  # of the error of the mesh, each with its solution
        one = found[0].sample + estimating.seconds
        took = estimating.once + estimating.calibration + study.estimates * one
        parts.append(Part(took, f"{study.estimates} estimates of the mesh error, {one:.2g} s each", shared=True))
    return [*parts, Part(REPORT, "results and report")]


def _compilation(study: SamplingBlocks) -> float:
    """Seconds of the forms of a body, and of those for the error of its mesh: of one degree more, perhaps of two."""
    cost = study.estimating_cost
    return COMPILATION * (1 if cost is None else 2 if cost.calibration else 3)


def _compiled_before() -> bool:
    """Whether any forms were compiled on this machine; only a run can tell which."""
    return any(compiled_forms().glob("forms-*/*/"))
