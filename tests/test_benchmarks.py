"""What a long benchmark would meet only after minutes."""

import numpy as np

from benchmarks import size
from benchmarks.stability import FAMILIES


def test_the_map_of_hard_cases_can_be_listed() -> None:
    cases = [case for make in dict.fromkeys(make for *_, make in FAMILIES.values()) for case in make()]
    assert {case.family for case in cases} == set(FAMILIES)
    shipped = {case.y for case in cases if case.family == "shipped studies"}
    assert {"beam", "organ", "cook"} <= shipped
    assert "beam-million" not in shipped


def test_time_and_memory_of_a_size_are_measured() -> None:
    unknowns, build, first, counting, tangents, memory = size.measured((3, 1, 1), "multigrid", 1)
    assert unknowns == 3 * 7 * 3 * 3
    assert build > 0
    assert 0 < counting < first
    assert tangents > 0
    assert 0.05 < memory < 2
    assert np.isfinite(size.measured((3, 1, 1), "factor", 1, step=True)).all()
