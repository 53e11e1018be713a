"""Stated derivatives against the values that they should be of."""

import numpy as np
import pytest

from forward.external.derivatives import contradicted
from forward.model import FunctionModel, SolveError

pytestmark = pytest.mark.unit

POINT, SCALE = np.array([1.0, 2.0, 0.5]), np.array([0.1, 0.3, 0.2])


def values(p):
    return np.array([p[0] ** 2 * p[1], np.exp(p[2]), abs(p[0] - 1)])


def slopes(p):
    return np.array([[2 * p[0] * p[1], p[0] ** 2, 0.0], [0.0, 0.0, np.exp(p[2])], [1.0, 0.0, 0.0]])


def model(jacobian, function=values):
    return FunctionModel(function, ("a", "b", "c"), ("u", "v", "kink"), jacobian)


def said(*arguments):
    return [one.text for one in contradicted(model(*arguments), POINT, SCALE)]


def test_right_derivatives_are_not_objected_to():
    """Nor that to one side of a kink, nor those of rough values, nor a model without any."""
    assert said(slopes) == []
    assert said(None) == []
    rough = np.random.default_rng(1)
    assert said(slopes, lambda p: values(p) * (1 + 1e-8 * rough.standard_normal(3))) == []
    assert said(slopes, lambda p: values(p) + 0.1 * rough.standard_normal(3)) == []


@pytest.mark.parametrize("factor", [0.0, -1.0, 0.9, 1.5, 1e3])
@pytest.mark.parametrize(("output", "parameter"), [(0, 0), (0, 1), (1, 2)])
def test_a_wrong_one_is_named_with_what_it_is_off_by(factor, output, parameter):
    def wrong(p):
        found = slopes(p)
        found[output, parameter] *= factor
        return found

    (text,) = said(wrong)
    assert f"of {'uv'[output]} by {'abc'[parameter]} {100 * abs(factor - 1):.3g} % off." in text


def test_a_missing_or_exchanged_one_is_named():
    def invented(p):
        return slopes(p) + np.array([[0, 0, 0.7], [0, 0, 0], [0, 0, 0]])

    def exchanged(p):
        return slopes(p)[:, [1, 0, 2]]

    assert "of u by c." in said(invented)[0]
    assert (
        "of u by a 75 % off; of u by b 300 % off" in said(exchanged)[0] or "of u by b 300 % off" in said(exchanged)[0]
    )


def test_it_costs_two_solves_and_no_failure():
    """Beside that of the point itself."""
    count = []

    def counted(p):
        count.append(p)
        return values(p)

    assert said(slopes, counted) == []
    assert len(count) == 3

    def brittle(p):
        if p[0] > 1:
            raise SolveError("broken")
        return values(p)

    assert said(slopes, brittle) == []


def test_many_parameters_are_looked_at_together():
    ones = np.ones(40)
    many = FunctionModel(
        lambda p: p.sum(), tuple(f"p{i}" for i in range(40)), ("y",), lambda p: np.r_[2.0, ones[1:]][None]
    )
    (found,) = contradicted(many, ones, ones)
    assert "of y by all parameters" in found.text
