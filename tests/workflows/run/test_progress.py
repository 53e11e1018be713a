"""Progress: what is shown on a terminal and off it, quiet or not, as a clock goes on."""

import re
import subprocess
import sys
import time

import pytest

from forward.phases import listeners, phase
from tests.launch import HANGS, run_script
from workflows.run import progress, watch
from workflows.run.progress import Progress

# One solve takes long, in a library that holds Python's lock.
MODEL = """
import ctypes

def value(p):
    ctypes.PyDLL(None).usleep(1_500_000 if p[0] == 0.5 else 20_000)
    return [p[0]]
"""
STUDY = """
model = { kind = "python", function = "waiting.value", parameters = { a = 0.5 }, outputs = ["y"] }
parameters = { a = { kind = "uniform", lower = 0.0, upper = 1.0 } }
method = { kind = "monte-carlo", samples = 40, seed = 1 }
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


def expecting(planned, **settings):
    found = Progress(**settings)
    found.expect(planned)
    return found


def counted(shown, clock, *solves):
    """What is printed after solves that took so many seconds: their number, and how many of them failed."""
    for seconds, done, failed in solves:
        clock.now += seconds
        shown(done, failed)
    return watch.line(shown.state, clock.now)


@pytest.mark.unit
def test_rate_and_time_left(capsys, clock):
    shown = expecting(100)
    assert counted(shown, clock) == "0/100 solves, time left not known yet"
    assert counted(shown, clock, *[(3.0, 1, 0)] * 20) == "20/100 solves, 0.333 per second, 4:00 left"
    assert counted(shown, clock, *[(3.0, 1, 1)], *[(3.0, 1, 0)] * 79).startswith("100/100 solves, 0.333 per second")
    shown.close()
    assert capsys.readouterr().err == "100/100 solves, 0.333 per second, 0:00 left, 1 failed\n"


@pytest.mark.unit
def test_time_left_falls_while_nothing_ends(clock):
    shown = expecting(100)
    counted(shown, clock, *[(3.0, 1, 0)] * 20)
    assert watch.line(shown.state, clock.now + 60) == "20/100 solves, 0.333 per second, 3:00 left"
    assert watch.line(shown.state, clock.now + 600) == "20/100 solves, 0.333 per second, time left not known yet"
    counted(shown, clock, *[(3.0, 1, 0)] * 80)
    shown._phases = (("weighting points", clock.now),)
    said = "100/100 solves, 0.333 per second, time left not known yet; weighting points (1:00)"
    assert watch.line(shown.state, clock.now + 60) == said


@pytest.mark.unit
def test_the_first_solve_does_not_spoil_the_time_left(clock, monkeypatch):
    """It compiles and factorises, which is not repeated: 80 s here, and half a second for each of the others."""
    shown = expecting(1001)
    assert counted(shown, clock, (80.0, 1, 0)) == "1/1001 solves, time left not known yet"
    for done in (101, 201, 301):
        seconds = (1001 - done) // 2
        left = f"{seconds // 60}:{seconds % 60:02d} left"
        assert counted(shown, clock, *[(0.5, 1, 0)] * 100) == f"{done}/1001 solves, 2 per second, {left}"
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    clock.now = 0.0
    shown = expecting(81)
    counted(shown, clock, (80.0, 1, 0), (0.5, 1, 0))
    assert shown._bar.postfix == "2 per second, 0:40 left"  # not the 53 minutes of 40 s for each
    shown.close()


@pytest.mark.unit
def test_each_phase_has_its_own_rate(clock):
    """One solve alone; sixteen together after ten minutes that prepare them, 80 s for the next; two that are read."""
    shown = expecting(100)
    steps = ((70.0, 1, 0), (0.0, 0, 0), (600.0, 16, 0), (80.0, 16, 0), (80.0, 16, 0), (0.0, 2, 0), (0.0, 0, 0))
    assert [counted(shown, clock, step) for step in (*steps, (300.0, 1, 0), (75.0, 1, 0))] == [
        "1/100 solves, time left not known yet",
        "1/100 solves, time left not known yet",
        "17/100 solves, time left not known yet",
        "33/100 solves, 0.2 per second, 5:35 left",
        "49/100 solves, 0.2 per second, 4:15 left",
        "51/100 solves, 0.225 per second, 3:38 left",
        "51/100 solves, time left not known yet",
        "52/100 solves, time left not known yet",
        "53/100 solves, 0.0133 per second, 58:45 left",
    ]


@pytest.mark.unit
def test_what_is_done_is_named_with_its_time():
    states = []
    listeners.append(states.append)
    try:
        with phase("searching"), phase("factorising"):
            (_, outer), (_, inner) = states[-1]
        assert states[-1] == ()
    finally:
        listeners.pop()
    assert inner >= outer
    state = {"done": 0, "planned": 0, "failed": 0, "rate": 0.0, "at": 0.0}
    assert watch.line(state | {"phases": [["searching", 10.0], ["factorising", 95.0]]}, 100.0) == (
        "searching (1:30): factorising (0:05)"
    )
    ended = state | {"done": 5, "planned": 5, "failed": 1, "phases": [["drawing the report", 40.0]]}
    assert watch.line(ended, 100.0) == "5/5 solves, 1 failed; drawing the report (1:00)"
    assert watch.line(state | {"phases": []}, 100.0) == "at work"


@pytest.mark.parametrize(
    ("terminal", "settings", "lines"),
    [(False, {}, True), (False, {"quiet": True}, True), (False, {"silent": True}, False), (True, {}, False)],
)
def test_lines_are_printed_off_the_terminal_only(monkeypatch, capfd, terminal, settings, lines):
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", 0.1)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    with Progress(**settings), phase("waiting"):
        begin, shown = time.monotonic(), ""
        while time.monotonic() - begin < (HANGS if lines else 0.3) and "waiting" not in shown:
            time.sleep(0.02)
            shown += capfd.readouterr().err
    assert ("waiting (0:0" in shown) == lines
    assert listeners == []


@pytest.mark.unit
def test_quiet_runs_show_nothing_on_a_terminal(capfd, clock, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with expecting(100, quiet=True) as shown:
        counted(shown, clock, *[(3.0, 1, 0)] * 100)
        shown.close()
    assert capfd.readouterr().err == ""


@pytest.mark.unit
def test_the_watch_ends_with_the_run_however_that_ends(tmp_path):
    with (tmp_path / "state").open("w+b") as file:
        command = [sys.executable, watch.__file__, "100", str(file.fileno())]
        begun = subprocess.Popen(command, stdin=subprocess.PIPE, pass_fds=[file.fileno()])
        begun.stdin.close()  # as a kill does
        assert begun.wait(HANGS) == 0


@pytest.mark.slow
@pytest.mark.mpi
@pytest.mark.parametrize("ranks", [None, 2])
def test_the_command_shows_life_though_quiet(tmp_path, ranks):
    """By the first rank, of the solves of all, and within the first of them, which holds Python's lock."""
    (tmp_path / "waiting.py").write_text(MODEL)
    (tmp_path / "study.toml").write_text(STUDY)
    done = run_script(ranks, HASTE, "run", tmp_path / "study.toml", "--out", tmp_path / "out", "--quiet", "--no-report")
    assert (done.returncode, done.stdout) == (0, "")
    of_solves = r"(\d+)/4\d solves(, (.* per second, )?(.* left|time left not known yet))?"
    shown = re.compile(rf"({of_solves}; )?(\D+ \(0:\d\d\)(: )?)+|({of_solves}|at work)")
    lines = done.stderr.splitlines()
    assert all(shown.fullmatch(line) for line in lines), done.stderr
    within = re.compile(r"\d/4\d solves, time left not known yet; monte-carlo \(0:0\d\): solving \(0:0[01]\)")
    assert len([line for line in lines if within.fullmatch(line)]) >= 3, done.stderr


@pytest.mark.parametrize(("settings", "shown"), [({"quiet": True}, True), ({}, True), ({"silent": True}, False)])
def test_a_notebook_has_a_bar_unless_nothing_is_asked_for(settings, shown, capsys, monkeypatch):
    monkeypatch.setattr(progress, "in_notebook", lambda: True)
    with expecting(4, **settings) as found:
        found(4, 0)
        found.close()
    assert ("4/4 solves" in capsys.readouterr().err) == shown
