"""Studies that make a reduced model: snapshots of a body over its random parameters, and errors on unseen samples."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import Field

from forward.registry import named
from forward.scalars import Mistake
from forward.settings import Settings
from forward.specimen import Specimen
from uq.methods.method import Method
from workflows.config.mistakes import StudyError
from workflows.config.priors import ranges
from workflows.config.tables import at
from workflows.studies.sampling import Study
from workflows.studies.study import duration, times_of

if TYPE_CHECKING:
    import xarray as xr

    from forward.spec import ModelSpec
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from uq.evaluation.request import Evaluate
    from uq.inputs.random_parameters import Inputs
    from workflows.studies.job import Job

OF_DATA = ("data", "predict")  # blocks of an inversion that a reduced model does not depend on
ALWAYS = {"name": "largest", "kind": "max-displacement"}  # output of a load case in which displacements are measured
OTHER_METHOD = "method={ kind = 'reduce' }"  # an assignment that makes such a study of one that samples


class Blocks(Settings):
    """Blocks of a body with modes of their own, joined at their interfaces.

    Parameters
    ----------
    cut
        Numbers of blocks along the axes; or "regions", which are the blocks then.
    full
        Places in blocks that are kept in full, where a tool may press that no snapshot has seen.
    """

    cut: (
        tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]]
        | Literal["regions"]
    )
    full: tuple[tuple[float, float, float], ...] = ()


class Reduce(Method):
    """Make a reduced model of a body.

    Parameters
    ----------
    case
        Which load case of a specimen is reduced, with those parameters that act in it.
    snapshots
        Solves of which it is made. Half of them fill the distribution evenly; the others are, round by round, those of
        many candidates at which the estimated error of any output is largest.
    rounds
        In how many rounds those are drawn.
    modes
        Number of modes; by default as many as `truncation` needs.
    more
        How many modes of states the nested larger model has besides, which tells errors and corrects gradients.
    blocks
        Into which blocks the body is cut, with modes of their own; by default modes are those of the whole body.
    truncation
        What the modes may leave of the snapshots: root mean square in the norm of the stiffness, relative.
    cubature
        What the points may miss of the forces of the snapshots, relative.
    derivatives
        Whether states are differentiated and adjoints solved for at the snapshots, which takes a factorisation each.
        Estimates of errors need them; a control variate beside the body (`multifidelity`) does without.
    unseen
        Further solves, at random samples, on which its errors are measured.
    seed
        Of all points.
    """

    kind: Literal["reduce"] = "reduce"
    case: str | None = None
    snapshots: Annotated[int, Field(ge=4)] = 96
    rounds: Annotated[int, Field(ge=0)] = 3
    modes: Annotated[int, Field(ge=1)] | None = None
    more: Annotated[int, Field(ge=1)] = 120
    blocks: Blocks | None = None
    truncation: Annotated[float, Field(gt=0, lt=1)] = 2e-3
    cubature: Annotated[float, Field(gt=0, lt=1)] = 1e-3
    derivatives: bool = True
    unseen: Annotated[int, Field(ge=0)] = 32
    seed: Annotated[int, Field(ge=0)] = 0

    def planned(self, dimension: int) -> int:
        return self.snapshots + self.unseen + 1

    def run(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        """Refuse: states are needed, which an evaluation does not return."""
        raise ValueError("method.kind = 'reduce' is run by a study of its own")

    def unfit(self, spec: ModelSpec) -> Iterator[Mistake]:
        if spec.kind != "hyperelastic":
            yield ("model", "kind"), "only a body can be reduced, expected 'hyperelastic'", spec.kind
            return
        if self.case is not None:
            yield ("method", "case"), "a body has no load cases, expected none", self.case
        for said in named("forward.reduced.spec:mistakes")(spec):
            yield ("model",), said, spec.kind


class ReductionStudy(Study):
    """What is reduced, over which parameters, and how.

    Parameters
    ----------
    model
        A body.
    parameters
        Distributions by the paths of the numbers of the model that become parameters of the reduced one.
    source, correlations, accuracy, parallel, report
        As in studies that sample a model.
    method
        How it is reduced.
    """

    stopped: ClassVar[str] = "a reduced model"

    method: Reduce

    @classmethod
    def made(cls, blocks: Mapping[str, Any], folder: Path) -> Self:
        """Check the blocks; of an inversion, the priors are what counts, and what was measured does not."""
        return cls.model_validate(_of_case({name: one for name, one in blocks.items() if name not in OF_DATA}))

    @property
    def estimating(self) -> bool:
        """The mesh is that of the body; its error is not estimated here."""
        return False

    def plan(self, rank_groups: int) -> list[str]:
        method, times = self.method, times_of(self.spec)
        modes = "as many modes as are needed" if method.modes is None else f"{method.modes} modes"
        seconds = times.first + (self.planned - 1) * times.sample / rank_groups
        return [
            f"method      {method.kind}: {modes}",
            *(f"{what:10}  {words}" for what, words in self.model.described(ranges(self.given))),
            f"parameters  {', '.join(self.inputs.names)}",
            f"outputs     {', '.join(output.name for output in self.spec.returned)}",
            f"solves      {method.snapshots} snapshots, {method.unseen} unseen samples",
            f"time        about {duration(seconds)} for the solves on {rank_groups} core{'s' * (rank_groups > 1)}",
        ]

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> Job:
        from workflows.studies.reduction_job import job

        return job(self.method, self.spec, self.inputs, ensemble, directory, checkpoint)


def _of_case(blocks: dict[str, Any]) -> dict[str, Any]:
    """Return the study of one load case of a specimen, if that is reduced; a StudyError if it has no such case."""
    if at(blocks, "model", "kind") != "specimen" or at(blocks, "method", "kind") is None:
        return blocks
    model, method = blocks["model"], blocks["method"]
    specimen = Specimen.model_validate(model)
    case = next((one for one in specimen.cases if one.name == method.get("case")), None)
    if case is None:
        known = ", ".join(one.name for one in specimen.cases)
        raise StudyError(f"method.case: one load case of a specimen is reduced at a time, expected one of: {known}")
    body = specimen.loaded(case)
    acts = {*body.scalars, *body.coefficients}
    absent = set(specimen.scalars) - acts
    changed = {
        "model": body.model_dump(mode="json", exclude_none=True)
        | {"outputs": [one.model_dump(mode="json", exclude_none=True) for one in case.outputs] or [ALWAYS]},
        "method": {name: value for name, value in method.items() if name != "case"},
        "parameters": {path: one for path, one in blocks.get("parameters", {}).items() if path not in absent},
    }
    pairs = [one for one in blocks.get("correlations", ()) if not absent.intersection(one.get("between", ()))]
    return {**blocks, **changed, **({"correlations": pairs} if pairs else {})}
