"""Several jobs on one study, as the tasks of a SLURM array are: each solve once, the same bytes, whoever is killed."""

import signal
import subprocess
import time
from collections import Counter

import pytest

from tests.launch import ROOT, TISSUQ, assert_same_bits, environment, on_ranks

MODEL = """
import os
import time

def tasks():
    with open(os.environ["CALLS"]) as calls:
        return len({line.split()[0] for line in calls})

def value(p):
    with open(os.environ["CALLS"], "a") as calls:
        calls.write(f"{os.environ.get('SLURM_ARRAY_TASK_ID')} {p[0]!r}\\n")
    while os.environ.get("CASE") == "stuck" and p[0] > 0.4:
        time.sleep(0.02)
    ends = time.monotonic() + 60
    while os.environ.get("CASE") == "together" and p[0] != 0.5 and tasks() < 3 and time.monotonic() < ends:
        time.sleep(0.02)  # all of them solve something, however late they begin
    time.sleep(0.02)
    return [p[0], p[0] ** 2]
"""
STUDY = """
[model]
kind = "python"
function = "counted.value"
parameters = { a = 0.5 }
outputs = ["y", "z"]

[parameters]
a = { kind = "uniform", lower = 0.0, upper = 1.0 }

[method]
kind = "monte-carlo"
samples = 60
seed = 1
"""


class Array:
    """Tasks of an array on one study in one directory."""

    def __init__(self, folder, study):
        self.out, self.calls, self._study = folder / "out", folder / "calls", study

    def begin(self, task, *, ranks=None, case=""):
        told = {"SLURM_ARRAY_TASK_ID": str(task), "CALLS": str(self.calls), "CASE": case}
        command = on_ranks(ranks, TISSUQ, "run", self._study, "--out", self.out, "--no-report")
        return subprocess.Popen(
            command, env=environment() | told, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def solved(self):
        """Who has solved how many times at which point."""
        lines = self.calls.read_text().splitlines() if self.calls.exists() else ()
        return [tuple(line.split()) for line in lines]

    def until(self, task):
        """Wait until a task solves."""
        begin = time.monotonic()
        while not any(who == task for who, _ in self.solved()):
            assert time.monotonic() < begin + 60
            time.sleep(0.02)


def once(solved):
    """Whether each point was solved once, but for the mean: it is asked again, to see that the model answers alike."""
    times = Counter(point for _, point in solved)
    return times.pop("0.5") == 2 and set(times.values()) == {1}


def ended(jobs):
    said = [job.communicate(timeout=120) for job in jobs]
    assert [job.returncode for job in jobs] == [0] * len(jobs), said
    return [out for out, _ in said]


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shared")
    (folder / "counted.py").write_text(MODEL)
    (folder / "study.toml").write_text(STUDY)
    return folder / "study.toml"


@pytest.fixture
def array(study, tmp_path):
    return Array(tmp_path, study)


@pytest.fixture(scope="module")
def whole(study):
    """The results of the study as one job."""
    out, calls = study.with_name("whole"), study.with_name("calls")
    command = [TISSUQ, "run", study, "--out", out, "--no-report", "--quiet"]
    subprocess.run(command, env=environment() | {"CALLS": str(calls)}, cwd=ROOT, check=True)
    return out


def test_three_tasks_solve_each_point_once_and_one_writes_the_bytes_of_one_job(array, whole):
    said = ended([array.begin(task, case="together") for task in (1, 2, 5)])
    solved = array.solved()
    assert once(solved)
    assert len(solved) == 62
    assert {who for who, _ in solved} == {"1", "2", "5"}
    assert sum("61 solves in" in one for one in said) == 1
    assert sum("finished by another job" in one for one in said) == 2
    assert_same_bits(array.out, whole)
    assert sorted(path.name for path in array.out.iterdir()) == sorted(path.name for path in whole.iterdir())
    (later,) = ended([array.begin(9)])
    assert later == f"{array.out}: finished before, nothing to do\n"


@pytest.mark.mpi
def test_a_task_of_two_ranks_shares_with_one_of_one(array, whole):
    ended([array.begin("alone"), array.begin("pair", ranks=2)])
    solved = array.solved()
    assert once(solved)
    assert_same_bits(array.out, whole)


def test_what_a_task_had_claimed_is_free_after_a_signal_and_after_a_kill_once_it_runs_again(array, whole):
    stuck = array.begin("3", case="stuck")
    array.until("3")
    (claim,) = (array.out / "evaluations").glob("*.claim")
    assert claim.read_text() == "3"
    stuck.send_signal(signal.SIGTERM)
    assert stuck.wait(60) == 1
    assert not claim.exists()
    stuck = array.begin("4", case="stuck")
    array.until("4")
    stuck.kill()
    stuck.wait()
    assert claim.exists()
    ended([array.begin("5"), array.begin("4")])
    assert_same_bits(array.out, whole)


def test_a_study_whose_results_are_lost_is_computed_again_by_all(array, whole):
    ended([array.begin(1)])
    (array.out / "results.nc").unlink()
    ended([array.begin(1), array.begin(2)])
    assert_same_bits(array.out, whole)
