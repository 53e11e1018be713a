"""What samples and expansions say against their own estimates: functions that fits, samples or both cannot see."""

import numpy as np
import pytest
import xarray as xr

from benchmarks import coverage, tails
from benchmarks.coverage import CASES, Vectorised, measure
from forward.pointwise import FunctionModel
from tests.functions import AtOnce
from tests.states import WithState
from uq.estimators.doubts import of_indices
from uq.evaluation.evaluate import SerialEvaluate
from uq.findings import findings
from uq.inputs.distributions import Normal, Uniform
from uq.inputs.random_parameters import Inputs
from uq.methods import chaos
from uq.methods.chaos import Chaos
from uq.methods.compare import Compare
from uq.methods.monte_carlo import MonteCarlo, SensitivityMonteCarlo
from uq.methods.quasi_monte_carlo import QuasiMonteCarlo
from uq.methods.sobol import Sobol

UNIT = Uniform(lower=0.0, upper=1.0)
BY_NAME = {case.name: case for case in CASES}


@pytest.fixture(autouse=True)
def _few_points(monkeypatch):
    monkeypatch.setattr(chaos, "DRAWN", 13)
    monkeypatch.setattr(coverage, "REFERENCE", 12)


def run(method, name):
    case = BY_NAME[name]
    return method.run(case.inputs, Vectorised(case))


def severities(data):
    return [finding.severity for finding in findings(data)]


# --- expansions that explain nothing -------------------------------------------------------------------------------


@pytest.mark.parametrize("gradients", [True, False])
@pytest.mark.parametrize("samples", [40, 100])
def test_what_no_expansion_explains_has_the_moments_of_its_samples_and_no_indices(samples, gradients):
    data = run(
        Sobol(samples=samples, gradients=gradients, second_order=True, groups={"ab": ("x0", "x1")}), "oscillation"
    )
    assert data["loo_error"].item() > 0.8
    assert abs(data["mean"].item()) < 3 * data["mean_error"].item()
    assert abs(data["std"].item() - 0.707) < 3 * data["std_error"].item() < 0.3
    values = data["values"].to_numpy()[:, 0]
    np.testing.assert_allclose(data["quantiles"].to_numpy()[:, 0], np.quantile(values, (0.05, 0.5, 0.95)))
    for name in ("sobol_first", "sobol_total", "sobol_group_first", "sobol_second"):
        for end in ("", "_error"):
            assert np.isnan(data[f"{name}{end}"].to_numpy()).all()
    assert severities(data)[0] == "error"
    assert "explains nothing" in findings(data)[0].text


def test_given_data_of_such_an_expansion_have_no_indices_either():
    case = BY_NAME["oscillation"]
    source = run(Chaos(samples=40), "oscillation")
    given = Sobol(design="given-data", source="results")
    data = given.with_sources(lambda place: source).run(case.inputs, Vectorised(case))
    assert np.isnan(data["sobol_total"].to_numpy()).all()
    assert "error" in severities(data)
    samples = run(MonteCarlo(samples=40), "oscillation")
    data = given.with_sources(lambda place: samples).run(case.inputs, Vectorised(case))
    assert np.isnan(data["sobol_total"].to_numpy()).all()
    assert "error" in severities(data)


def test_a_rough_expansion_controls_its_own_samples():
    """A jump of which the gradients know nothing: the fit has a third of the variance."""
    data = run(Chaos(samples=40), "jump")
    coefficients, indices = data["coefficients"].to_numpy()[:, 0], data["multi_index"].to_numpy()
    fitted = np.sqrt((coefficients[indices.any(axis=1)] ** 2).sum())
    exact = np.sqrt(1 / 12 + 0.35 * 0.65)
    assert fitted < 0.8 * exact
    assert abs(data["std"].item() - exact) < 2.5 * data["std_error"].item()
    assert [(one.severity, one.code) for one in findings(data)] == [
        ("warning", "expansion-rough"),
        ("warning", "gradients-contradict"),
    ]


def test_errors_of_indices_have_what_the_fit_leaves_out():
    for name in ("hinge", "jump", "absolute value", "Sobol' g", "peak"):
        data = run(Sobol(samples=40), name)
        left = (data["loo_error"].item() * data["values"].std().item() / data["std"].item()) ** 2
        assert (data["sobol_total_error"].to_numpy() >= 0.9 * left).all()


def test_smooth_functions_have_no_finding():
    for name in ("Ishigami", "quadratic", "log-normals"):
        assert findings(run(Sobol(samples=80), name)) == []


