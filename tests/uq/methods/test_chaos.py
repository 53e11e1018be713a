"""Polynomial chaos: exact on polynomials, honest about its errors, the same for fields as for outputs."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from forward.model import SolveError
from forward.pointwise import FunctionModel
from tests.launch import on_kept_ranks
from uq.evaluation.checkpoint import Checkpoint
from uq.evaluation.ensemble import Ensemble
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.hdf5 import stored_dataset
from uq.evaluation.request import FieldSum, Request
from uq.findings import findings
from uq.inputs.distributions import Beta, Gamma, LogNormal, LogUniform, Normal, Triangular, TruncatedNormal, Uniform
from uq.inputs.random_parameters import Inputs
from uq.methods import chaos
from uq.methods.chaos import Chaos
from uq.surrogates import basis as bases
from uq.surrogates.basis import gauss, hyperbolic, orthonormal
from uq.surrogates.expansion import Expansion, OutsideRangeWarning
from uq.surrogates.linearisation import linearise
from uq.surrogates.regression import Regression

MARGINALS = {
    "uniform": Uniform(lower=5e3, upper=1.5e4),
    "log-uniform": LogUniform(lower=1.0, upper=1e3),
    "triangular": Triangular(lower=0.0, mode=0.3, upper=1.0),
    "triangular at its end": Triangular(lower=1.0, mode=1.0, upper=2.0),
    "beta": Beta(a=2, b=3, lower=2e5, upper=4e5),
    "truncated-normal": TruncatedNormal(mean=1000, std=50, lower=900, upper=1200),
    "normal": Normal(mean=3e5, std=2e4),
    "log-normal": LogNormal(mean=2.0, std=0.5),
    "gamma": Gamma(shape=2.0, scale=3.0, shift=1.0),
}
ISHIGAMI = Inputs({name: Uniform(lower=-np.pi, upper=np.pi) for name in "abc"})


pytestmark = pytest.mark.usefixtures("few_draws")


def run(method, inputs, function, jacobian=None, outputs=("f",)):
    return method.run(inputs, SerialEvaluate(FunctionModel(function, inputs.names, outputs, jacobian)))


def by_complex_step(function):
    return lambda p: [[function(p + 1e-20j * e).imag / 1e-20 for e in np.eye(len(p))]]


def smooth(p):
    return (1 + p[0]) ** 1.5 / ((1 + 0.8 * p[1]) * (1 + 0.5 * p[2] * p[3]))


SMOOTH = Inputs({name: Uniform(lower=0.0, upper=1.0) for name in "abcd"})


def moments_by_gauss(inputs, function, count):
    points, weights = gauss(inputs, count)
    values = np.array([function(p) for p in points])
    mean = weights @ values
    return mean, np.sqrt(weights @ (values - mean) ** 2)


@pytest.mark.parametrize("kind", MARGINALS)
def test_polynomials_are_orthonormal_and_their_derivatives_exact(kind):
    inputs = Inputs({"x": MARGINALS[kind]})
    basis = orthonormal(inputs, hyperbolic(1, 6, 1.0))
    points, weights = gauss(inputs, 8)
    values = basis.values(points)
    np.testing.assert_allclose(values.T @ (weights[:, None] * values), np.eye(7), atol=1e-10)
    # The rule itself against the marginal's own quantiles: its first moments are those of the distribution.
    middle = inputs.points((np.arange(20000)[:, None] + 0.5) / 20000)
    np.testing.assert_allclose(basis.values(middle)[:, :3].mean(axis=0), [1, 0, 0], atol=0.02)
    t, at = inputs.coordinates.of(points), inputs.coordinates.points
    slopes = (basis.values(at(t + 1e-5)) - basis.values(at(t - 1e-5))) / 2e-5
    exact = basis.derivatives(points)[:, 0]
    np.testing.assert_allclose(slopes, exact, atol=1e-6 * np.abs(exact).max())


def test_hyperbolic_sets():
    assert len(hyperbolic(4, 3, 1.0)) == 35
    assert hyperbolic(2, 2, 1.0).tolist() == [[0, 0], [1, 0], [0, 1], [2, 0], [1, 1], [0, 2]]
    assert hyperbolic(3, 3, 0.5).tolist() == [[0] * 3, *(list(k * e) for k in (1, 2, 3) for e in np.eye(3, dtype=int))]


@pytest.mark.parametrize("gradients", [True, False])
@pytest.mark.parametrize("kind", MARGINALS)
def test_a_polynomial_is_recovered(kind, gradients):
    marginal = MARGINALS[kind]
    inputs = Inputs({"x": marginal, "y": Uniform(lower=-1.0, upper=1.0)})
    mean, std = marginal.of_coordinate

    def function(p):
        t = ((np.log(p[0]) if marginal.logarithmic else p[0]) - mean) / std
        return 2 + t - 0.3 * t**2 * p[1] + 0.1 * p[1] ** 3

    data = run(
        Chaos(samples=12 if gradients else 30, max_order=4, gradients=gradients),
        inputs,
        function,
        by_complex_step(function),
    )
    expected = moments_by_gauss(inputs, function, 6)
    assert data["mean"].item() == pytest.approx(expected[0], rel=1e-10)
    assert data["std"].item() == pytest.approx(expected[1], rel=1e-10)
    assert data["loo_error"].item() < 1e-10
    points = inputs.points(np.random.default_rng(0).random((50, 2)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OutsideRangeWarning)
        found = Expansion.of(data).outputs(points)[:, 0]
        slopes = Expansion.of(data).tangents(points)[:, 0] * inputs.std
    np.testing.assert_allclose(found, [function(p) for p in points], rtol=1e-9, atol=1e-9)
    exact = np.array([by_complex_step(function)(p)[0] for p in points]) * inputs.std
    np.testing.assert_allclose(slopes, exact, rtol=1e-8, atol=1e-8)


def test_projection_is_exact_too():
    inputs = Inputs({"x": MARGINALS["beta"], "y": MARGINALS["normal"]})

    def function(p):
        return ((p[0] - 3e5) / 5e4) ** 3 + p[1] / 1e5 * p[0] / 1e5

    data = run(Chaos(fit="projection", max_order=3), inputs, function)
    assert data.sizes["sample"] == 25
    assert [data["mean"].item(), data["std"].item()] == pytest.approx(moments_by_gauss(inputs, function, 6), rel=1e-10)
    assert data["loo_error"].item() < 1e-10
    one = run(
        Chaos(fit="projection", max_order=8), Inputs({"x": Uniform(lower=0.0, upper=1.0)}), lambda p: np.exp(p[0])
    )
    assert one["mean"].item() == pytest.approx(np.e - 1, rel=1e-12)
    assert 0 < one["loo_error"].item() < 1e-4


def test_ishigami():
    def function(p):
        return np.sin(p[0]) + 7 * np.sin(p[1]) ** 2 + 0.1 * p[2] ** 4 * np.sin(p[0])

    data = run(Chaos(samples=200, max_order=14), ISHIGAMI, function, by_complex_step(function))
    assert data["std"].item() ** 2 == pytest.approx(13.844587940719254, rel=2e-5)
    first, total = (0.313905191147811, 0.442411144790041, 0), (0.557588855209959, 0.442411144790041, 0.243683664062148)
    np.testing.assert_allclose(data["sobol_first"][0], first, atol=1e-5)
    np.testing.assert_allclose(data["sobol_total"][0], total, atol=1e-5)


def test_indices_of_a_product():
    inputs = Inputs({name: Uniform(lower=0.0, upper=1.0) for name in "abc"})

    def function(p):
        return (3 * p[0] ** 2 + 1) * (3 * p[1] ** 2 + 1) * (3 * p[2] ** 2 + 1) / 8

    data = run(Chaos(samples=50), inputs, function, by_complex_step(function))
    assert data["mean"].item() == pytest.approx(1, abs=1e-9)
    assert data["std"].item() ** 2 == pytest.approx(0.728, abs=1e-9)
    np.testing.assert_allclose(data["sobol_first"][0], 25 / 91, atol=1e-6)
    np.testing.assert_allclose(data["sobol_total"][0], (25 + 2 * 5 + 1) / 91, atol=1e-6)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("constant", [3.0, 0.0, -1e9])
@pytest.mark.parametrize("gradients", [True, False])
def test_an_output_that_does_not_vary(constant, gradients):
    """It asks for no function, has no density, and no warning of numpy's is printed."""
    inputs = Inputs({name: Uniform(lower=0.0, upper=1.0) for name in "ab"})
    outputs = ("f", "c")

    def both(p):
        return [np.exp(p[0]) * p[1], constant]

    def slopes(p):
        return [[np.exp(p[0]) * p[1], np.exp(p[0])], [0.0, 0.0]]

    def alone(p):
        return both(p)[0]

    data = run(Chaos(samples=12, gradients=gradients), inputs, both, slopes, outputs=outputs)
    one = run(Chaos(samples=12, gradients=gradients), inputs, alone, lambda p: slopes(p)[:1])
    assert data["mean"].sel(output="c").item() == pytest.approx(constant, rel=1e-13, abs=1e-15)
    assert data["std"].sel(output="c").item() <= 1e-13 * abs(constant)
    assert np.isnan(data["density"].sel(output="c")).all()
    (found,) = (one for one in findings(data) if " of c " in one.text)
    assert "If it is no constant" in found.text
    assert data["loo_error"].sel(output="f").item() == pytest.approx(one["loo_error"].item(), rel=1e-6)


