"""What every test gets, and in which order they run."""

import sys
from collections import Counter

import pytest


def pytest_configure(config):
    """Let pytest-xdist keep the order below; its own begins with the files of most tests, which are the short ones."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(items):
    """Files that start most programs come first, since they take longest: workers end with short files together."""
    launching = Counter(item.path for item in items if item.get_closest_marker("mpi"))
    solving = Counter(item.path for item in items if item.get_closest_marker("fem"))
    items.sort(key=lambda item: (-launching[item.path], -solving[item.path]))


@pytest.fixture(autouse=True)
def paths(monkeypatch):
    """Its own search path: studies of Python models that are read in this process add their folders to it."""
    monkeypatch.setattr(sys, "path", [*sys.path])


def pytest_ignore_collect(collection_path, config):
    """With `-m unit`, read only the files that have such tests: importing all others takes longer than these run."""
    only = config.option.markexpr == "unit" and collection_path.name.startswith("test_")
    return True if only and "mark.unit" not in collection_path.read_text() else None
