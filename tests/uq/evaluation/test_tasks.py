"""Tasks that give datasets: shared by groups of ranks, kept in files of their own, failures as data."""

import numpy as np
import pytest
import xarray as xr
from mpi4py import MPI

from forward.model import SolveError
from forward.pointwise import FunctionModel
from tests.launch import on_kept_ranks, run_script
from uq.evaluation.checkpoint import Checkpoint
from uq.evaluation.ensemble import Ensemble
from uq.evaluation.evaluate import Recorder, SerialEvaluate
from uq.evaluation.request import Request
from uq.evaluation.tasks import Outcome, run_tasks

NAMES = tuple("abcdefg")


def work(number, solved):
    """A dataset of another size for each task, of words too; the fifth one has no answer."""
    evaluate = Recorder(SerialEvaluate(FunctionModel(lambda p: p**2, ("x",), ("y",))))
    found = evaluate(Request(np.arange(number + 1.0)[:, None]))
    solved.extend(evaluate.log)
    if number == 4:
        raise SolveError("nothing there")
    return xr.Dataset(
        {"squares": ("point", found.outputs[:, 0]), "word": f"task {number} – ½"}, {"point": np.arange(number + 1)}
    )


def ensemble():
    return Ensemble.split(MPI.COMM_SELF)


def test_outcomes_stand_in_the_order_of_the_tasks():
    arrived = {}
    found = run_tasks(ensemble(), NAMES, work, arrived=arrived.__setitem__)
    assert [one.reason for one in found] == [""] * 4 + ["nothing there"] + [""] * 2
    assert found[4].dataset is None
    assert [one.solves for one in found] == [1, 2, 3, 4, 5, 6, 7]
    np.testing.assert_array_equal(found[3].dataset["squares"], [0, 1, 4, 9])
    assert all(arrived[i] is one for i, one in enumerate(found))


def test_files_hold_all_of_an_outcome(tmp_path):
    """Sizes, words, attributes, evaluations and reasons."""
    checkpoint = Checkpoint(tmp_path, "study")
    solved = []
    outcome = Outcome(work(2, solved).assign_attrs(unit="m"), "", solved[0], 1.5)
    for key, one in (("done", outcome), ("failed", Outcome(None, "because", None, 0.5))):
        checkpoint.save(key, one.packed())
        assert checkpoint.has(key)
    there = Outcome.of(checkpoint.find("done"))
    xr.testing.assert_identical(there.dataset, outcome.dataset)
    assert (there.reason, there.seconds, there.solves) == ("", 1.5, 3)
    np.testing.assert_array_equal(there.evaluations.points, solved[0].points)
    assert Outcome.of(checkpoint.find("failed")) == Outcome(None, "because", None, 0.5)
    assert there.dataset["word"].item() == "task 2 – ½"


def test_finished_tasks_are_not_done_again(tmp_path):
    """Also those that have failed; a damaged file is done again."""
    done, kept, counted = [], [], []
    checkpoint = Checkpoint(tmp_path, "study")

    def note(number, solved):
        done.append(number)
        return work(number, solved)

    settings = {"checkpoint": checkpoint, "kept": lambda: kept.append(len(list(tmp_path.glob("evaluations/*.block"))))}
    first = run_tasks(ensemble(), NAMES[:5], note, **settings)
    assert done == [0, 1, 2, 3, 4]
    assert kept == [1, 2, 3, 4, 5]
    file = sorted(tmp_path.glob("evaluations/*.block"))[0]
    damaged = bytearray(file.read_bytes())
    damaged[-100] ^= 1
    file.write_bytes(damaged)
    again = run_tasks(ensemble(), NAMES, note, **settings, progress=lambda *n: counted.append(n[0]))
    assert len(done) == 5 + 1 + 2
    assert sum(counted) == sum(one.solves for one in again if one.evaluations is not None) - sum(
        again[number].solves for number in done[5:]
    )
    for one, other in zip(first, again, strict=False):
        assert one.reason == other.reason
        assert one.dataset is None or one.dataset.identical(other.dataset)
    run_tasks(ensemble(), NAMES, note, checkpoint=Checkpoint(tmp_path, "another study"))
    assert len(done) == 8 + 7


def test_other_mistakes_are_no_outcomes():
    def broken(number, solved):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run_tasks(ensemble(), NAMES, broken)


SHARED = """
import sys
from mpi4py import MPI
from tests.uq.evaluation.test_tasks import NAMES, work
from uq.evaluation.ensemble import Ensemble
from uq.evaluation.tasks import run_tasks

ensemble = Ensemble.split(MPI.COMM_WORLD, int(sys.argv[1]))
counted = [0, 0]


def count(done, failed):
    counted[0] += done
    counted[1] += failed


def counting(number, solved):
    import time

    time.sleep(0.05)
    found = work(number, solved)
    ensemble.count(number, 0)
    return found


def broken(number, solved):
    if number == 3:
        raise ZeroDivisionError("on one rank")
    return work(number, solved)


chosen = broken if sys.argv[2:] else counting
for names in (NAMES, NAMES[:2], NAMES[:1]):
    counted[:] = 0, 0
    outcomes = run_tasks(ensemble, names, chosen, progress=count)
    if outcomes is not None:
        print([(one.reason, one.dataset and one.dataset["squares"].values.tolist()) for one in outcomes], counted)
"""


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("ranks", "share"), [(2, 1), (2, 2), *(pytest.param(*pair, marks=pytest.mark.slow) for pair in ((3, 1), (4, 2)))]
)
def test_ranks_share_tasks(ranks, share):
    """The same outcomes for any number of groups, more than tasks too; the failed one counted no solves."""
    done = on_kept_ranks(ranks, SHARED, share)
    assert done.returncode == 0, done.stderr
    outcomes = run_tasks(ensemble(), NAMES, work)
    expected = [(one.reason, one.dataset and one.dataset["squares"].values.tolist()) for one in outcomes]
    all_seven, two, one = done.stdout.splitlines()
    assert all_seven == f"{expected} {[sum(range(7)) - 4, 0]}"
    assert two == f"{expected[:2]} [1, 0]"
    assert one == f"{expected[:1]} [0, 0]"


@pytest.mark.mpi
def test_a_mistake_on_one_rank_ends_all():
    done = run_script(3, SHARED, 1, "broken")
    assert done.returncode == 1
    assert "ZeroDivisionError: on one rank" in done.stderr


LATE = """
import time
from mpi4py import MPI
import xarray as xr
from uq.evaluation.ensemble import Ensemble
from uq.evaluation.tasks import run_tasks
from uq.evaluation.work_queue import Counter

reset = Counter.reset


def late(counter):
    time.sleep(0.3)
    reset(counter)


def work(number, solved):
    done.append(number)
    return xr.Dataset({"large": ("x", [0.0] * 100_000)})  # only sent once somebody receives it


done = []
Counter.reset = late
try:
    run_tasks(Ensemble.split(MPI.COMM_WORLD), ["one", "two"], work)
finally:
    Counter.reset = reset
done = sum(MPI.COMM_WORLD.allgather(done), [])
if MPI.COMM_WORLD.rank == 0:
    print(sorted(done))
"""


@pytest.mark.mpi
def test_no_task_is_taken_before_turns_start_again():
    """However late that is: it would be done twice, and the job would wait forever for its second outcome."""
    done = on_kept_ranks(2, LATE)
    assert "[0, 1]\n" in done.stdout, done.stderr