@pytest.mark.parametrize("gradients", [True, False])
def test_leave_one_out_is_what_it_says(monkeypatch, gradients):
    inputs = Inputs({name: SMOOTH.marginals[name] for name in "ab"})

    def function(p):
        return np.exp(p[0]) / (0.3 + p[1])

    monkeypatch.setattr(bases, "TRUNCATIONS", (1.0,))
    monkeypatch.setattr(chaos, "DICTIONARY", 0)  # nothing to select from
    monkeypatch.setattr(Regression, "edges", lambda self: np.zeros((2, 1)))  # tests/uq/surrogates/test_edges.py
    data = run(Chaos(samples=20, max_order=3, gradients=gradients), inputs, function, by_complex_step(function))
    basis = Expansion.of(data).basis
    points, values = data["points"].to_numpy(), data["values"].to_numpy()[:, 0]
    errors, means, stds = [], [], []
    for out in range(20):
        others = np.arange(20) != out
        left, right = basis.values(points[others]), values[others]
        if gradients:
            slopes = np.array([by_complex_step(function)(p)[0] for p in points[others]]) * inputs.std
            left = np.vstack([left, basis.derivatives(points[others]).reshape(-1, len(basis.indices))])
            right = np.concatenate([right, slopes.ravel()])
        coefficients = np.linalg.lstsq(left, right, rcond=None)[0]
        errors.append(values[out] - (basis.values(points[[out]]) @ coefficients).item())
        means.append(coefficients[0])
        stds.append(np.linalg.norm(coefficients[1:]))
    errors, means, stds, std = np.array(errors), np.array(means), np.array(stds), data["std"].item()
    left = np.sqrt((errors**2).mean())
    assert data["loo_error"].item() == pytest.approx(left / values.std(), rel=1e-8)
    jackknife = np.sqrt(19 / 20 * ((stds - std) ** 2).sum())
    # Samples with the fits that have not seen them as controls give another mean and another variance.
    mean = (means + errors).mean()
    second = (stds**2 + (means - mean) ** 2 + (values - mean) ** 2 - (values - errors - mean) ** 2).mean()
    t = stats.t.ppf(0.975, 19) / 1.96
    other = np.sqrt(second + ((means + errors).std(ddof=1) * t) ** 2 / 20)
    # The mean square of the errors is known as their kurtosis lets so few of them tell.
    unsure = left * np.sqrt((errors**4).mean() / left**4 / 20)
    assert data["std_error"].item() == pytest.approx(
        np.sqrt(jackknife**2 + unsure**2 + (left**2 / 2 / std) ** 2 + (other - std) ** 2 / 4)
    )


