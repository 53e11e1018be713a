"""What starts programs, and tests."""

import sys
from importlib.util import cache_from_source
from pathlib import Path

import pytest

from tests import launch


@pytest.mark.unit
def test_modules_are_compiled_once_whatever_the_environment_says():
    """To compile them is two thirds of the time that each worker takes to collect the tests."""
    assert not sys.dont_write_bytecode
    assert Path(cache_from_source(launch.__file__)).is_file()
