"""What a long benchmark would meet only after minutes."""

from benchmarks.stability import FAMILIES


def test_the_map_of_hard_cases_can_be_listed() -> None:
    cases = [case for make in dict.fromkeys(make for *_, make in FAMILIES.values()) for case in make()]
    assert {case.family for case in cases} == set(FAMILIES)
    assert {"beam", "organ", "cook"} <= {case.y for case in cases if case.family == "shipped studies"}