@pytest.mark.slow
@pytest.mark.parametrize("gradients", [True, False])
@pytest.mark.parametrize(("cv", "within"), [(0.5, 5e-3), (1.0, 0.1)])
def test_products_and_reciprocals_of_log_normals(cv, within, gradients):
    """Mean 1 and variance (1 + cv²)² − 1 of ab; 1/(ab) is log-normal too. Standard deviations were 20 times off."""
    inputs = Inputs(dict.fromkeys("ab", LogNormal(mean=1.0, std=cv)))
    w = (1 + cv**2) ** 2
    for function, mean in ((lambda p: p[0] * p[1], 1.0), (lambda p: 1 / (p[0] * p[1]), w)):
        jacobian = by_complex_step(function)
        for seed in range(3):
            data = run(Chaos(samples=96, seed=seed, gradients=gradients), inputs, function, jacobian)
            exact = mean * np.sqrt(w - 1)
            assert data["mean"].item() == pytest.approx(mean, rel=within)
            assert data["std"].item() == pytest.approx(exact, rel=within)
            assert abs(data["std"].item() - exact) < 4 * data["std_error"].item()
            np.testing.assert_allclose(data["sobol_first"], cv**2 / (w - 1), rtol=3 * within)


def test_gradients_are_worth_more_than_they_cost():
    mean, std = moments_by_gauss(SMOOTH, smooth, 8)
    errors = {}
    for gradients in (True, False):
        runs = [
            run(Chaos(samples=15, max_order=3, seed=s, gradients=gradients), SMOOTH, smooth, by_complex_step(smooth))
            for s in range(5)
        ]
        errors[gradients] = [
            np.sqrt(np.mean([(d[n].item() - v) ** 2 for d in runs])) for n, v in (("mean", mean), ("std", std))
        ]
        if gradients:
            assert all(int(d["order"]) == 3 for d in runs)
    assert errors[True][0] < errors[False][0] / 3
    assert errors[True][1] < errors[False][1] / 5


