"""What every test gets."""

import sys

import pytest


@pytest.fixture(autouse=True)
def paths(monkeypatch):
    """Its own search path: studies of Python models that are read in this process add their folders to it."""
    monkeypatch.setattr(sys, "path", [*sys.path])


def pytest_ignore_collect(collection_path, config):
    """With `-m unit`, read only the files that have such tests: importing all others takes longer than these run."""
    only = config.option.markexpr == "unit" and collection_path.name.startswith("test_")
    return True if only and "mark.unit" not in collection_path.read_text() else None
