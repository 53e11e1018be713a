"""Multilevel chaos: levels that converge to the model, honest errors, and far less work than Newton's method takes."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from forward.model import Guess, ReferenceSolution, SolveError, Stability, Work
from forward.pointwise import FunctionModel, OneByOne
from tests.launch import run_script
from uq.evaluation.checkpoint import Checkpoint
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.request import Request
from uq.inputs.distributions import Beta, Uniform
from uq.inputs.random_parameters import Inputs
from uq.methods.multilevel_chaos import MultilevelChaos
from uq.surrogates.basis import gauss, hyperbolic, orthonormal
from uq.surrogates.expansion import Expansion
from uq.surrogates.field_regression import StateExpansion
from uq.surrogates.linearisation import linearise

INPUTS = Inputs({"a": Uniform(lower=0.0, upper=1.0), "b": Beta(a=2, b=2, lower=0.0, upper=1.0)})
TOLERANCE = 1e-10


pytestmark = pytest.mark.usefixtures("few_draws")


def exact(p):
    """The state (3,) that the solver below approaches."""
    return np.array([np.exp(p[0]) / (1.5 + p[1]), (1 + p[0]) * (1 + p[1]) ** 2, 1.0 + 0 * p[0]])


@dataclass(frozen=True)
class Approached:
    """A solution whose error a solver has divided by a constant several times."""

    outputs: np.ndarray
    state: np.ndarray
    residual: float
    converged: bool
    work: Work
    stability: Stability = Stability.NOT_TESTED


class Whole:
    """All three unknowns, on one rank."""

    displacements = 3

    @staticmethod
    def gather(rows):
        return rows

    @staticmethod
    def scatter(rows):
        return rows


@dataclass(frozen=True)
class Contraction(OneByOne):
    """A model of which every iteration leaves a part of the error; outputs are its first two unknowns."""

    left: float = 0.1
    fails: float = np.inf
    parameters: tuple[str, ...] = INPUTS.names
    outputs: tuple[str, ...] = ("f", "g")
    differentiable: bool = False
    space: type = Whole

    def solve(self, parameters, guess=None):
        start, iterations = (None, None) if guess is None else (guess.state, guess.iterations)
        if parameters[0] > self.fails:
            raise SolveError("too far")
        truth = exact(parameters)
        state, made = (np.zeros(3) if start is None else start), 0
        while np.abs(state - truth).max() > TOLERANCE and (iterations is None or made < iterations):
            state, made = truth + self.left * (state - truth), made + 1
        residual = float(np.abs(state - truth).max())
        return Approached(state[:2], state, residual, residual <= TOLERANCE, Work(residuals=made))


def truth():
    points, weights = gauss(INPUTS, 12)
    values = np.array([exact(p) for p in points])
    mean = weights @ values
    return mean, np.sqrt(weights @ (values - mean) ** 2)


def test_levels_converge_to_the_model():
    data = MultilevelChaos(first="mean", tolerance=1e-3).run(INPUTS, SerialEvaluate(Contraction()))
    mean, std = truth()
    for prefix in ("", "control_"):
        for name, value in (("mean", mean), ("std", std)):
            errors = np.abs(data[f"{prefix}{name}"].to_numpy() - value[:2])
            assert (errors < 4 * data[f"{prefix}{name}_error"].to_numpy() + 1e-13).all()
            assert (errors < 1e-3 * value[:2]).all()
    np.testing.assert_allclose(data["field_mean"].to_numpy().ravel(), mean, rtol=3e-4)
    np.testing.assert_allclose(data["field_std"].to_numpy().ravel(), std, rtol=1e-3, atol=1e-12)
    levels = data.sizes["level"]
    assert 3 <= levels < 10
    assert f"tolerance 0.001 met: moments changed by {data['level_change'][-1].item():.3g}" in data.attrs["stopped"]
    assert data["level_change"][-1] <= 1e-3 < data["level_change"][0]
    # The last level, and only that, goes on to the solver's tolerance.
    assert data["level_iterations"].to_numpy().tolist() == [2] * (levels - 1) + [0]
    assert data["level_converged"].to_numpy().tolist() == [0] * (levels - 1) + [32]
    assert data["level_residual"][-1] <= TOLERANCE < data["level_residual"][-2]
    assert (data["level_work"].sel(operation="residuals")[:-1] == 2 * 32).all()
    # Each level has points of its own.
    assert data["points"].shape == (32, 2)
    np.testing.assert_allclose(Expansion.of(data).outputs(data["points"].to_numpy()), data["values"], rtol=1e-2)


def test_the_error_of_a_level_is_what_polynomials_and_iterations_leave():
    data = MultilevelChaos(first="mean", tolerance=1e-9, max_levels=8).run(INPUTS, SerialEvaluate(Contraction()))
    assert "tolerance 1e-09 not met" in data.attrs["stopped"]
    residuals = data["level_residual"].to_numpy()
    np.testing.assert_allclose(residuals[1] / residuals[0], 0.01, rtol=1)
    assert residuals[-2] > 0.2 * residuals[-3]  # stalled at the error of order 3
    assert data["level_iterations"][-1] == 0  # which is why the last level goes on


def test_samples_at_equilibrium_need_no_level_more():
    data = MultilevelChaos(iterations=60, tolerance=1e-2).run(INPUTS, SerialEvaluate(Contraction()))
    assert data["level_iterations"].to_numpy().tolist() == [60] * data.sizes["level"]
    assert data["level_converged"][-1] == 32


def test_a_model_without_a_state_is_fitted_twice():
    model = FunctionModel(lambda p: exact(p)[:2], INPUTS.names, ("f", "g"))
    data = MultilevelChaos(tolerance=1e-2).run(INPUTS, SerialEvaluate(model))
    assert data["level_residual"].to_numpy().tolist() == [0, 0]
    np.testing.assert_allclose(data["mean"], truth()[0][:2], rtol=1e-4)
    assert "field_mean" not in data
    # A polynomial of that order is found by either.
    model = FunctionModel(lambda p: 1 + p[0] * p[1] ** 2, INPUTS.names, ("f",))
    data = MultilevelChaos(tolerance=1e-9).run(INPUTS, SerialEvaluate(model))
    assert data["mean"].item() == pytest.approx(1 + 0.5 * 0.3, rel=1e-12)
    assert data["control_mean"].item() == pytest.approx(1.15, rel=1e-12)
    assert data["mean_error"].item() < 1e-12


@pytest.mark.slow
def test_claimed_errors_cover():
    mean, std = truth()
    runs = [MultilevelChaos(seed=s, fields=False).run(INPUTS, SerialEvaluate(Contraction())) for s in range(20)]
    for prefix in ("", "control_"):
        for name, value in (("mean", mean[0]), ("std", std[0])):
            errors = np.array([d[f"{prefix}{name}"].to_numpy()[0] - value for d in runs])
            claims = np.array([d[f"{prefix}{name}_error"].to_numpy()[0] for d in runs])
            assert (np.abs(errors) < 1.96 * claims).mean() >= 0.9, (prefix, name)
            # Not by being useless.
            assert np.median(claims) < 8 * np.sqrt((errors**2).mean()), (prefix, name)


def test_a_solver_that_gets_nowhere_is_seen():
    data = MultilevelChaos(iterations=1, max_levels=4).run(INPUTS, SerialEvaluate(Contraction(left=0.9)))
    assert (data["level_residual"][:3] > 0.1).all()
    assert data["level_change"][-1] > 0.1
    assert "not met" in data.attrs["stopped"]
    # What is reported is from equilibria all the same.
    np.testing.assert_allclose(data["mean"], truth()[0][:2], rtol=1e-3)


def test_a_budget_ends_between_levels_and_the_errors_know():
    data = MultilevelChaos(budget_seconds=1e-9, first="mean").run(INPUTS, SerialEvaluate(Contraction(left=0.5)))
    assert data.sizes["level"] == 1
    assert "all that budget_seconds = 1e-09 pays for" in data.attrs["stopped"]
    assert (np.abs(data["mean"].to_numpy() - truth()[0][:2]) < 2 * data["mean_error"].to_numpy()).all()


def test_failures_are_left_out_and_said():
    data = MultilevelChaos(samples=64).run(INPUTS, SerialEvaluate(Contraction(fails=0.95)))
    assert 0 < int((~data["ok"]).sum()) < 10
    assert "samples have no answer" in data.attrs["note"]
    assert data["level_converged"][-1] == int(data["ok"].sum())


def test_settings_that_cannot_work_are_refused():
    with pytest.raises(ValueError, match="10 terms, expected more samples"):
        MultilevelChaos(samples=10).run(INPUTS, SerialEvaluate(Contraction()))
    correlated = Inputs(INPUTS.marginals, (("a", "b", 0.5),))
    with pytest.raises(ValueError, match=r"independent parameters.*'multilevel-chaos'"):
        MultilevelChaos().run(correlated, SerialEvaluate(Contraction()))
    assert MultilevelChaos().planned(2) == 1 + 10 * 32
    assert MultilevelChaos(samples=20, max_levels=3).planned(2) == 61


def test_an_expansion_predicts_and_is_part_of_the_name_of_a_block(tmp_path):
    basis = orthonormal(INPUTS, hyperbolic(2, 3, 1.0))
    rng = np.random.default_rng(0)
    start = StateExpansion(basis, rng.random((10, 3)), ReferenceSolution(INPUTS.mean, np.zeros(3), INPUTS.std))
    guess = start.on(Contraction())
    reference = guess(INPUTS.mean).reference
    points = rng.random((5, 2))
    for point, row in zip(points, basis.values(points), strict=True):
        np.testing.assert_array_equal(basis.at(point), row)
        np.testing.assert_allclose(guess(point).state, row @ start.coefficients, rtol=1e-14)
    np.testing.assert_array_equal(reference.parameters, INPUTS.mean)
    checkpoint = Checkpoint(tmp_path, "study")
    other = replace(start, coefficients=start.coefficients * (1 + 1e-15))
    keys = {checkpoint.key(Request(points, start=s, iterations=i)) for s in (start, other, None) for i in (None, 1, 2)}
    assert len(keys) == 9


# --- the finite-element beam ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def beam():
    from mpi4py import MPI

    from workflows.config.study import load as load_study

    study = load_study(Path(__file__).parent.parent.parent.parent / "configs" / "tiny.toml")
    return study, study.model.build(MPI.COMM_SELF, study.inputs.names)


@pytest.mark.fem
def test_the_beam_by_corrections_is_the_beam_by_newton(beam):
    from mpi4py import MPI

    study, model = beam
    textbook = study.model.model_copy(update={"solver": study.model.solver.model_copy(update={"kind": "newton"})})
    method = MultilevelChaos(seed=1)
    data = method.run(study.inputs, SerialEvaluate(model))
    published = method.model_copy(update={"first": "mean", "iterations": 1}).run(
        study.inputs, SerialEvaluate(textbook.build(MPI.COMM_SELF, study.inputs.names))
    )
    assert "met" in data.attrs["stopped"]
    assert "met" in published.attrs["stopped"]
    for name in ("mean", "std"):
        spread = np.hypot(data[f"{name}_error"], published[f"{name}_error"])
        assert (np.abs(data[name] - published[name]) <= 2 * spread).all()
        np.testing.assert_allclose(data[name], published[name], rtol=1e-3)
    counts = {n: d["level_work"].sum("level").to_series() for n, d in (("this", data), ("published", published))}
    # Those of the last level whose negative eigenvalues were counted.
    assert counts["this"]["factorisations"] == counts["this"]["assemblies"] < 3
    assert counts["published"]["factorisations"] > 100
    # An iteration is a residual and a back-substitution, after the residual of the start.
    first = data["level_work"].isel(level=0).to_series()
    assert first["back_substitutions"] == 2 * 32
    assert first["residuals"] == 3 * 32
    expansion = Expansion.of(data)
    point = study.inputs.points(np.array([[0.3, 0.8]]))
    solved = model.solve(point[0])
    np.testing.assert_allclose(expansion.outputs(point)[0], solved.outputs, rtol=3e-4)
    field = model.space.gather(solved.state[None, :])[0]
    np.testing.assert_allclose(expansion.displacements(point).ravel(), field, atol=3e-4 * np.abs(field).max())


@pytest.mark.fem
def test_a_chaos_prediction_saves_corrections(beam):
    study, model = beam
    evaluate, inputs = SerialEvaluate(model), study.inputs
    centre = linearise(inputs, evaluate)
    basis = orthonormal(inputs, hyperbolic(2, 4, 1.0))
    points = inputs.points(np.random.default_rng(0).random((40, 2)))
    states = model.space.gather(
        np.array([model.solve(p, Guess(centre.prediction.on(model)(p).state)).state for p in points])
    )
    coefficients = np.linalg.lstsq(basis.values(points), states, rcond=None)[0]
    start = StateExpansion(basis, coefficients, centre.reference)
    fresh = inputs.points(np.random.default_rng(1).random((20, 2)))
    tangent, expanded = (evaluate(Request(fresh, start=s)) for s in (centre.prediction, start))
    np.testing.assert_allclose(expanded.outputs, tangent.outputs, rtol=1e-7)
    corrections = [e.work[:, 3].mean() for e in (tangent, expanded)]
    assert corrections[1] < 0.8 * corrections[0]


@pytest.mark.slow
@pytest.mark.fem
@pytest.mark.mpi
def test_ranks_and_restarts_change_no_bit(tmp_path):
    script = """