def test_wrong_gradients_are_noticed():
    def wrong(p):
        return 1.2 * np.array(by_complex_step(smooth)(p))

    right, planted = (run(Chaos(samples=15), SMOOTH, smooth, j) for j in (by_complex_step(smooth), wrong))
    assert planted["loo_error"].item() > 3 * right["loo_error"].item()


def test_many_parameters_are_selected_from():
    inputs = Inputs({f"p{i}": Uniform(lower=-1.0, upper=1.0) for i in range(15)})

    def function(p):
        return p[0] + 2 * p[3] * p[7] + p[11] ** 3 + 0.5 * p[5]

    data = run(Chaos(samples=20, max_order=3), inputs, function, by_complex_step(function))
    assert data["std"].item() ** 2 == pytest.approx(1 / 3 + 4 / 9 + 1 / 7 + 1 / 12, rel=1e-8)
    assert data.sizes["term"] <= 12
    assert data["sobol_total"][0, 3].item() == pytest.approx(4 / 9 / data["std"].item() ** 2, rel=1e-8)


def test_tolerance_is_met_by_growing_the_design():
    data = run(Chaos(tolerance=5e-3), SMOOTH, smooth, by_complex_step(smooth))
    assert data["loo_error"].item() <= 5e-3
    assert "tolerance 0.005 met" in data.attrs["stopped"]
    longer = run(Chaos(samples=data.sizes["sample"] + 7), SMOOTH, smooth, by_complex_step(smooth))
    np.testing.assert_array_equal(longer["points"][: data.sizes["sample"]], data["points"])
    short = run(Chaos(tolerance=1e-12, samples=20), SMOOTH, smooth, by_complex_step(smooth))
    assert "not met" in short.attrs["stopped"]
    assert "after all 20 samples" in short.attrs["stopped"]


def test_quantiles_are_those_of_the_model():
    data = run(Chaos(samples=30), SMOOTH, smooth, by_complex_step(smooth))
    points = SMOOTH.points(np.random.default_rng(1).random((100_000, 4)))
    exact = np.quantile(smooth(points.T), data["quantile"].to_numpy())
    np.testing.assert_allclose(data["quantiles"][:, 0], exact, atol=0.02 * data["std"].item())
    widths = np.diff(data["density_edge"][0])
    assert (data["density"][0].to_numpy() * widths).sum() == pytest.approx(1)


def test_failures_are_left_out_and_said():
    def fragile(p):
        if p[0].real > 0.9:
            message = "gone"
            raise SolveError(message)
        return smooth(p)

    data = run(Chaos(samples=40), SMOOTH, fragile, by_complex_step(smooth))
    assert 0 < int((~data["ok"]).sum()) < 10
    assert "samples have no answer" in data.attrs["note"]
    with pytest.raises(SolveError, match="too few for an expansion"):
        run(Chaos(samples=3, gradients=False), SMOOTH, smooth)


