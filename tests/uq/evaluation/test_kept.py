"""Solutions and derivatives that a rank group has stored are not computed again."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from mpi4py import MPI

from forward.model import FunctionModel, Guess, InadmissibleError, OneByOne, SolveError
from tests.states import WithState
from uq.evaluation.checkpoint import Checkpoint
from uq.evaluation.kept import KeptModel

NAMES = ("a", "b")
POINT = np.array([0.3, -0.2])


@dataclass
class Counted(OneByOne):
    """A model that counts what is asked of it."""

    model: FunctionModel
    asked: list[str] = field(default_factory=list)

    def __getattr__(self, name):
        return getattr(self.model, name)

    def solve(self, parameters, guess=None):
        self.asked.append("solve")
        return Derivatives(self.model.solve(parameters, guess), self.asked)


@dataclass
class Derivatives:
    """Its solutions."""

    solution: object
    asked: list[str]

    def __getattr__(self, name):
        found = getattr(self.solution, name)
        if name in ("tangent", "adjoint", "state_tangent"):
            self.asked.append(name)
        return found


def function(p):
    if p[0] > 1:
        raise InadmissibleError("no such material")
    if p[1] > 1:
        raise SolveError("no answer")
    return np.array([p[0] ** 2, p[0] * p[1], p[1]])


def jacobian(p):
    return np.array([[2 * p[0], 0], [p[1], p[0]], [0, 1]])


def kept(folder, label="one", identity="study"):
    model = Counted(WithState(function, NAMES, ("u", "v", "w"), jacobian, lambda p: np.array([p[0], p[0] * p[1]])))
    return KeptModel(model, MPI.COMM_SELF, Checkpoint(folder, identity), label)


def use(model):
    """Everything that an inversion asks of a solution."""
    solution = model.solve(POINT)
    moved = solution.tangent(np.eye(2))
    one = solution.tangent(np.array([1.0, 2.0]))
    back = solution.adjoint(moved)
    step = solution.state_tangent(np.array([0.1, 0.0]))
    there = model.solve(POINT + 0.1, Guess(solution.state + step))
    return [solution.outputs, solution.state, moved, one, back, step, there.outputs, there.adjoint(np.ones(3))]


def test_nothing_is_computed_twice(tmp_path):
    first, again = kept(tmp_path), kept(tmp_path)
    found = use(first)
    assert first.model.asked == ["solve", *["tangent"] * 2, "adjoint", "state_tangent", "solve", "adjoint"]
    np.testing.assert_allclose(found[2], jacobian(POINT).T)
    for one, other in zip(found, use(again), strict=True):
        np.testing.assert_array_equal(one, other)
    assert again.model.asked == []
    assert [one.work.tolist() for one in again.log] == [one.work.tolist() for one in first.log]
    again.forget()
    assert not list((tmp_path / "evaluations").iterdir())


def test_what_is_missing_is_found_at_the_stored_state(tmp_path):
    """A derivative along another direction: one solve, which starts from the state, and that derivative alone."""
    use(kept(tmp_path))
    again = kept(tmp_path)
    use(again)
    solution = again.solve(POINT)
    np.testing.assert_allclose(solution.tangent(np.array([0.0, 3.0])), 3 * jacobian(POINT)[:, 1])
    solution.tangent(np.array([3.0, 0.0]))
    assert again.model.asked == ["solve", "tangent", "tangent"]


def test_other_models_and_studies_are_others(tmp_path):
    use(kept(tmp_path))
    for other in (kept(tmp_path, label="two"), kept(tmp_path, identity="other")):
        use(other)
        assert len(other.model.asked) == 7


def test_a_damaged_derivative_is_computed_again(tmp_path, capsys):
    first = kept(tmp_path)
    found = use(first)
    path = first.checkpoint.path(first.keys[3])  # an adjoint, after the state and two tangents
    bytes_ = bytearray(path.read_bytes())
    bytes_[-8] ^= 1
    path.write_bytes(bytes(bytes_))
    again = kept(tmp_path)
    np.testing.assert_array_equal(use(again)[4], found[4])
    assert again.model.asked == ["solve", "adjoint"]
    assert "computed again" in capsys.readouterr().err


@pytest.mark.parametrize(("at", "kind"), [((2.0, 0.0), InadmissibleError), ((0.0, 2.0), SolveError)])
def test_failures_are_kept(tmp_path, at, kind):
    told = []
    for asked in (["solve"], []):
        model = kept(tmp_path)
        with pytest.raises(SolveError) as raised:
            model.solve(np.array(at))
        assert type(raised.value) is kind
        assert model.model.asked == asked
        assert len(model.log[0].failures) == 1
        told.append((raised.value.reason, raised.value.history))
    assert told[0] == told[1]
