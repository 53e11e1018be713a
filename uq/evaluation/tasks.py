"""A map over tasks that each return a dataset, shared by rank groups and stored like blocks of evaluations.

Each group takes the next task when it is free; all of its ranks work on it together. The outcome of a task, a dataset
or the reason for its failure, is written to its own file as soon as it is known (`uq.evaluation.checkpoint`): an
interrupted map continues with the other tasks. An outcome does not depend on the group, nor on other tasks.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING

from forward.model import SolveError
from forward.phases import phase
from uq.evaluation.block import merge
from uq.evaluation.checkpoint import Checkpoint
from uq.evaluation.hdf5 import netcdf
from uq.evaluation.request import Evaluations

if TYPE_CHECKING:
    import xarray as xr

    from uq.evaluation.ensemble import Ensemble
    from uq.evaluation.work_queue import Progress

Packed = tuple[bytes | None, str, Evaluations | None, float]  # an outcome, its dataset as a netCDF-4 file


@dataclass(frozen=True)
class Outcome:
    """The outcome of a task.

    Attributes
    ----------
    dataset
        Its result; None if it failed.
    reason
        Why it failed; empty if it did not.
    evaluations
        The solves made for it; None if there were none.
    seconds
        Processor time of its group's first rank.
    """

    dataset: xr.Dataset | None
    reason: str
    evaluations: Evaluations | None
    seconds: float

    @property
    def solves(self) -> int:
        """Number of solves."""
        return 0 if self.evaluations is None else len(self.evaluations.points)

    def packed(self) -> Packed:
        """Return it as plain data."""
        dataset = None if self.dataset is None else netcdf(self.dataset)
        return dataset, self.reason, self.evaluations, self.seconds

    @classmethod
    def of(cls, packed: Packed) -> Outcome:
        """Make an outcome of what `packed` has returned."""
        import xarray as xr

        content, reason, evaluations, seconds = packed
        dataset = None if content is None else xr.load_dataset(BytesIO(content), engine="h5netcdf")
        return cls(dataset, reason, evaluations, seconds)


def run_tasks(
    ensemble: Ensemble,
    names: Sequence[str],
    work: Callable[[int, list[Evaluations]], xr.Dataset],
    *,
    checkpoint: Checkpoint | None = None,
    progress: Progress = lambda done, failed: None,
    arrived: Callable[[int, Outcome], None] = lambda number, outcome: None,
    kept: Callable[[], None] = lambda: None,
) -> list[Outcome] | None:
    """Run tasks, each on one rank group; collective over all ranks.

    Parameters
    ----------
    ensemble
        The groups.
    names
        Names of the tasks, by which finished ones are found again.
    work
        Runs a task, by number, and appends its solves to a list; collective over a group. A task that raises
        `SolveError` has failed, and the others continue.
    checkpoint
        Where finished tasks are kept and found.
    progress
        On rank 0: told the numbers of solves that tasks have counted (`Ensemble.count`), and of those that failed.
    arrived
        On rank 0: called for each finished task as soon as its outcome is known, in any order.
    kept
        On the group that has run a task: called when its file is written.

    Returns
    -------
    list
        The outcomes in the order of the names on rank 0; None on the other ranks.
    """
    from uq.evaluation.work_queue import abort_all

    world, group = ensemble.world, ensemble.group
    keys = [] if checkpoint is None else [checkpoint.key(("task", number, name)) for number, name in enumerate(names)]
    outcomes: dict[int, Outcome] = {}

    def do(number: int) -> Outcome:
        begin = time.process_time()
        solved: list[Evaluations] = []
        dataset, reason = None, ""
        try:
            with phase(names[number]):
                dataset = work(number, solved)
        except SolveError as error:
            reason = error.reason or "no reason was given"
        evaluations = merge(solved) if solved else None
        outcome = Outcome(dataset, reason, evaluations, time.process_time() - begin)
        if group.rank == 0 and checkpoint is not None:
            checkpoint.save(keys[number], outcome.packed())
        kept()
        return outcome

    def receive(number: int, outcome: Outcome, theirs: bool = False) -> None:
        outcomes[number] = outcome
        arrived(number, outcome)

    def unfinished() -> list[int]:
        """Read what is finished and return what is not; on rank 0."""
        for number, key in enumerate(keys):
            if checkpoint is not None and (packed := checkpoint.find(key)) is not None:
                receive(number, outcome := Outcome.of(packed))
                ensemble.count(outcome.solves, 0)
        return [number for number in range(len(names)) if number not in outcomes]

    with ensemble.turns(progress) as turns, abort_all(world):
        pending = world.bcast(unfinished() if world.rank == 0 else None)
        if pending and world.rank > 0:
            turns.follow(pending, do)
        elif pending:
            turns.lead(pending, do, receive)
    return [outcomes[number] for number in range(len(names))] if world.rank == 0 else None
