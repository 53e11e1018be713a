"""What the ranks do for a study: evaluations that a method requests, or tasks that each return a dataset."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

from uq.evaluation.block import merge
from uq.evaluation.evaluate import Recorder
from uq.evaluation.kept import Kept
from uq.evaluation.request import Evaluate, Evaluations

if TYPE_CHECKING:
    import xarray as xr

    from forward.model import FloatArray, ForwardModel
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble, EnsembleEvaluate
    from uq.evaluation.tasks import Outcome
    from uq.evaluation.work_queue import Progress

T = TypeVar("T")
MOVED = "moved points"  # in names of models


def kept_starts(checkpoint: Checkpoint, group: Any, label: str = "") -> Callable[[str, Callable[[], T]], T]:
    """Return what keeps where solves on finer meshes start."""
    kept = Kept(checkpoint, group, f"{label}, starts")
    return lambda name, begin: kept.value(name, begin)[0]


@dataclass(frozen=True, kw_only=True)
class Job:
    """What the ranks do for a study."""

    # Adds to the results what the method does not know.
    labelled: Callable[[xr.Dataset], xr.Dataset] = field(default=lambda found: found)
    # Adds at last what all evaluations say.
    finished: Callable[[xr.Dataset, Mapping[str, Evaluations]], xr.Dataset] = field(default=lambda found, _: found)
    # Further files of the directory, by name.
    texts: Callable[[xr.Dataset], Mapping[str, str]] = field(default=lambda _: {})
    # Once it is done: what else is in summary.json, processor times (s) of the methods themselves, in this run, on
    # rank 0, and outcomes of tasks, if there are any, in their order.
    told: dict[str, Any] = field(default_factory=dict)
    own: list[float] = field(default_factory=list)
    outcomes: list[Outcome] = field(default_factory=list)

    @property
    def own_seconds(self) -> float:
        """Processor time (s) of the methods themselves, in this run."""
        return sum(self.own)

    @property
    @abstractmethod
    def evaluations(self) -> dict[str, Evaluations]:
        """What was evaluated, by the name under which it is stored."""

    @abstractmethod
    def run(self, ensemble: Ensemble, checkpoint: Checkpoint, progress: Progress, blocks: int) -> xr.Dataset | None:
        """Do it: results on rank 0, None on the others; collective over all ranks."""


@dataclass(frozen=True)
class MethodJob(Job):
    """Evaluations that a method requests."""

    model: ForwardModel  # the first one
    others: Mapping[str, Callable[[], ForwardModel]]  # makers of others by their names
    task: Callable[[Evaluate], xr.Dataset]  # runs the method on rank 0
    recorders: dict[str, Recorder]  # what was evaluated, by the name under which it is stored
    # Whether solves are worth storing: if not, an interrupted study finds only the steps that its method keeps.
    costly: bool = True
    # Volumes of the nodes of the first model, see `Evaluate`; on rank 0, on request.
    node_volumes: Callable[[], FloatArray | None] = field(default=lambda: None)
    passing: frozenset[str] = frozenset()  # names of other models of which only the last one is kept in memory

    @property
    def evaluations(self) -> dict[str, Evaluations]:
        found: dict[str, Evaluations] = {}
        for name, recorder in self.recorders.items():
            parts: dict[str, list[Evaluations]] = {}
            for one, model in zip(recorder.log, recorder.models, strict=True):
                # Models on several meshes have other outputs, and so a name of their own.
                alike = one.outputs.shape[1] == recorder.log[0].outputs.shape[1]
                parts.setdefault(name if alike else f"{name.rstrip('/')}/{model.rsplit('/', 1)[-1]}", []).append(one)
            found |= {label: merge(part) for label, part in parts.items()}
        return found

    def run(self, ensemble: Ensemble, checkpoint: Checkpoint, progress: Progress, blocks: int) -> xr.Dataset | None:
        """Run the method on rank 0, with an evaluation that all groups work on; collective over all ranks."""

        def timed(evaluate: EnsembleEvaluate) -> xr.Dataset:
            begin = time.process_time()
            found = self.task(evaluate)
            self.own.append(time.process_time() - begin - evaluate.spent)
            return found

        return ensemble.run(
            self.model,
            timed,
            others=self.others,
            passing=self.passing,
            checkpoint=checkpoint if self.costly else None,
            progress=progress,
            blocks=blocks,
            node_volumes=self.node_volumes,
        )


@dataclass(frozen=True)
class TasksJob(Job):
    """Tasks shared by groups of ranks, each of which returns a dataset."""

    names: Sequence[str]
    work: Callable[[int, list[Evaluations]], xr.Dataset]  # as in `uq.evaluation.tasks.run_tasks`, as `arrived`
    results: Callable[[Sequence[Outcome]], xr.Dataset]  # the dataset of the study from the outcomes of all tasks
    solving: list[Kept]  # what is kept of the solves of the task at hand, until its results are
    arrived: Callable[[int, Outcome], None] = field(default=lambda number, outcome: None)

    @property
    def own_seconds(self) -> float:
        solves = sum(float(one.seconds.sum()) for one in self.evaluations.values())
        return max(sum(one.seconds for one in self.outcomes) - solves, 0.0)

    @property
    def evaluations(self) -> dict[str, Evaluations]:
        pairs = zip(self.names, self.outcomes, strict=True)
        return {name: one.evaluations for name, one in pairs if one.evaluations is not None}

    def run(self, ensemble: Ensemble, checkpoint: Checkpoint, progress: Progress, blocks: int) -> xr.Dataset | None:
        """Do the tasks, one after the other in each group; collective over all ranks."""
        from uq.evaluation.tasks import run_tasks

        def kept() -> None:
            while self.solving:
                self.solving.pop().forget()

        found = run_tasks(
            ensemble, self.names, self.work, checkpoint=checkpoint, progress=progress, arrived=self.arrived, kept=kept
        )
        if found is None:
            return None
        self.outcomes.extend(found)
        return self.results(found)
