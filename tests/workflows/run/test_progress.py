"""Progress: what is shown on a terminal and off it, quiet or not, as a clock goes on."""

import re
import sys

import pytest

from tests.launch import run_script
from workflows.run import progress
from workflows.run.progress import Progress

MODEL = """
import time

def value(p):
    time.sleep(0.02)
    return [p[0]]
"""
STUDY = """
model = { kind = "python", function = "waiting.value", parameters = { a = 0.5 }, outputs = ["y"] }
parameters = { a = { kind = "uniform", lower = 0.0, upper = 1.0 } }
method = { kind = "monte-carlo", samples = 100, seed = 1 }
"""
# A minute in a fifth of a second.
HASTE = """
import sys
from workflows.run import progress
from workflows.__main__ import main

progress.SECONDS_BETWEEN_LINES = 0.2
sys.exit(main(sys.argv[1:]))
"""


class Clock:
    """Seconds that go on when they are told to."""

    now = 0.0

    def monotonic(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    found = Clock()
    monkeypatch.setattr(progress, "time", found)
    return found


def lines(capsys, clock, **settings):
    """What a study of 100 solves shows that takes 3 s for each and fails once."""
    shown = Progress(100, **settings)
    for number in range(100):
        clock.now += 3.0
        shown(1, int(number == 50))
    shown.close()
    return capsys.readouterr().err.splitlines()


@pytest.mark.unit
def test_a_line_a_minute_off_the_terminal(capsys, clock):
    minutes = lines(capsys, clock)
    assert minutes[0] == "20/100 solves, 0.333 per second, 4:00 left"
    assert [line.split("/")[0] for line in minutes] == ["20", "40", "60", "80", "100", "100"]
    assert minutes[-1] == "100/100 solves, 0.333 per second, 0:00 left, 1 failed"


@pytest.mark.unit
def test_the_first_solve_does_not_spoil_the_time_left(capsys, clock, monkeypatch):
    """It compiles and factorises, which is not repeated: 80 s here, and half a second for each of the others."""
    shown = Progress(1001)
    for number in range(400):
        clock.now += 80.0 if number == 0 else 0.5
        shown(1, 0)
    first, *others = capsys.readouterr().err.splitlines()
    assert first == "1/1001 solves, time left not known yet"
    left = [int(line.split()[0].partition("/")[0]) for line in others]
    assert [line.split(", ")[2] for line in others] == [
        f"{minutes}:{seconds:02d} left" for minutes, seconds in (divmod(round((1001 - n) / 2), 60) for n in left)
    ]
    assert len(others) >= 3
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    clock.now = 0.0
    shown = Progress(81)
    for number in range(2):
        clock.now += 80.0 if number == 0 else 0.5
        shown(1, 0)
    assert shown._bar.postfix == "2 per second, 0:40 left"  # not the 53 minutes of 40 s for each
    shown.close()


@pytest.mark.unit
def test_each_phase_has_its_own_rate(capsys, clock):
    """One solve alone; sixteen together after ten minutes that prepare them, 80 s for the next; two that are read."""
    shown = Progress(100)
    clock.now = 70.0
    shown(1, 0)
    for seconds, solves in ((0.0, 0), (600.0, 16), (80.0, 16), (80.0, 16), (0.0, 2), (0.0, 0), (300.0, 1), (75.0, 1)):
        clock.now += seconds
        shown(solves, 0)
    assert capsys.readouterr().err.splitlines() == [
        "1/100 solves, time left not known yet",
        "17/100 solves, time left not known yet",
        "33/100 solves, 0.2 per second, 5:35 left",
        "49/100 solves, 0.2 per second, 4:15 left",
        "52/100 solves, time left not known yet",
        "53/100 solves, 0.0133 per second, 58:45 left",
    ]


@pytest.mark.unit
def test_quiet_runs_still_show_life(capsys, clock):
    assert lines(capsys, clock, quiet=True) == lines(capsys, clock)[:-1]
    assert lines(capsys, clock, silent=True) == []


@pytest.mark.unit
def test_quiet_runs_show_nothing_on_a_terminal(capsys, clock, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    assert lines(capsys, clock, quiet=True) == []


@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [None, 2])
def test_the_command_shows_life_though_quiet(tmp_path, ranks):
    """By the first rank, of the solves of all."""
    (tmp_path / "waiting.py").write_text(MODEL)
    (tmp_path / "study.toml").write_text(STUDY)
    done = run_script(ranks, HASTE, "run", tmp_path / "study.toml", "--out", tmp_path / "out", "--quiet", "--no-report")
    assert (done.returncode, done.stdout) == (0, "")
    shown = re.compile(r"(\d+)/10\d solves, (.* per second, .* left|time left not known yet)")
    counts = [shown.fullmatch(line) for line in done.stderr.splitlines()]
    assert len(counts) >= 2
    assert all(counts), done.stderr
