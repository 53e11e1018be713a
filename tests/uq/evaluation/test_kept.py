"""Solves and blocks that a rank group has stored are not computed again."""

import io
import os
import pickle
from dataclasses import dataclass, field

import numpy as np
import pytest
from mpi4py import MPI

from forward.combine import Recorded
from forward.model import Guess, InadmissibleError, SolveError
from forward.pointwise import FunctionModel, OneByOne
from tests.states import WithState
from uq.evaluation.checkpoint import Checkpoint, _Reader
from uq.evaluation.evaluate import Recorder, SerialEvaluate
from uq.evaluation.kept import Kept, KeptSolves
from uq.evaluation.request import Request

NAMES = ("a", "b")
POINT = np.array([0.3, -0.2])


@dataclass
class Counted(OneByOne):
    """A model that counts what is asked of it."""

    model: FunctionModel
    asked: list[str] = field(default_factory=list)
    guesses: list[Guess | None] = field(default_factory=list)

    def __getattr__(self, name):
        return getattr(self.model, name)

    def solve(self, parameters, guess=None):
        self.asked.append("solve")
        self.guesses.append(guess)
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


def counted():
    return Counted(WithState(function, NAMES, ("u", "v", "w"), jacobian, lambda p: np.array([p[0], p[0] * p[1]])))


def kept(folder, label="one", identity="study"):
    return Recorded(counted(), KeptSolves(Kept(Checkpoint(folder, identity), MPI.COMM_SELF, label)))


def use(model):
    """Everything that an inversion asks of a solution."""
    solution = model.solve(POINT)
    moved = solution.tangent(np.eye(2))
    one = solution.tangent(np.array([1.0, 2.0]))
    back = solution.adjoint(moved)
    step = solution.state_tangent(np.array([0.1, 0.0]))
    there = model.solve(POINT + 0.1, Guess(solution.state + step))
    return [solution.outputs, solution.state, moved, one, back, step, there.outputs, there.adjoint(np.ones(3))]


def test_nothing_is_solved_twice(tmp_path):
    """What a restart solves for is the linearisation of a solution at its state, once, where a derivative is asked."""
    first, again = kept(tmp_path), kept(tmp_path)
    found = use(first)
    asked = ["solve", *["tangent"] * 2, "adjoint", "state_tangent", "solve", "adjoint"]
    assert first.model.asked == asked
    np.testing.assert_allclose(found[2], jacobian(POINT).T)
    for one, other in zip(found, use(again), strict=True):
        np.testing.assert_array_equal(one, other)
    assert again.model.asked == asked
    assert [guess is not None and guess.state is not None for guess in again.model.guesses] == [True, True]
    assert [one.work.tolist() for one in again.record.log] == [one.work.tolist() for one in first.record.log]
    assert [one.seconds.tolist() for one in again.record.log] == [one.seconds.tolist() for one in first.record.log]
    again.record.kept.forget()
    assert not list((tmp_path / "evaluations").iterdir())


def test_a_stored_solution_is_not_solved_for_without_derivatives(tmp_path):
    use(kept(tmp_path))
    again = kept(tmp_path)
    solution = again.solve(POINT)
    np.testing.assert_array_equal(solution.outputs, function(POINT))
    np.testing.assert_array_equal(solution.state, [POINT[0], POINT[0] * POINT[1]])
    assert (solution.converged, solution.work.snaps) == (True, 0)
    assert again.model.asked == []


def test_other_models_and_studies_are_others(tmp_path):
    use(kept(tmp_path))
    for other in (kept(tmp_path, label="two"), kept(tmp_path, identity="other")):
        use(other)
        assert len(other.model.asked) == 7


def test_a_damaged_solution_is_computed_again(tmp_path, capsys):
    first = kept(tmp_path)
    found = use(first)
    path = first.record.kept.checkpoint.path(first.record.kept.keys[0])
    bytes_ = bytearray(path.read_bytes())
    bytes_[-8] ^= 1
    path.write_bytes(bytes(bytes_))
    again = kept(tmp_path)
    np.testing.assert_array_equal(use(again)[4], found[4])
    assert again.model.guesses[0] is None
    assert "computed again" in capsys.readouterr().err


def test_blocks_of_a_request_are_solved_once(tmp_path):
    """Another label, or derivatives beside the values, are other blocks; the record is the same after a restart."""
    points = np.random.default_rng(0).uniform(0, 1.02, (40, 2))
    records, solves = [], []
    for label, tangents in (("one", False), ("one", False), ("one", True), ("two", False)):
        model, told, log = counted(), [], []
        where = Kept(Checkpoint(tmp_path, "study"), MPI.COMM_SELF, label)
        evaluate = Recorder(SerialEvaluate(model, lambda *given, told=told: told.append(given), kept=where), log=log)
        found = evaluate(Request(points, tangents=tangents))
        plain = SerialEvaluate(counted())(Request(points, tangents=tangents))
        np.testing.assert_array_equal(found.outputs, plain.outputs)
        assert [one.index for one in found.failures] == [one.index for one in plain.failures] != []
        assert (found.tangents is not None) == tangents
        assert np.sum(told, axis=0).tolist() == [40, len(found.failures)]
        assert len(where.keys) == 10
        records.append([(one.outputs.tobytes(), one.seconds.tobytes(), one.tangents) for one in log])
        solves.append(model.asked.count("solve"))
    assert solves == [40, 0, 40, 40]
    assert records[0] == records[1]


def test_a_block_with_errors_of_the_mesh_is_another(tmp_path):
    keys = []
    for request in (Request(POINT[None]), Request(POINT[None], mesh_errors=True)):
        where = Kept(Checkpoint(tmp_path, "study"), MPI.COMM_SELF, "one")
        found = SerialEvaluate(counted(), kept=where)(request)
        assert (found.mesh_errors is not None) == request.mesh_errors
        keys += where.keys
    assert len(set(keys)) == 2


@pytest.mark.parametrize(("at", "kind"), [((2.0, 0.0), InadmissibleError), ((0.0, 2.0), SolveError)])
def test_failures_are_kept(tmp_path, at, kind):
    told = []
    for asked in (["solve"], []):
        model = kept(tmp_path)
        with pytest.raises(SolveError) as raised:
            model.solve(np.array(at))
        assert type(raised.value) is kind
        assert model.model.asked == asked
        assert len(model.record.log[0].failures) == 1
        told.append((raised.value.reason, raised.value.history))
    assert told[0] == told[1]


@pytest.mark.unit
@pytest.mark.parametrize("harm", [os.system, print, np.load, eval, io.FileIO, pickle.loads])
def test_kept_steps_are_plain_data(harm):
    """A file that would call something is refused before it does."""

    class Harm:
        def __reduce__(self):
            return harm, ("x",)

    for protocol in range(2, pickle.HIGHEST_PROTOCOL + 1):
        with pytest.raises(pickle.UnpicklingError, match="is no plain data"):
            _Reader(io.BytesIO(pickle.dumps([1.0, Harm()], protocol))).load()
