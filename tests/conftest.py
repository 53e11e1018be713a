"""What every test gets."""

import sys

import pytest


@pytest.fixture(autouse=True)
def paths(monkeypatch):
    """Its own search path: studies of Python models that are read in this process add their folders to it."""
    monkeypatch.setattr(sys, "path", [*sys.path])
