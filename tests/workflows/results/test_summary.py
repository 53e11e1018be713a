"""What the terminal says of inversions."""

import pytest

from workflows.results.summary import inverted


@pytest.mark.unit
@pytest.mark.parametrize(
    ("trust", "source", "by"), [("neither", "laplace", "by Laplace, "), ("laplace", "laplace", "")]
)
def test_numbers_that_nothing_stands_in_place_of_are_said_to_be_by_laplace(trust, source, by):
    found = {"posterior": {"a": {"mode": 1.0, "std": 0.1}}, "source": source, "trust": trust}
    assert inverted({"data_sets": {"one": found}}, ()) == [f"one: {by}a 1.00 ± 0.10"]
