"""Studies that make a reduced model: snapshots of a body over its random parameters, and errors on unseen samples."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

from workflows.config.mistakes import StudyError
from workflows.config.priors import ranges
from workflows.config.tables import at
from workflows.studies.predictions import duration, times_of
from workflows.studies.reduction_blocks import Reduce
from workflows.studies.sampling import Study

if TYPE_CHECKING:
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from workflows.studies.job import Job

OF_DATA = ("data", "predict")  # blocks of an inversion that a reduced model does not depend on
ALWAYS = {"name": "largest", "kind": "max-displacement"}  # output of a load case in which displacements are measured
OTHER_METHOD = "method={ kind = 'reduce' }"  # an assignment that makes such a study of one that samples


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
    from forward.specimen import Specimen

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
