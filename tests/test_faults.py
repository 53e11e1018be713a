"""The faults that `python -m tests.faults` plants are still faults of what stands in the code."""

import pytest

from tests.faults import FAULTS, ROOT, Fault

# No unit test: these are to see faults by what they compute, not by the text.


@pytest.mark.parametrize("name", FAULTS)
def test_faults_can_be_planted(name):
    fault = FAULTS[name]
    text = (ROOT / fault.file).read_text(encoding="utf-8")
    planted = fault.planted(text)
    assert planted != text
    compile(planted, fault.file, "exec")


def test_what_no_longer_stands_there_is_said():
    with pytest.raises(ValueError, match=r"'b' stands there 0 times, expected once"):
        Fault("x.py", "b", "c").planted("a")
    with pytest.raises(ValueError, match="2 times"):
        Fault("x.py", "b", "c").planted("bb")