def test_the_solve_at_the_mean_is_one_that_the_fit_has_not_seen():
    """A peak of which no sample knows, but for the one at the mean."""
    inputs = Inputs(dict.fromkeys("abc", UNIT))
    model = FunctionModel(lambda p: p.sum() + 5 * np.exp(-((p - 0.5) ** 2).sum() / (2 * 0.02**2)), inputs.names, ("y",))
    data = Chaos(samples=40).run(inputs, SerialEvaluate(model))
    assert data["loo_error"].item() < 1e-3
    (found,) = findings(data)
    assert found.severity == "warning"
    assert "mean parameters" in found.text


# --- samples -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "method",
    [
        MonteCarlo(samples=64),
        SensitivityMonteCarlo(samples=64),
        QuasiMonteCarlo(samples=64, control="none"),
        QuasiMonteCarlo(samples=64),
        Sobol(design="saltelli", samples=32),
    ],
    ids=lambda method: f"{method.kind}{getattr(method, 'control', '')}",
)
def test_heavy_tails_are_told(method):
    told = [severities(run(method.model_copy(update={"seed": s}), "exponential")) for s in range(10)]
    assert sum(one in (["warning"], ["error"]) for one in told) >= 8
    inputs = Inputs({"a": UNIT, "b": Normal(mean=0.0, std=1.0)})
    model = FunctionModel(lambda p: p[0] + p[1], inputs.names, ("y",), lambda p: [[1.0, 1.0]])
    told = [
        findings(method.model_copy(update={"seed": s, "samples": 128}).run(inputs, AtOnce(model))) for s in range(10)
    ]
    assert told == [[]] * 10


def test_samples_that_look_log_normal_are_told_whatever_their_largest():
    """1/ω: a third of the sets of 64 samples have no large one."""
    case = next(case for case in tails.cases() if case.name == "1/ω, cv 1")
    told = [severities(MonteCarlo(samples=64, seed=seed).run(case.inputs, Vectorised(case))) for seed in range(12)]
    assert all(told)
    assert told.count(["warning"]) >= 10


def test_expansions_tell_what_is_beyond_their_samples():
    case = next(case for case in tails.cases() if case.name == "product, cv 2")
    told = [severities(Chaos(samples=16, seed=seed).run(case.inputs, Vectorised(case))) for seed in range(4)]
    assert all("warning" in one for one in told)


def test_comparisons_say_what_their_methods_found_out():
    case = BY_NAME["exponential"]
    block = {
        "methods": ({"kind": "monte-carlo", "budgets": (64,)},),
        "reference": {"kind": "given", "values": {"f": {"mean": 1.6487, "std": 2.1612}}},
        "textbook": 0,
        "repeats": 5,
    }
    (found,) = findings(Compare.model_validate(block).run(case.inputs, Vectorised(case)))
    assert found.severity == "warning"
    assert "monte-carlo with 64 samples" in found.text
    assert "5 of 5 runs" in found.text or "4 of 5 runs" in found.text


def test_comparisons_repeat_that_a_control_was_dropped_once_for_a_method():
    """The quadratic of exp(−a − b) leaves more scatter than there is, at both budgets."""
    case = next(case for case in tails.cases() if case.name == "exp(−a − b), cv 2")
    block = {
        "methods": ({"kind": "quasi-monte-carlo", "control": "quadratic", "budgets": (64, 128)},),
        "reference": {"kind": "given", "values": {"f": dict(zip(("mean", "std"), case.exact, strict=True))}},
        "textbook": 0,
        "repeats": 3,
    }
    found = findings(Compare.model_validate(block).run(case.inputs, Vectorised(case)))
    (note,) = (one for one in found if one.severity == "note")
    assert note.text.startswith("quasi-monte-carlo with 64, 128 samples, 6 of 6 runs: The quadratic control of f")


# --- indices beyond their bounds -----------------------------------------------------------------------------------


def indices(**changes):
    known = {
        "sobol_first": [0.5, 0.3],
        "sobol_first_error": [0.01, 0.01],
        "sobol_total": [0.6, 0.5],
        "sobol_total_error": [0.01, 0.01],
        "total_bound": [0.9, 0.8],
        "total_bound_error": [0.02, 0.02],
    }
    data = {name: (("output", "parameter"), [value]) for name, value in (known | changes).items()}
    return xr.Dataset(data, coords={"output": ["y"], "parameter": ["a", "b"]})


