"""Predictions of the state that rise in order as samples come in."""

from dataclasses import replace

import numpy as np
import pytest
from mpi4py import MPI

from tests.launch import ROOT, TISSUQ, assert_same_bits, run, run_script
from uq.evaluation.evaluate import OfEvaluate, SerialEvaluate
from uq.evaluation.request import Prediction
from uq.inputs.distributions import Uniform
from uq.inputs.random_parameters import Inputs
from uq.methods import monte_carlo
from uq.methods.monte_carlo import MonteCarlo, SensitivityMonteCarlo
from uq.methods.quasi_monte_carlo import QuasiMonteCarlo
from uq.surrogates import growing
from uq.surrogates.field_regression import StateExpansion
from uq.surrogates.linearisation import linearise
from workflows.config.study import load


class Watched(OfEvaluate):
    """Passes requests on, and keeps them with what came of them."""

    def __init__(self, evaluate):
        self._evaluate = evaluate
        self.asked = []

    def on(self, model):
        return self

    def __call__(self, request):
        found = self._evaluate(request)
        self.asked.append((request, found))
        return found


@pytest.fixture(autouse=True)
def in_short_studies_too(monkeypatch):
    monkeypatch.setattr(growing, "WORTH", 2)
    monkeypatch.setattr(monte_carlo, "FEW", 128)


@pytest.fixture(scope="module")
def beam():
    study = load(ROOT / "configs" / "tiny.toml", ("model.body.cells=[4, 1, 1]",))
    return study.inputs, study.model.build(MPI.COMM_SELF, study.inputs.names)


def sampled(beam, method, monkeypatch=None):
    inputs, model = beam
    watched = Watched(SerialEvaluate(model))
    if monkeypatch is not None:
        monkeypatch.setattr(monte_carlo, "FEW", 10**9)
    return method.run(inputs, watched), watched.asked[1:]


@pytest.mark.few(1)
@pytest.mark.fem
@pytest.mark.parametrize(
    "kind", [MonteCarlo, pytest.param(SensitivityMonteCarlo, marks=pytest.mark.slow), QuasiMonteCarlo]
)
def test_later_samples_begin_closer_and_end_at_the_same_states(beam, kind, monkeypatch):
    method = kind(samples=128, **({"scrambles": 4} if kind is QuasiMonteCarlo else {}))
    dataset, asked = sampled(beam, method)
    plain, before = sampled(beam, method, monkeypatch)
    kinds = [type(request.start) for request, _ in asked]
    first = kinds.count(Prediction)
    assert kinds == [Prediction] * first + [StateExpansion] * (len(kinds) - first)
    assert sum(len(request.points) for request, _ in asked[:first]) == growing.LEARNT[0]
    assert all(isinstance(request.start, Prediction) for request, _ in before)
    work = [np.concatenate([found.work[:, 3] for _, found in part]) for part in (asked[:first], asked[first:])]
    assert work[1].mean() < 0.75 * work[0].mean()
    for name in plain.variables:
        if plain[name].dtype.kind == "f":
            np.testing.assert_allclose(dataset[name], plain[name], rtol=1e-5, atol=1e-9, err_msg=name)


@pytest.mark.fem
def test_the_order_rises_and_a_start_within_the_tolerance_costs_one_residual(beam, monkeypatch):
    inputs, model = beam
    monkeypatch.setattr(growing, "LEARNT", (16, 96))
    monkeypatch.setattr(monte_carlo, "FEW", 32)
    _, asked = sampled((inputs, model), MonteCarlo(samples=200))
    starts = [request.start for request, _ in asked]
    orders = [start.basis.indices.sum(axis=1).max() for start in starts if isinstance(start, StateExpansion)]
    assert len(orders) == 2
    assert orders[0] < orders[1]
    point = inputs.mean * 1.01
    centre = linearise(inputs, SerialEvaluate(model))
    guess = centre.prediction.on(model)(point)
    state = model.solve(point, guess).state
    # One residual; the screen for stability takes products, one back-substitution and one more product.
    (solution, _) = model.solve_many(np.array([point, point]), [replace(guess, state=state)] * 2)
    assert solution.work.back_substitutions == 1
    assert solution.work.residuals == 1 + len(model.reference._vectors) + 1
    np.testing.assert_allclose(solution.state, state, atol=1e-15)


def test_where_predictions_cannot_grow(beam):
    inputs, model = beam
    evaluate = SerialEvaluate(model)
    centre = linearise(inputs, evaluate)
    assert growing._candidates(inputs, centre, 127) is None
    assert [one.order for one in growing._candidates(inputs, centre, 128).sets] == [1, 2, 3, 4, 5, 6]
    assert growing._candidates(inputs, centre, 10**5).sets[-1].which.size <= growing.TERMS
    assert growing._candidates(inputs, replace(centre, slopes=centre.slopes[:0]), 1000) is None
    many = Inputs({f"x{i}": Uniform(lower=0.0, upper=1.0) for i in range(7)})
    assert growing._candidates(many, centre, 512) is None  # 36 functions of order 2 from 64 samples
    assert growing._candidates(many, centre, 1024) is not None
    _, asked = sampled(beam, MonteCarlo(samples=140, fields=False))
    assert len(asked) == 1


def test_an_expansion_that_is_worse_than_the_tangent_is_not_used(beam, monkeypatch):
    monkeypatch.setattr(growing.Growing, "_better", lambda self, fit, data: False)
    _, asked = sampled(beam, MonteCarlo(samples=130))
    assert len(asked) == 2
    assert all(isinstance(request.start, Prediction) for request, _ in asked)


KILLED = """
import os, sys
from uq.evaluation.checkpoint import Checkpoint
save, kept = Checkpoint.save, []

def killed(self, key, block):
    save(self, key, block)
    kept.append(key)
    if len(kept) == 25:
        os.kill(os.getpid(), 9)

Checkpoint.save = killed
from workflows.__main__ import main
main(sys.argv[1:])
"""


@pytest.mark.fem
@pytest.mark.mpi
@pytest.mark.slow
def test_the_same_bytes_on_groups_of_ranks_and_after_a_kill(tmp_path):
    """The first 64 samples are 16 blocks, and the second prediction is in use when it is killed."""
    study = ["run", "configs/tiny.toml", "--quiet", "--no-report", "--set", "model.body.cells=[2, 1, 1]"]
    study += ["--set", "method.samples=520", "--set", "accuracy.mesh_error=false", "--out"]
    assert run_script(None, KILLED, *study, tmp_path / "killed").returncode == -9
    for ranks, folder in ((None, "killed"), (3, "3")):
        done = run(ranks, TISSUQ, *study, tmp_path / folder)
        assert done.returncode == 0, done.stderr
    assert_same_bits(tmp_path / "killed", tmp_path / "3")
