"""Models made of models: derivatives and errors of the mesh are those of what they are made of."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.sparse import csr_matrix

from forward.affine import Sparse
from forward.combine import Joined, Mapped, Rows, selected
from forward.conformance import check_derivatives
from forward.fem.finer import FromStart, Otherwise, limit
from forward.model import MeshError, Saturation, Work
from forward.pointwise import FunctionModel, FunctionSolution

pytestmark = pytest.mark.unit
POINT = np.array([0.7, 1.2])
FACTORS = np.array([2.0, 4.0, 1.25])


@dataclass(frozen=True)
class OnMesh(FunctionModel):
    """A function whose mesh makes errors (m,), of which estimates see a part."""

    errors: np.ndarray | None = None

    def solve(self, parameters, guess=None):
        found = super().solve(parameters, guess)
        return SolvedOnMesh(self, found.parameters, found.outputs)


class SolvedOnMesh(FunctionSolution):
    def mesh_error(self):
        seen = (self.model.errors - 0.01) / FACTORS
        return MeshError(seen, np.zeros(0), 1.0, 0.1, Work(), nonlinearity=0.1)

    def saturation(self, spare=np.inf):
        return Saturation(FACTORS, 1.5, 1.6, shifts=np.full(3, 0.01), doubts=np.array([0.1, 0.2, 0.3]))


def on(error):
    """A model of three outputs, with an error of its mesh or without one."""
    errors = error * np.array([0.3, -0.2, 0.5])

    def values(p):
        return np.array([np.exp(p[0]) * p[1], np.sin(p[0] * p[1]), p[0] ** 3]) - errors

    def slopes(p):
        c = np.cos(p[0] * p[1])
        return np.array([[np.exp(p[0]) * p[1], np.exp(p[0])], [p[1] * c, p[0] * c], [3 * p[0] ** 2, 0]])

    return OnMesh(values, ("a", "b"), ("u", "v", "w"), slopes, errors)


def sums(model):
    S = csr_matrix(np.array([[1.0, -2.0, 0.0], [0.0, 3.0, 0.0], [0.5, 0.25, 1.0], [0.0, 0.0, -1.0]]))
    return Rows(model, S, ("p", "q", "r", "s"))


def tied(model):
    """Parameters a = 2 q + 0.3 and b = q − r."""
    A = csr_matrix(np.array([[2.0, 0.0, 0.0], [1.0, -1.0, 0.0]]))
    return Mapped(model, Sparse(A, np.array([0.3, 0.1])), ("q", "r", "unused"))


def joined(*models):
    return Joined(models, tuple(f"{name} {i}" for i, model in enumerate(models) for name in model.outputs))


def between(error):
    """Two meshes, the second with twice the error; beside each other meshes where these have no answer."""
    both = joined(on(error), tied_back(on(2 * error)))
    found = limit(FromStart(both, np.array([0.5, 1.0])), csr_matrix(np.eye(3)), on(0.0).outputs, 0.7)
    return Otherwise(found, found)


def tied_back(model):
    return Mapped(model, Sparse(csr_matrix(np.array([[1.0, 0.0], [0.5, 1.0]])), np.zeros(2)), ("a", "b"))


def plain():
    return FunctionModel(lambda p: p**2, ("a", "b"), ("s", "t"), lambda p: np.diag(2 * p))


COMBINED = {
    "some outputs": lambda error: selected(on(error), (2, 0, 2)),
    "sums": lambda error: sums(on(error)),
    "sums of sums": lambda error: selected(sums(on(error)), (3, 0)),
    "other parameters": lambda error: tied(on(error)),
    "two": lambda error: joined(on(error), on(-2 * error)),
    "two, of which one has no mesh": lambda error: joined(plain(), on(error)),
    "sums of two, of other parameters": lambda error: tied(selected(joined(plain(), sums(on(error))), (5, 0, 2))),
    "two meshes": between,
}


def check_mesh_errors(model, exact, point):
    """A model with its calibrated error of the mesh is the model without that error."""
    solution, expected = model.solve(point), exact.solve(point).outputs
    found = solution.outputs + solution.mesh_error().calibrated(solution.saturation()).outputs
    off = np.abs(found - expected) > 1e-10 * np.abs(expected).max()
    assert not off.any(), np.array(model.outputs)[off]


@pytest.mark.parametrize("made", COMBINED.values(), ids=COMBINED)
def test_a_combination_conforms(made):
    point = np.array([0.7, 1.2, 0.4])[: len(made(1.0).parameters)]
    check_derivatives(made(1.0), point, np.ones(len(point))).require()
    check_mesh_errors(made(1.0), made(0.0), point)


def test_a_wrong_sign_of_a_mesh_error_is_seen():
    class Turned(Rows):
        def solve(self, parameters, guess=None):
            found = super().solve(parameters, guess)
            return type(
                "", (), {"outputs": -found.outputs, "mesh_error": found.mesh_error, "saturation": found.saturation}
            )

    wrong = Turned(on(1.0), csr_matrix(-np.eye(3)), ("u", "v", "w"))
    with pytest.raises(AssertionError, match="'u', 'v'"):
        check_mesh_errors(wrong, on(0.0), POINT)


def test_some_outputs():
    """Of one of them twice; calibrations are those of what is selected."""
    model = selected(on(1.0), (2, 0, 2))
    assert model.outputs == ("w.0", "u", "w.1")
    found = model.solve(POINT)
    np.testing.assert_array_equal(found.outputs, on(1.0).solve(POINT).outputs[[2, 0, 2]])
    factors = found.saturation()
    assert factors.outputs.tolist() == [1.25, 2.0, 1.25]
    assert factors.doubts.tolist() == [0.3, 0.1, 0.3]
    assert selected(FunctionModel(np.sin, ("a",), ("u",)), (0,)).solve(np.ones(1)).saturation() is None