import sys
from pathlib import Path
from mpi4py import MPI
from uq.evaluation.checkpoint import Checkpoint
from uq.evaluation.ensemble import Ensemble
from uq.methods.multilevel_chaos import MultilevelChaos
from workflows.config.study import load
from workflows.results.directory import write_dataset

study = load(Path("configs/tiny.toml"))
ensemble = Ensemble.split(MPI.COMM_WORLD)
model = study.model.build(ensemble.group, study.inputs.names)
method = MultilevelChaos(samples=16, max_levels=3)

class Killed(Exception):
    pass

def run(evaluate, requests):
    left = [requests]
    class Counting:
        def __getattr__(self, name):
            return getattr(evaluate, name)
        def __call__(self, request):
            left[0] -= 1
            if left[0] < 0:
                raise Killed
            return evaluate(request)
    return method.run(study.inputs, Counting())

for requests in ((3, 99) if len(sys.argv) > 2 else (99,)):
    checkpoint = Checkpoint(Path(sys.argv[2]), "tiny") if len(sys.argv) > 2 else None
    try:
        data = ensemble.run(model, lambda evaluate: run(evaluate, requests), checkpoint=checkpoint)
    except Killed:
        continue
if data is not None:
    write_dataset(Path(sys.argv[1]), data)
"""
    for ranks, further in ((1, []), (2, [tmp_path / "blocks"])):
        done = run_script(ranks, script, tmp_path / f"{ranks}.nc", *further)
        assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "1.nc").read_bytes() == (tmp_path / "2.nc").read_bytes()
    assert len(list((tmp_path / "blocks" / "evaluations").iterdir())) == 1 + 3 * 16
