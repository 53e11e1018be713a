"""What is measured together, and the names of it."""

import numpy as np
import pytest

from inverse.data.measurements import Measurements
from inverse.designs.greedy import Candidates, kinds, matching

P, Q = [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]
VALUES = Measurements.possible(
    ("pull.top.0.x", "pull.top.0.z", "pull.side.0.x", "pull.side.1.x", "pull.force", "push.top.0.x", "push.force"),
    np.array([P, P, P, Q, [np.nan] * 3, P, [np.nan] * 3]),
    ("pull",) * 5 + ("push",) * 2,
    ("x", "z", "x", "x", "force", "x", "force"),
)
NONE = np.zeros(7, dtype=bool)


ALL = ("pull.top.0.x", "pull.top.0.z", "pull.side.1.x", "pull.force", "push.top.0.x", "push.force")


@pytest.mark.unit
@pytest.mark.parametrize(
    ("each", "names", "which"),
    [
        ("value", ALL, [0, 1, -1, 2, 3, 4, 5]),
        ("point", ("pull.top.0", "pull.side.1", "pull.force", "push.top.0", "push.force"), [0, 0, -1, 1, 2, 3, 4]),
        ("place", ("top.0", "side.1", "pull.force", "push.force"), [0, 0, -1, 1, 2, 0, 3]),
        ("case", ("pull", "push"), [0, 0, -1, 0, 0, 1, 1]),
    ],
)
def test_values_are_gathered(each, names, which):
    found = Candidates.of(VALUES, each, NONE)
    assert found.names == names
    assert found.which.tolist() == which  # the same value on two boundaries counts once
    if each == "place":
        assert found.cases == ("", "pull", "pull", "push")
        assert found.parts == ("xz", "x", "force", "force")
        np.testing.assert_array_equal(found.places[0], P)
    if each == "case":
        assert np.isnan(found.places).all()


@pytest.mark.unit
def test_steps_and_outputs_of_a_path():
    values = Measurements.possible(
        ("F.1", "u.1", "F.2", "u.2"), np.full((4, 3), np.nan), ("1", "1", "2", "2"), ("F", "u", "F", "u")
    )
    steps = Candidates.of(values, "step", NONE[:4])
    assert (steps.names, steps.which.tolist()) == (("step 1", "step 2"), [0, 0, 1, 1])
    outputs = Candidates.of(values, "output", NONE[:4])
    assert (outputs.names, outputs.which.tolist()) == (("F", "u"), [0, 1, 0, 1])
    assert kinds(values) == [("", "F"), ("", "u"), ("", "F"), ("", "u")]


@pytest.mark.unit
def test_goals_are_no_candidates():
    goals = matching(VALUES.labels, "*.force")
    found = Candidates.of(VALUES, "value", goals)
    assert goals.tolist() == [False] * 4 + [True, False, True]
    assert (found.which[goals] == -1).all()


@pytest.mark.unit
def test_costs_by_names():
    found = Candidates.of(VALUES, "point", NONE)
    assert found.costing({"pull.*": 2.0, "*.force": 7.0}).costs.tolist() == [2, 2, 7, 1, 7]
    with pytest.raises(ValueError, match=r"'pul' is the name of no candidate, such as pull\.top\.0"):
        found.costing({"pul": 2.0})
