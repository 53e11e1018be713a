"""Monte Carlo methods on an analytic model and on the finite-element beam."""

import numpy as np
import pytest
from scipy.special import roots_jacobi

from forward.model import SolveError
from forward.pointwise import FunctionModel
from tests.functions import AtOnce
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.request import Request
from uq.inputs.distributions import Uniform
from uq.inputs.random_parameters import Inputs
from uq.methods.local_sensitivity import LocalSensitivity
from uq.methods.monte_carlo import MonteCarlo, SensitivityMonteCarlo

INPUTS = Inputs({"a": Uniform(lower=0.0, upper=1.0), "b": Uniform(lower=1.0, upper=2.0)})
MODEL = FunctionModel(lambda p: [p[0] + p[1] ** 2 / 2], ("a", "b"), ("f",), lambda p: [[1, p[1]]])
MEAN = 1 / 2 + 7 / 6
VARIANCE = 1 / 12 + (31 / 5 - 49 / 9) / 4


@pytest.mark.parametrize("method", [MonteCarlo, SensitivityMonteCarlo])
def test_closed_form_within_the_error(method):
    data = method(samples=4000, seed=3).run(INPUTS, AtOnce(MODEL))
    assert abs(data["mean"].item() - MEAN) < 4 * data["mean_error"].item()
    assert abs(data["std"].item() - VARIANCE**0.5) < 4 * data["std_error"].item()


def test_correlated_inputs():
    inputs = Inputs(INPUTS.marginals, (("a", "b", 0.8),))
    plain = MonteCarlo(samples=60_000).run(inputs, AtOnce(MODEL))
    controlled = SensitivityMonteCarlo(samples=2_000, seed=9).run(inputs, AtOnce(MODEL))
    for name in ("mean", "std"):
        error = np.hypot(plain[f"{name}_error"].item(), controlled[f"{name}_error"].item())
        assert abs(plain[name].item() - controlled[name].item()) < 4 * error


def test_tolerance_is_met_and_said():
    data = MonteCarlo(tolerance=0.005).run(INPUTS, AtOnce(MODEL))
    assert data["mean_error"].item() <= 0.005 * data["mean"].item()
    assert "tolerance 0.005 met" in data.attrs["stopped"]
    short = MonteCarlo(tolerance=1e-6, samples=100).run(INPUTS, SerialEvaluate(MODEL))
    assert short.sizes["sample"] == 100
    assert "not met" in short.attrs["stopped"]


def test_a_longer_run_begins_with_the_shorter_one():
    short, long = (MonteCarlo(samples=n, seed=4).run(INPUTS, SerialEvaluate(MODEL)) for n in (10, 30))
    np.testing.assert_array_equal(long["values"][:10], short["values"])


def test_failures_are_left_out_and_counted():
    def fails_sometimes(p):
        if p[0] > 0.9:
            message = "gone"
            raise SolveError(message)
        return p[0]

    model = FunctionModel(fails_sometimes, ("a", "b"), ("f",), lambda p: [[1, 0]])
    data = SensitivityMonteCarlo(samples=200).run(INPUTS, SerialEvaluate(model))
    failed = int((~data.ok).sum())
    assert 0 < failed < 60
    assert f"{failed} of 200 samples have no answer" in data.attrs["note"]
    assert np.isfinite(data["mean"].item())


def test_no_answer_at_the_mean_is_an_error():
    def always_fails(p):
        message = "gone"
        raise SolveError(message)

    with pytest.raises(SolveError, match="at the mean parameters: gone"):
        MonteCarlo(samples=5).run(INPUTS, SerialEvaluate(FunctionModel(always_fails, ("a", "b"), ("f",))))


def test_methods_that_need_derivatives_say_so():
    model = FunctionModel(lambda p: p[0], ("a", "b"), ("f",))
    for method in (SensitivityMonteCarlo(samples=5), LocalSensitivity()):
        with pytest.raises(ValueError, match="no derivatives"):
            method.run(INPUTS, SerialEvaluate(model))
    assert MonteCarlo(samples=5).run(INPUTS, SerialEvaluate(model))["mean"].shape == (1,)


# --- the finite-element beam ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def beam():
    """The tiny beam, and its mean and standard deviation by tensor Gauss quadrature of the same model."""
    from pathlib import Path

    from mpi4py import MPI

    from workflows.config.study import load

    study = load(Path(__file__).parent.parent.parent.parent / "configs" / "tiny.toml")
    evaluate = SerialEvaluate(study.model.build(MPI.COMM_SELF, study.inputs.names))
    x, weights = roots_jacobi(5, 1, 1)  # Beta(2, 2) on [-1, 1]
    lower, upper = np.array([[m.lower, m.upper] for m in study.parameters.values()]).T
    grid = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1).reshape(-1, 2)
    values = evaluate(Request(lower + (upper - lower) * (grid + 1) / 2)).outputs
    w = np.outer(weights, weights).ravel() / weights.sum() ** 2
    mean = w @ values
    return study.inputs, evaluate, mean, np.sqrt(w @ (values - mean) ** 2)


@pytest.mark.fem
@pytest.mark.parametrize("method", [MonteCarlo, SensitivityMonteCarlo])
def test_beam_agrees_with_gauss_quadrature(beam, method):
    inputs, evaluate, mean, std = beam
    data = method(samples=64 if method is MonteCarlo else 128, seed=2).run(inputs, evaluate)
    assert (np.abs(data["mean"] - mean) < 4 * data["mean_error"]).all()
    assert (np.abs(data["std"] - std) < 4 * data["std_error"]).all()
    if method is SensitivityMonteCarlo:
        assert data["variance_ratio"].sel(output="uy_max").item() >= 100
        assert (np.abs(data["mean"] / mean - 1) < 1e-3).all()


@pytest.fixture(scope="module")
def controlled(beam):
    inputs, evaluate, _, _ = beam
    return SensitivityMonteCarlo(samples=64, seed=5).run(inputs, evaluate)


@pytest.mark.fem
def test_field_agrees_with_scalar(controlled):
    """The largest displacement is that of a corner of the free end at every sample, so its moments are the field's."""
    data = controlled
    tip = np.abs(data["field_nominal"].sel(component="y")).argmax().item()
    for name, sign in (("mean", -1), ("std", 1)):
        field = data[f"field_{name}"].sel(component="y")[tip].item()
        assert sign * field == pytest.approx(data[name].sel(output="uy_max").item(), rel=1e-6)
        # Errors of outputs count besides how skewed their samples are.
        error = data[f"field_{name}_error"].sel(component="y")[tip].item()
        assert 1 - 1e-6 < data[f"{name}_error"].sel(output="uy_max").item() / error < 1.5


@pytest.mark.fem
def test_published_coefficient_is_close_to_optimal(beam, controlled):
    inputs, evaluate, _, _ = beam
    one, optimal = controlled, SensitivityMonteCarlo(samples=64, seed=5, coefficient="optimal").run(inputs, evaluate)
    assert (np.abs(optimal["coefficient"] - 1) < 0.1).all()
    assert (np.abs(one["mean"] - optimal["mean"]) < 4 * (one["mean_error"] + optimal["mean_error"])).all()
