"""Frames of a reduced model that follow moving parameters."""

import numpy as np
import pytest

from forward.reduced import stream
from forward.reduced.data import load, save
from forward.reduced.model import ReducedModel
from forward.reduced.stream import Stream, local
from tests.forward.reduced.test_model import (  # noqa: F401 - fixtures
    NOMINAL,
    SPREAD,
    full,
    reduction,
    small,
    snapshots,
)

pytestmark = pytest.mark.fem


@pytest.fixture
def model(small):  # noqa: F811
    return ReducedModel(small, small.parameters)


def at_mean(model):
    return Stream(model, local(model, model.data.nominal, None, SPREAD))


def test_frames_follow_the_equilibrium(model, small):  # noqa: F811
    stream = at_mean(model)
    way = NOMINAL + SPREAD * np.linspace(0, 1, 60)[:, None] * np.array([1, -1, 1, 0.5, 1, 0.5, 0])
    spread = np.array(small.about["spread"])
    smooth = [i for i, output in enumerate(small.outputs) if output.kind != "peak"]
    for at in way:
        frame = stream.frame(at)
        exact = model.reduced(at).outputs
        assert frame.corrections > 0
        assert (np.abs(frame.outputs - exact) < 1e-3 * spread)[smooth].all()


def test_errors_count_what_the_tangent_misses(model, small):  # noqa: F811
    """Of a largest stress, which stays on the tangent of local models that come late."""
    stream, asked = at_mean(model), NOMINAL
    peak = next(i for i, output in enumerate(small.outputs) if output.kind == "peak")
    missed, claimed = [], []
    for k in range(120):
        at = NOMINAL + SPREAD * np.sin(0.05 * k * np.array([1, 0.7, 1.2, 0.9, 1.1, 0.8, 0]))
        if k % 6 == 0:
            stream.moved(local(model, asked, None, SPREAD))
            asked = at
        frame = stream.frame(at)
        missed.append(abs(frame.outputs - model.reduced(at).outputs)[peak])
        claimed.append((frame.errors - stream.here.errors)[peak])
    assert 0.5 < np.median(claimed[12:]) / np.median(missed[12:]) < 2
    assert np.mean(np.array(missed[12:]) < 3 * np.array(claimed[12:])) > 0.8


def test_a_local_model_knows_errors_and_spread(model):
    solution = model.reduced(NOMINAL)
    uncertain = SPREAD * np.array([1, 0, 1, 0, 0, 0, 0])
    here = local(model, NOMINAL, None, uncertain)
    np.testing.assert_allclose(here.errors, solution.estimate.outputs)
    tangents = solution.tangent(np.diag(uncertain))
    np.testing.assert_allclose(here.spread, np.sqrt((tangents**2).sum(axis=0)))
    move = 1e-4 * SPREAD
    exact = model.reduced(NOMINAL + move).outputs - solution.outputs
    linear = Stream(model, here).linear(NOMINAL + move)
    np.testing.assert_allclose(linear.outputs - solution.outputs, exact, rtol=1e-2, atol=1e-12)
    assert linear.corrections == 0


def test_where_it_cannot_follow_it_says_so_and_catches_up(model):
    stream = at_mean(model)
    far = NOMINAL.copy()
    far[[0, 2, 4]] = 300, 1500, 0.03
    frame = stream.frame(far)
    assert stream.lost
    assert frame.corrections == 0
    near = NOMINAL + SPREAD
    stream.moved(local(model, near, None, SPREAD))
    assert not stream.lost
    found = stream.frame(near)
    np.testing.assert_allclose(found.outputs, model.reduced(near).outputs, rtol=1e-6)


def test_where_there_is_no_time_the_last_frame_moves_along_the_slopes(model, small):  # noqa: F811
    """An answer on time, the correction after it; with time again, or a step later, it is exact as before."""
    stream = at_mean(model)
    smooth = [i for i, output in enumerate(small.outputs) if output.kind != "peak"]
    spread = np.array(small.about["spread"])[smooth]
    stream.frame(NOMINAL)
    stream.takes = 1.0  # s: far more than there is
    at = NOMINAL + 0.3 * SPREAD
    frame = stream.frame(at, 1e-3)
    assert frame.corrections == 0
    assert stream.behind
    exact = model.reduced(at).outputs[smooth]
    first = np.abs(frame.outputs[smooth] - exact) / spread
    corrected = stream.frame(at, stream.takes + stream.besides)
    assert corrected.corrections > 0
    assert not stream.behind
    after = np.abs(corrected.outputs[smooth] - exact) / spread
    assert (after < 0.3 * first + 1e-9).all()
    further = stream.linear(at + 0.01 * SPREAD).outputs[smooth] - model.reduced(at + 0.01 * SPREAD).outputs[smooth]
    assert (np.abs(further) / spread < 0.3 * first + 1e-4).all()
    assert stream.takes < 1.0
    for _ in range(60):
        stream.frame(at)
    assert stream.frame(at + 0.02 * SPREAD, 0.5).corrections > 0


WRONG = (b'"soft"', b'"1"', b"true", b"null", b"NaN", b"1e999", b"1" * 400)


def test_the_loop_answers_and_refuses_in_one_line(small, tmp_path, monkeypatch):  # noqa: F811
    import json

    from workflows.http import listen
    from workflows.live.loop import Loop

    save(small, tmp_path / "model.npz")
    monkeypatch.setattr("workflows.live.loop.WITHIN", np.inf)  # a busy machine has time for corrections too
    loop = Loop(tmp_path / "model.npz", listen("127.0.0.1", 0, "--port"))
    try:
        told = loop.greeting()
        assert told["outputs"] == [output.name for output in load(tmp_path / "model.npz").outputs]
        assert told["local"] == ["stress"]
        answer = loop.answer(b'{"id": 7, "loads.pressure.size": 210}')
        assert answer["id"] == 7
        assert answer["corrections"] > 0
        assert not answer["late"]
        late = loop.answer(b'{"loads.pressure.size": 212}', late=True)
        assert late["late"]
        assert late["corrections"] == 0
        # A frame that was far from balance says so, and so do those on its tangent, until one is in balance.
        assert "doubt" not in answer
        loop.stream.modes = 0.98 * loop.stream.modes
        monkeypatch.setattr(stream, "MOST", 1)
        for unbalanced in (True, False):
            frame = loop.stream.frame(loop._now)
            assert (frame.residual > stream.OPEN) == unbalanced
            late = loop.answer(b"{}", late=True)
            assert ("out of balance" in late.get("doubt", "")) == unbalanced == (set(late["errors"]) == {None})
        assert "outside the trained range" in loop.answer(b'{"loads.pressure.size": 900}')["outside"]
        assert "expected one of" in loop.answer(b'{"x": 1}')["error"]
        for wrong in (b"no", b"[" * 9999, *(b'{"id": 3, "loads.pressure.size": %s}' % x for x in WRONG)):
            assert set(loop.answer(wrong)) <= {"id", "error"}, wrong
        # Where there is no answer of the model, nothing is said of its errors; all of it is JSON.
        far = loop.answer(b'{"loads.pressure.size": 1e300}')
        assert "too far" in far["doubt"]
        assert set(far["errors"]) == set(far["spread"]) == {None}
        json.dumps([answer, late, far], allow_nan=False)
    finally:
        loop.close()
