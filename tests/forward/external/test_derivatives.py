"""Stated derivatives against the values that they should be of."""

import numpy as np
import pytest

from forward.external.derivatives import contradicted, mistrusted
from forward.model import SolveError
from forward.pointwise import FunctionModel

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


FAR = np.array([POINT, POINT + SCALE, POINT - SCALE])


def everywhere(p):
    """Slopes that are right on both sides of the kink."""
    found = slopes(p)
    found[2, 0] = 1.0 if p[0] >= 1 else -1.0
    return found


def mistrust(jacobian, function, points=FAR, **known):
    return mistrusted(model(jacobian, function), points, SCALE, **known)


def test_a_model_that_answers_differently_is_found():
    """By chance or by what it remembers; differences far below the spread of the outputs are a warning."""
    rng, calls = np.random.default_rng(0), []

    def noisy(p):
        return values(p) + np.array([0.01 * rng.standard_normal(), 0.0, 0.0])

    def remembering(p):
        calls.append(p)
        return values(p) * (1 + 0.01 * len(calls))

    for function in (noisy, remembering):
        for jacobian in (None, everywhere):
            (found,) = mistrust(jacobian, function)
            assert found.severity == "error"
            assert "answers differently when it is asked again at the mean parameters: u was" in found.text
    (found,) = mistrust(None, lambda p: values(p) * (1 + 1e-5 * rng.standard_normal()), spread=np.ones(3))
    assert found.severity == "warning"
    (found,) = mistrust(None, values, known=values(POINT) + np.array([0.0, 0.1, 0.0]))  # as it was answered before
    assert "v was 1.74872127 and then 1.64872127" in found.text
    assert mistrust(None, values) == mistrust(everywhere, values) == ()
    assert mistrust(None, lambda p: values(p) * (1 + 1e-9 * rng.standard_normal())) == ()


def test_derivatives_that_are_right_at_the_mean_alone_are_found():
    (found,) = mistrust(lambda p: slopes(POINT), values)
    assert found.severity == "error"
    assert "away from the mean, at a = 1.1, b = 2.3, c = 0.7: " in found.text
    assert "of u by a" in found.text
    (found,) = mistrust(lambda p: everywhere(np.minimum(p, POINT)), values, FAR[[0, 2, 1]])
    assert "away from the mean, at a = 1.1" in found.text
    assert mistrust(lambda p: slopes(POINT), values, FAR[:1]) == ()  # nobody has looked


def test_what_asking_again_costs():
    count = []

    def counted(p):
        count.append(p)
        return values(p)

    for jacobian, known, solves in ((None, None, 2), (None, values(POINT), 1), (everywhere, values(POINT), 9)):
        count.clear()
        assert mistrust(jacobian, counted, known=known) == ()
        assert len(count) == solves