def test_settings_that_cannot_work_are_refused():
    for settings, told in (
        ({}, "neither samples nor tolerance"),
        ({"fit": "projection", "samples": 9}, "expected none"),
    ):
        with pytest.raises(ValueError, match=told):
            Chaos(**settings)
    with pytest.raises(ValueError, match="independent parameters"):
        run(Chaos(samples=9), Inputs(SMOOTH.marginals, (("a", "b", 0.5),)), smooth)


def test_saved_and_loaded(tmp_path):
    data = run(Chaos(samples=15), SMOOTH, smooth, by_complex_step(smooth))
    data.to_netcdf(tmp_path / "results.nc", engine="h5netcdf")
    points = np.random.default_rng(2).random((30, 4))
    expansion = Expansion.of(stored_dataset(tmp_path / "results.nc"))
    np.testing.assert_array_equal(expansion.outputs(points), Expansion.of(data).outputs(points))
    slopes = [(expansion.outputs(points + h) - expansion.outputs(points - h)) / 2e-6 for h in 1e-6 * np.eye(4)]
    np.testing.assert_allclose(expansion.tangents(points)[:, 0], np.array(slopes)[:, :, 0].T, atol=1e-7)
    with pytest.warns(OutsideRangeWarning, match=r"in: b$"):
        expansion.outputs(np.array([[0.5, 1.1, 0.5, 0.5]]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        expansion.outputs(np.array([[0.5, 1.1, 0.5, 0.5]]))  # said once
    with pytest.raises(ValueError, match="hold no expansion"):
        Expansion.of(data.drop_vars("multi_index"))
    with pytest.raises(ValueError, match="not expanded"):
        expansion.displacements(points)


# --- the finite-element beam ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def beam():
    from mpi4py import MPI

    from workflows.config.study import load as load_study

    study = load_study(Path(__file__).parent.parent.parent.parent / "configs" / "tiny.toml")
    return study.inputs, SerialEvaluate(study.model.build(MPI.COMM_SELF, study.inputs.names))


class States(FieldSum):
    """Keeps the states and their slopes as they pass."""

    def __init__(self):
        self.rows = []

    def on(self, model):
        directions = np.eye(len(model.parameters))

        def rows(solution, _):
            self.rows.append(model.space.gather(np.vstack([solution.state, solution.state_tangent(directions)])))
            return np.zeros((1, solution.state.size))

        return rows


@pytest.mark.fem
@pytest.mark.parametrize(
    "method", [Chaos(samples=8), Chaos(samples=10, gradients=False), Chaos(fit="projection", max_order=1)]
)
def test_fields_are_the_regression_of_all_states(beam, method):
    inputs, evaluate = beam
    data = method.run(inputs, evaluate)
    expansion = Expansion.of(data)
    basis, points, states = expansion.basis, data["points"].to_numpy(), States()
    evaluate(Request(points, fields=states, start=linearise(inputs, evaluate).prediction))
    kept = np.array(states.rows)
    left, right = basis.values(points), kept[:, 0]
    if method.fit == "projection":
        root = np.sqrt(gauss(inputs, 3)[1])[:, None]
        left, right = left * root, right * root
    elif method.gradients:
        left = np.vstack([left, basis.derivatives(points).reshape(-1, len(basis.indices))])
        right = np.vstack([right, (kept[:, 1:] * inputs.std[:, None]).reshape(-1, right.shape[1])])
    coefficients = np.linalg.lstsq(left, right, rcond=None)[0]
    scale = np.abs(coefficients).max()
    np.testing.assert_allclose(expansion.fields.reshape(coefficients.shape), coefficients, atol=1e-11 * scale)
    np.testing.assert_allclose(data["field_mean"].to_numpy().ravel(), coefficients[0], atol=1e-11 * scale)
    tip = np.abs(data["field_nominal"].sel(component="y")).argmax().item()
    for name, sign in (("mean", -1), ("std", 1)):
        at_tip = data[f"field_{name}"].sel(component="y")[tip].item()
        assert sign * at_tip == pytest.approx(data[name].sel(output="uy_max").item(), rel=1e-6)
        assert data[f"field_{name}_error"].sel(component="y")[tip] >= 0.5 * data[f"{name}_error"].sel(output="uy_max")
    assert expansion.displacements(points[:2]).shape == (2, data.sizes["node"], 3)


@pytest.mark.fem
def test_blocks_change_no_bit_and_keep_states_only(beam, tmp_path, monkeypatch):
    """Projections are added sample by sample, whatever the blocks; files hold d + 1 fields for each sample.

    Samples are solved one by one here: those of a block would be rounded together.
    """
    from mpi4py import MPI

    inputs, evaluate = beam
    monkeypatch.setattr(evaluate.model, "together", 1)
    method = Chaos(samples=7)
    expected = method.run(inputs, evaluate)
    monkeypatch.setattr("uq.evaluation.request.BLOCKS", 3)
    assert method.run(inputs, evaluate).identical(expected)
    ensemble = Ensemble.split(MPI.COMM_SELF)
    for _ in range(2):  # the second finds the blocks of the first
        kept = Checkpoint(tmp_path, "beam")
        data = ensemble.run(evaluate.model, lambda each: method.run(inputs, each), checkpoint=kept, blocks=3)
        assert data.identical(expected)
    stored = Checkpoint(tmp_path, "beam")
    rows = [len(stored.find(path.stem).fields) for path in (tmp_path / "evaluations").glob("*.block")]
    assert sorted(rows) == [3, 3 * 1, 3 * 3, 3 * 3]
    assert expected.sizes["term"] > 3


@pytest.mark.fem
@pytest.mark.mpi
def test_ranks_change_no_bit(tmp_path):
    """Of expansions, and of the samples of Saltelli's design."""
    script = """
import sys
from pathlib import Path
from uq.methods.chaos import Chaos
from uq.methods.sobol import Sobol
from tests.ranks import groups
from uq.evaluation.ensemble import Ensemble
from workflows.config.study import load
from workflows.results.directory import write_dataset

study = load(Path("configs/tiny.toml"))
for comm in groups(1, 2):
    ensemble = Ensemble.split(comm)
    model = study.model.build(ensemble.group, study.inputs.names)
    for method in (Chaos(samples=5), Sobol(design="saltelli", samples=16, scrambles=4)):
        data = ensemble.run(model, lambda evaluate: method.run(study.inputs, evaluate))
        if data is not None:
            write_dataset(Path(sys.argv[1]) / f"{method.kind} {comm.size}.nc", data)
"""
    done = on_kept_ranks(2, script, tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    for kind in ("chaos", "sobol"):
        assert (tmp_path / f"{kind} 1.nc").read_bytes() == (tmp_path / f"{kind} 2.nc").read_bytes()


ISHIGAMI = Inputs(dict.fromkeys("abc", Uniform(lower=-np.pi, upper=np.pi)))


def ishigami(p):
    return np.sin(p[0]) + 7 * np.sin(p[1]) ** 2 + 0.1 * p[2] ** 4 * np.sin(p[0])


def test_the_order_rises_as_long_as_the_highest_explains_more():
    """Order 6 leaves 15 % of the standard deviation, however many solves there are."""
    variance = 49 / 8 + np.pi**4 / 50 + np.pi**8 / 1800 + 1 / 2
    found = run(Chaos(samples=100, quantiles=()), ISHIGAMI, ishigami, by_complex_step(ishigami))
    assert found["loo_error"].item() < 1e-3
    assert abs(found["std"].item() ** 2 - variance) < 1e-3 * variance
    assert found["sobol_total"].to_numpy()[0] == pytest.approx([0.5576, 0.4424, 0.2437], abs=1e-3)
    limited = run(Chaos(samples=60, quantiles=(), max_order=6), ISHIGAMI, ishigami, by_complex_step(ishigami))
    assert limited["loo_error"].item() > 0.1
    said = [one for one in findings(limited) if one.code == "expansion-order"]
    assert len(said) == 1
    assert "order 6" in said[0].text
    smoother = run(Chaos(samples=30, quantiles=(), max_order=6), SMOOTH, smooth, by_complex_step(smooth))
    assert not [one for one in findings(smoother) if one.code == "expansion-order"]


def test_the_order_of_what_has_a_pole_at_an_end_does_not_rise():
    """Higher orders leave less at samples, and 30 % of their means were wrong in silence."""
    names = Inputs({"a": Uniform(lower=0.0, upper=1.0)})
    for seed in range(4):
        found = run(
            Chaos(samples=48, seed=seed, quantiles=()), names, lambda p: p[0] ** -0.2, lambda p: [[-0.2 * p[0] ** -1.2]]
        )
        assert found["order"].item() <= 6
