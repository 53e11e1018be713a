"""What every test gets, and in which order they run."""

import gc
import os
import sys
from collections import Counter
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests import COMPILED

if sys.dont_write_bytecode:
    # To compile all modules and tests anew, in every worker, takes longer than all that else is done before the first
    # test. Programs that tests start keep theirs in the same folder.
    sys.dont_write_bytecode = False
    sys.pycache_prefix = sys.pycache_prefix or COMPILED

if find_spec("cftime") is None:
    # For each dataset xarray looks for it twenty times, which takes as long as the study of a small model in a test:
    # pytest's own search for modules comes on top. Python does not search for what is known to be absent.
    sys.modules["cftime"] = None


def pytest_configure(config):
    """Let pytest-xdist keep the order below; its own begins with the files of most tests, which are the short ones."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Of tests with `few(n)` cases the first n are enough by default: the others are slow.

    Files that start most programs come first, since they take longest: workers end with short files together.
    """
    seen = Counter()
    for item in items:
        few = item.get_closest_marker("few")
        seen[item.function] += 1
        if few is not None and seen[item.function] > few.args[0]:
            item.add_marker("slow")
    launching = Counter(item.path for item in items if item.get_closest_marker("mpi"))
    solving = Counter(item.path for item in items if item.get_closest_marker("fem"))
    items.sort(key=lambda item: (-launching[item.path], -solving[item.path]))


def pytest_collection_finish():
    """Let the garbage collector pass over what all tests and libraries have imported, and come less often.

    Forms are many small objects: where they are made, it took an eighth of the time to look at all others again.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(5_000, 20, 20)


@pytest.fixture(scope="session")
def chromium():
    """One browser for all tests of a process; None where there is none."""
    from tests.browser import browser, executable

    if executable() is None:
        yield None
        return
    with browser() as page:
        yield page


@pytest.fixture
def looked_at(chromium):
    """Open the report in a folder of results as people do; where there is no browser, it only has to exist."""
    from tests.browser import without_fault

    def look(folder):
        report = Path(folder) / "report.html"
        assert report.exists()
        if chromium is not None:
            without_fault(chromium, report)

    return look


@pytest.fixture
def undrawn():
    """Pictures in reports that cost nothing, where only their words are looked at."""
    from tests.launch import without_pictures

    with without_pictures():
        yield


@pytest.fixture(scope="session", autouse=True)
def unsynced():
    """No waiting for disks: what tests write need not outlive the machine."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(os, "fsync", lambda file: None)
        yield


@pytest.fixture
def few_draws(monkeypatch):
    """Distributions of expansions from 2^13 points in place of 2^17, where no quantile is looked at closely."""
    monkeypatch.setattr("uq.methods.chaos.DRAWN", 13)


@pytest.fixture(autouse=True)
def paths(monkeypatch):
    """Its own search path: studies of Python models that are read in this process add their folders to it."""
    monkeypatch.setattr(sys, "path", [*sys.path])


@pytest.fixture(autouse=True)
def unwatched(request, monkeypatch):
    """No process beside each study that says a line a minute, but where that is tested."""
    if request.path.name != "test_progress.py":
        from workflows.run.progress import Progress

        monkeypatch.setattr(Progress, "__enter__", lambda self: self)


@pytest.fixture(scope="module", autouse=True)
def first_numbers(request):
    """State of the random numbers `RNG` of a file, before its first test."""
    numbers = getattr(request.module, "RNG", None)
    return numbers, None if numbers is None else numbers.bit_generator.state


@pytest.fixture(autouse=True)
def same_numbers(first_numbers):
    """Every test draws what it draws alone, whichever others ran before it."""
    numbers, state = first_numbers
    if numbers is not None:
        numbers.bit_generator.state = state


def pytest_ignore_collect(collection_path, config):
    """With `make test-unit`, read only the files that have such tests: to import all others takes longer than these."""
    only = config.option.markexpr == "unit and not slow" and collection_path.name.startswith("test_")
    return True if only and "mark.unit" not in collection_path.read_text() else None
