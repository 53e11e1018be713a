"""The search for an equilibrium on small dense systems of which the solution is known."""

from types import SimpleNamespace

import numpy as np
import pytest

from forward.model import Stability, Work
from forward.solvers.acceptance import Diverged, Search, Unstable, converged
from forward.solvers.newton import newton
from forward.solvers.settings import SolverSettings
from forward.solvers.system import Residual

pytestmark = pytest.mark.unit
STIFFNESS = np.array([[4.0, -1.0], [-1.0, 3.0]])


class Springs:
    """K u + u³ = load · f, of which every state is an equilibrium under its own forces."""

    contact = False

    def __init__(self, state, sign=1.0):
        self.work, self.sign = Work(), sign
        self.force = sign * (STIFFNESS @ state + state**3)
        self.load = 1.0

    def in_words(self, fraction):
        return ""

    def at_load(self, fraction):
        self.load = fraction

    def on_target(self, u):
        return u

    def residual(self, u):
        vector = self.sign * (STIFFNESS @ u + u**3) - self.load * self.force
        return Residual(vector, float(np.linalg.norm(vector)), float(np.linalg.norm(self.load * self.force)), 0.0)

    def rounding(self, u, scale):
        return 1e-15 * scale

    def tangent(self, u):
        return self.sign * (STIFFNESS + np.diag(3 * u**2))

    def factorise(self, u, *, curved=True, last=None):
        self.factor = self.tangent(u)
        return 0.0

    def solve(self, right):
        return np.linalg.solve(self.factor, right)

    def total(self, values):
        return values

    def curvature(self, move, change):
        return float(move @ change)

    def weights(self):
        return np.ones(2)

    def norm(self, x):
        return float(np.linalg.norm(x))

    def smallest_jacobian(self, u):
        return 1.0

    def inertia(self):
        return int((np.linalg.eigvalsh(self.factor) < 0).sum())

    def negative_eigenvalues(self, u):
        return int((np.linalg.eigvalsh(self.tangent(u)) < 0).sum())


STATE = np.array([0.8, -0.5])


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4, 1e-6, 1e-8])
def test_the_tolerance_is_kept_and_ends_the_search(tolerance):
    system = Springs(STATE)
    search = Search(system, SolverSettings(kind="newton", tolerance=tolerance))
    found, iterations = newton(search, np.zeros(2), 1.0)
    residuals = [float(line.rsplit(" ", 1)[1]) for line in search.history if "residual" in line]
    assert residuals[0] == 1.0
    assert found.residual <= tolerance
    assert (np.array(residuals[:-1]) > tolerance).all()  # it has not gone on for nothing
    assert len(residuals) == iterations + 1
    assert found.stability == Stability.COUNTED
    np.testing.assert_allclose(found.state, STATE, atol=tolerance * np.linalg.norm(system.force) / 2)


def test_what_counts_as_an_equilibrium():
    system = SimpleNamespace(rounding=lambda u, scale: 1e-3 * scale)

    def is_one(size, before=(), *, gap=0.0, volume=0.0, scale=2.0, tolerance=1e-6):
        sizes = list(before)
        return converged(system, tolerance, np.zeros(1), Residual(np.zeros(1), size, scale, gap, volume), sizes)

    assert is_one(2e-6)
    assert not is_one(2.01e-6)
    assert not is_one(1e-9, gap=1e-3)
    assert not is_one(1e-9, volume=3e-6)
    assert not is_one(1e-3, before=[1.0])  # it still falls
    assert is_one(1e-3, before=[1.5e-3])  # rounding
    assert not is_one(3e-3, before=[3e-3])
    assert is_one(0.0, scale=0.0)


def test_states_that_are_not_stable_are_refused():
    with pytest.raises(Unstable, match="2 negative eigenvalues"):
        newton(Search(Springs(STATE, sign=-1.0), SolverSettings(kind="newton")), np.zeros(2), 1.0)
    with pytest.raises(Diverged, match="no convergence in 1 iterations"):
        newton(Search(Springs(STATE), SolverSettings(kind="newton", iterations=1)), np.zeros(2), 1.0)