@pytest.mark.unit
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, ()),
        ({"sobol_total": [np.nan, np.nan], "sobol_total_error": [np.nan, np.nan]}, ()),
        ({"sobol_total": [1.02, 0.5], "total_bound": [2.0, 0.8]}, ()),
        (
            {"sobol_total": [1.2, 0.5], "total_bound": [2.0, 0.8]},
            ("of a for y, 1.2, is more than 1, by 20 standard errors",),
        ),
        ({"sobol_total": [0.6, 0.95]}, ("of b for y, 0.95, is more than its bound by derivatives, 0.8",)),
        (
            {"sobol_first": [0.5, 0.45], "sobol_total": [0.4, 0.5]},
            ("of a for y, 0.5, is more than the total one, 0.4",),
        ),
        ({"sobol_first": [-0.2, 0.3]}, ("of a for y, -0.2, is less than 0",)),
        ({"sobol_first": [0.59, 0.49]}, ("add up to 1.08 ± 0.014",)),
    ],
)
def test_indices_beyond_their_bounds_are_errors_of_the_program(changes, said):
    found = list(of_indices(indices(**changes)))
    assert len(found) == len(said)
    for finding, words in zip(found, said, strict=True):
        assert finding.severity == "error"
        assert words in finding.text


# --- coverage ------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "hinge",
        "jump",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("oscillation", "absolute value", "peak")),
    ],
)
def test_intervals_cover_what_is_not_smooth(name):
    """A small part of the table of docs/measurements.md."""
    for method in (Chaos(samples=40, fields=False), QuasiMonteCarlo(samples=64, fields=False)):
        row = measure(BY_NAME[name], method, 24)
        # 88 % of 24 are 21, three standard errors below that 16.
        assert (row.covered >= 16 / 24).all(), (method.kind, row.covered)
        assert (row.claimed[:2] < 6).all(), (method.kind, row.claimed)


# --- fields, and samples that are all equal ------------------------------------------------------------------------

STANDARD = Normal(mean=0.0, std=1.0)
NODES = 10


def body(heavy):
    """Displacements of ten nodes, of which the first ones move by the exponential of a normal parameter."""

    def states(p):
        moved = np.exp(1.2 * p[0]) * (np.arange(NODES) < heavy) + (p[0] + p[1]) * (np.arange(NODES) >= heavy)
        return np.stack([moved, 0 * moved, 0.1 * moved], axis=1).ravel()

    def slopes(p):
        return [[np.imag(states(p + 1e-30j * e)[-3]) / 1e-30 for e in np.eye(2)]]

    inputs = Inputs(dict.fromkeys("ab", STANDARD))
    return inputs, WithState(lambda p: p[0] + p[1], inputs.names, ("f",), slopes, states)


@pytest.mark.parametrize(
    "method",
    [
        MonteCarlo(samples=128),
        SensitivityMonteCarlo(samples=128),
        QuasiMonteCarlo(samples=128, control="none"),
        QuasiMonteCarlo(samples=128, control="quadratic"),
        Sobol(design="saltelli", samples=128),
    ],
    ids=("plain", "tangent", "qmc", "qmc, quadratic", "sobol"),
)
def test_a_heavy_tail_in_a_part_of_the_field_is_found_with_its_share(method):
    """The output itself is normal, and says nothing."""
    for heavy, share in ((0, None), (3, "30%"), (10, "100%")):
        inputs, model = body(heavy)
        texts = [one.text for one in findings(method.run(inputs, SerialEvaluate(model))) if one.severity == "warning"]
        found = [text for text in texts if "displacements" in text]
        assert len(found) == (share is not None)
        assert share is None or f"in {share} of the body" in found[0]


def test_a_field_whose_variance_is_beyond_its_samples_is_found():
    inputs, model = body(10)
    texts = [one.text for one in findings(Chaos(samples=8).run(inputs, SerialEvaluate(model)))]
    assert any("of the variance of the displacement field" in text for text in texts)
    inputs, model = body(0)
    assert findings(Chaos(samples=8).run(inputs, SerialEvaluate(model))) == []


@pytest.mark.parametrize(
    "method",
    [
        MonteCarlo(samples=64),
        QuasiMonteCarlo(samples=64),
        Chaos(samples=16),
        Sobol(samples=16),
        Sobol(design="saltelli", samples=16),
    ],
    ids=("plain", "qmc", "chaos", "sobol", "sobol, exchanged"),
)
def test_samples_that_are_all_equal_do_not_claim_an_error_of_nothing_in_silence(method):
    """An event of 0.1 % that no sample meets, and a constant: they look the same."""
    inputs = Inputs(dict.fromkeys("ab", UNIT))
    for event in (lambda p: float(p[0] > 0.999), lambda p: 3.0):
        model = FunctionModel(event, inputs.names, ("f",), lambda p: [[0.0, 0.0]])
        data = method.model_copy(update={"fields": False}).run(inputs, SerialEvaluate(model))
        assert data["std_error"].item() < 1e-15
        (found,) = findings(data)
        assert found.severity == "warning"
        assert "If it is no constant" in found.text
