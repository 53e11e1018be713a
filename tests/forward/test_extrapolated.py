"""A model on two meshes: Richardson's limit, derivatives, and the start that later solves are predicted from."""

import numpy as np
import pytest
from scipy.sparse import csr_matrix

from forward.combine import Joined
from forward.fem.finer import FromStart, Otherwise, limit
from forward.model import SolveError
from forward.pointwise import FunctionModel

pytestmark = pytest.mark.unit

NAMES = ("a", "b")


def on(h):
    """Outputs whose error is exactly of second order in h."""

    def outputs(p):
        return np.array([p[0] * p[1] + h**2 * p[0], np.sin(p[1]) - 3 * h**2 * p[1] ** 2])

    def slopes(p):
        return np.array([[p[1] + h**2, p[0]], [0, np.cos(p[1]) - 6 * h**2 * p[1]]])

    return FunctionModel(outputs, NAMES, ("y", "z"), slopes)


def extrapolated(fine, coarse, share, start=None, other=None):
    both = Joined((fine, coarse), (*fine.outputs, "y on the coarse mesh", "z on the coarse mesh"))
    found = limit(FromStart(both, start, needed=other is not None), csr_matrix(np.eye(2)), fine.outputs, share)
    return found if other is None else Otherwise(found, other)


MODEL = extrapolated(on(0.2), on(0.3), 1 / (1.5**2 - 1), np.array([1.0, 1.0]))
POINT = np.array([0.7, 1.2])


def test_outputs_and_derivatives_are_those_of_the_limit():
    found, limit = MODEL.solve(POINT), on(0.0).solve(POINT)
    np.testing.assert_allclose(found.outputs[:2], limit.outputs, rtol=1e-13)
    np.testing.assert_allclose(found.outputs[2:], on(0.2).solve(POINT).outputs - on(0.3).solve(POINT).outputs)
    np.testing.assert_allclose(found.tangent(np.eye(2))[:, :2], limit.tangent(np.eye(2)), rtol=1e-12)
    w = np.array([0.3, -1.2, 2.0, 0.4])
    np.testing.assert_allclose(found.adjoint(w), found.tangent(np.eye(2)) @ w, rtol=1e-12)
    assert len(MODEL.outputs) == 4
    assert found.mesh_error() is None


def without_answer_at_one():
    """A mesh that has no answer where the first parameter is 1, and the values of it that were tried."""
    tried = []

    def fails(p):
        tried.append(p[0])
        if p[0] == 1.0:
            message = "not there"
            raise SolveError(message)
        return on(0.2).function(p)

    return FunctionModel(fails, NAMES, ("y", "z")), tried


def test_other_meshes_take_the_place_of_those_without_an_answer():
    """At some parameters; or at all, where there is none at the start: searches without an answer take minutes."""
    there, tried = without_answer_at_one()
    start = np.array([1.0, 1.0])
    other = extrapolated(on(0.4), on(0.5), 0.7)
    lost = extrapolated(there, on(0.3), 0.8, start, other=other)
    np.testing.assert_array_equal(lost.solve(POINT).outputs, other.solve(POINT).outputs)
    np.testing.assert_array_equal(lost.solve(start).outputs, other.solve(start).outputs)
    assert tried == [1.0]
    part = extrapolated(there, on(0.3), 0.8, POINT, other=other)
    np.testing.assert_array_equal(part.solve(start).outputs, other.solve(start).outputs)
    whole = extrapolated(on(0.2), on(0.3), 0.8)
    np.testing.assert_allclose(part.solve(POINT).outputs, whole.solve(POINT).outputs)


def test_a_start_without_an_answer_is_none():
    there, tried = without_answer_at_one()
    model = extrapolated(there, on(0.3), 0.8, np.array([1.0, 1.0]))
    np.testing.assert_allclose(model.solve(POINT).outputs, MODEL.solve(POINT).outputs)
    with pytest.raises(SolveError, match="not there"):
        model.solve(np.array([1.0, 1.0]))
    tried.clear()
    first = extrapolated(there, on(0.3), 0.8, np.array([1.0, 1.0]))
    with pytest.raises(SolveError, match="not there"):
        first.solve(np.array([1.0, 1.0]))
    assert tried == [1.0]  # a search without an answer takes minutes, and is not repeated


def test_the_start_is_solved_once_by_runs_one_after_the_other():
    """What is kept of it is all that later solves need; where there is no answer, that is kept too."""
    start = np.array([0.9, 1.1])
    kept = {}

    def keep(begin):
        return kept.setdefault("begun", begin()) if not kept else kept["begun"]

    def made(fine, start):
        both = Joined((fine, on(0.3)), ("y", "z", "coarse y", "coarse z"))
        return FromStart(both, start, keep)

    tried = []

    def counted(p):
        tried.append(p.tolist())
        return on(0.2).function(p)

    whole = made(FunctionModel(counted, NAMES, ("y", "z"), on(0.2).jacobian), start)
    first = [whole.solve(start).outputs, whole.solve(POINT).outputs]
    tried.clear()
    again = made(FunctionModel(counted, NAMES, ("y", "z"), on(0.2).jacobian), start)
    np.testing.assert_array_equal(again.solve(POINT).outputs, first[1])
    assert tried == [POINT.tolist()]
    np.testing.assert_array_equal(again.solve(start).outputs, first[0])
    kept.clear()
    lost, tried = without_answer_at_one()
    for _ in range(2):
        model = made(lost, np.array([1.0, 1.0]))
        with pytest.raises(SolveError, match="not there"):
            model.solve(np.array([1.0, 1.0]))
    assert tried == [1.0]
