"""Errors of the mesh over the distribution: models of which they are known in closed form."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import xarray as xr

from forward.model import MeshError, Saturation, SolveError, Work
from forward.pointwise import FunctionModel, FunctionSolution
from tests.functions import AtOnce
from uq.accuracy.budget import FEWEST, MOST, estimates_for
from uq.accuracy.doubts import Told
from uq.accuracy.effects import CHANGED, ELSEWHERE, UNCALIBRATED, with_mesh_errors
from uq.accuracy.mesh_errors import design, estimate
from uq.evaluation.evaluate import Recorder, SerialEvaluate
from uq.findings import findings
from uq.inputs.distributions import Beta, LogNormal, Normal, Uniform
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.methods.chaos import Chaos
from uq.methods.derivative_based import DerivativeBased
from uq.methods.local_sensitivity import LocalSensitivity
from uq.methods.monte_carlo import MonteCarlo, SensitivityMonteCarlo
from uq.methods.quasi_monte_carlo import QuasiMonteCarlo
from uq.methods.sobol import Sobol
from uq.surrogates.linearisation import linearised

INPUTS = Inputs({"a": Beta(a=2, b=2, lower=1.0, upper=1.5), "b": Uniform(lower=1.0, upper=2.0)})
TOLD = Told({"u": "m", "v": "Pa"})


pytestmark = pytest.mark.usefixtures("few_draws")


@dataclass(frozen=True)
class OnMesh(FunctionModel):
    """A function, with that which a mesh without error would give."""

    exact: FunctionModel | None = None
    seen: float = 1.0  # share of the error that an estimate sees
    missed: float = 0.0  # part of the output that estimates of its error do not see
    doubt: float | None = None  # of calibrated errors
    measured: bool = True
    hidden: float | None = None  # part of the output that lies between facets and surface
    unstable: bool = False  # on a finer mesh

    def solve(self, parameters, guess=None):
        found = super().solve(parameters, guess)
        return SolvedOnMesh(found.model, found.parameters, found.outputs)


@dataclass(frozen=True)
class SolvedOnMesh(FunctionSolution):
    """Its value, and what it errs."""

    def mesh_error(self):
        errors = self.model.exact.function(self.parameters) - self.outputs
        seen = self.model.seen * errors - self.model.missed * self.outputs
        return MeshError(seen, np.empty(0), 0.0, np.nan, Work())

    def saturation(self, spare):
        m = len(self.outputs)
        if self.model.doubt is not None:
            shifts, doubts = self.model.missed * self.outputs, np.full(m, self.model.doubt)
            hidden = None if self.model.hidden is None else self.model.hidden * self.outputs
            return Saturation(
                np.ones(m), 1.0, 1.0, shifts=shifts, doubts=doubts, hidden=hidden, unstable=self.model.unstable
            )
        if self.model.seen == 1.0:
            return None
        return Saturation(np.full(m, 1 / self.model.seen), 1.0, 1.0, self.model.measured)


def on_mesh(error, names=("a", "b")):
    """ψ = a/b and ψ = a²/b of which a mesh makes these errors (p → two numbers)."""

    def coarse(p):
        return np.array([p[0] / p[1], p[0] ** 2 / p[1]])

    def slopes(p):
        first = [[1 / p[1], -p[0] / p[1] ** 2], [2 * p[0] / p[1], -((p[0] / p[1]) ** 2)]]
        return np.hstack([first, np.zeros((2, len(names) - 2))])

    exact = FunctionModel(lambda p: coarse(p) + np.array(error(p)), names, ("u", "v"))
    return OnMesh(coarse, names, ("u", "v"), slopes, exact)


def studied(method, model, count=FEWEST, inputs=INPUTS, told=TOLD):
    recorder = Recorder(AtOnce(model))
    dataset = method.run(inputs, recorder)
    centre = linearised(inputs, recorder, recorder.first)
    found = estimate(inputs, SerialEvaluate(model), centre, count, 0, fields=True)
    return dataset, with_mesh_errors(dataset, inputs, centre, found, told)


def exact_moments(model, inputs=INPUTS):
    points = inputs.points(sobol_points(9, 0, 0, 2**14, len(inputs.names)))
    coarse = np.array(model.function(points.T)).T
    exact = np.array(model.exact.function(points.T)).T
    return coarse, exact


METHODS = (
    MonteCarlo(samples=400),
    SensitivityMonteCarlo(samples=100),
    QuasiMonteCarlo(samples=256),
    Chaos(samples=24),
    Sobol(samples=24),
    Sobol(design="saltelli", samples=256),
    DerivativeBased(samples=256),
)


def affine(p):
    """Errors that follow the outputs."""
    return [0.05 * p[0] / p[1] + 0.02, -0.1 * p[0] ** 2 / p[1]]


def other(p):
    """Errors that do not."""
    return [0.04 * p[0] - 0.02 * p[1], 0.1 * (p[1] - 1.5) ** 2]


@pytest.mark.parametrize("method", METHODS, ids=lambda m: f"{m.kind}-{getattr(m, 'design', '')}")
def test_of_every_method_moments_and_quantiles_are_corrected(method):
    model = on_mesh(affine)
    before, found = studied(method, model)
    coarse, exact = exact_moments(model)
    np.testing.assert_allclose(found["mesh_error"], (exact - coarse).mean(axis=0), rtol=0.05)
    np.testing.assert_allclose(found["std_mesh_error"], exact.std(axis=0) - coarse.std(axis=0), rtol=0.1)
    moved = np.quantile(exact, found["quantile"], axis=0) - np.quantile(coarse, found["quantile"], axis=0)
    np.testing.assert_allclose(found["quantiles_mesh_error"], moved, rtol=0.12)
    np.testing.assert_allclose(found["mean_corrected"], before["mean"] + found["mesh_error"])
    whole = np.hypot(before["mean_error"], abs(found["mesh_error"]) + found["mesh_error_doubt"])
    np.testing.assert_allclose(found["total_error"], whole)
    for name in before.variables:  # all that was there is the same, to the bit
        assert before[name].values.tobytes() == found[name].values.tobytes(), name
    if "sobol_first" in before:  # an error that is a fraction of the output changes no share of its variance
        np.testing.assert_allclose(found["sobol_first_mesh_error"][1], 0, atol=1e-6)


@pytest.mark.few(2)
@pytest.mark.parametrize(
    "method",
    [
        Sobol(samples=24, groups={"both": ("a", "b"), "first": ("a",)}, second_order=True),
        Sobol(design="saltelli", samples=1024, groups={"both": ("a", "b")}, second_order=True),
        DerivativeBased(samples=256),
        LocalSensitivity(),
        Chaos(samples=24),
    ],
    ids=lambda m: f"{m.kind}-{getattr(m, 'design', '')}",
)
def test_what_follows_from_outputs_is_corrected_as_the_same_study_without_a_mesh_says(method):
    """Indices of groups and pairs, bounds, derivatives, quantiles, ends of the parts of a density."""
    model = on_mesh(other)
    _, found = studied(method, model, count=8)
    exact = FunctionModel(model.exact.function, model.parameters, model.outputs, slopes_of(model.exact.function))
    right = method.run(INPUTS, SerialEvaluate(exact))
    shown = ("sobol_first", "sobol_total", "sobol_group_first", "sobol_group_total", "sobol_second")
    names = [name for name in (*shown, "dgsm", "total_bound", "derivative", "quantiles") if name in found]
    assert names
    for name in names:
        moved, left = right[name] - found[name], right[name] - found[f"{name}_corrected"]
        sampling = right.get(f"{name}_error", 0 * moved)
        assert (abs(left) < 0.2 * abs(moved).max() + sampling + 1e-9).all(), name
        assert (abs(left) < 2 * np.hypot(found[f"{name}_mesh_error_doubt"], sampling) + 1e-9).all(), name
    if "density" in found:
        for output in ("u", "v"):
            one, true = found.sel(output=output), right.sel(output=output)
            moved, ends = below(true)(one["density_edge_corrected"]), below(one)(one["density_edge"])
            assert abs(moved - ends).max() < 0.3 * abs(below(true)(one["density_edge"]) - ends).max()


def below(found):
    """Probability up to a value, by the density of an output."""
    edges = found["density_edge"].values
    parts = np.cumsum(found["density"].values * np.diff(edges))
    return lambda x: np.interp(x, edges, [0.0, *parts])


def slopes_of(function, h=1e-6):
    """Central differences."""
    return lambda p: np.column_stack([(function(p + e) - function(p - e)) / (2 * h) for e in h * np.eye(len(p))])


def test_errors_of_what_an_expansion_does_not_explain_are_those_of_its_tangents():
    """An expansion that is refused has no spread of its own, over which errors would be without bounds."""
    model = on_mesh(affine)
    coarse = model.function

    def wild(p):
        return np.array([coarse(p)[0], coarse(p)[1] + np.sin(1e3 * p[0])])

    exact = replace(model.exact, function=lambda p: wild(p) + np.array(affine(p)))
    method = Chaos(samples=12, max_order=2, gradients=False)
    before, found = studied(method, replace(model, function=wild, exact=exact))
    assert before["loo_error"][1] > 0.8
    assert (abs(found["std_mesh_error"]) < found["std"]).all()
    assert (abs(found["mesh_error"]) < 0.5 * abs(found["mean"])).all()


def test_shares_beyond_ten_times_are_said_in_words():
    _, found = studied(MonteCarlo(samples=64), on_mesh(lambda p: [30 * p[0], 0.2 * p[0] ** 2 / p[1]]))
    (text,) = (one.text for one in findings(found) if "of the mean" in one.text)
    assert text.endswith("u (more than 10 times it), v 20%.")


def test_what_is_zero_by_symmetry_is_not_compared():
    function = FunctionModel(lambda p: np.array([p[0], 1e-17 * np.sin(1e3 * p[0])]), ("a", "b"), ("u", "v"))
    exact = replace(function, function=lambda p: np.array([1.2 * p[0], 1e-16]))
    model = OnMesh(function.function, ("a", "b"), ("u", "v"), lambda p: np.array([[1.0, 0.0], [0.0, 0.0]]), exact)
    recorder = Recorder(SerialEvaluate(model))
    dataset = MonteCarlo(samples=64).run(INPUTS, recorder)
    centre = linearised(INPUTS, recorder, recorder.first)
    errors = estimate(INPUTS, SerialEvaluate(model), centre, FEWEST, 0, fields=False)
    found = with_mesh_errors(dataset, INPUTS, centre, errors, Told({"u": "m", "v": "m"}))
    said = [one.text for one in findings(found) if "mesh" in one.text]
    assert any("u 20%" in text for text in said)
    assert not any("v " in text.split(": ", 1)[-1] for text in said)


@pytest.mark.unit
def test_estimates_too_far_for_one_linear_step_are_refused():
    class Far(SolvedOnMesh):
        def mesh_error(self):
            return replace(super().mesh_error(), nonlinearity=np.nan if self.parameters[0] > 1.25 else 2.0)

    class OnCoarse(OnMesh):
        def solve(self, parameters, guess=None):
            found = super().solve(parameters, guess)
            return Far(found.model, found.parameters, found.outputs)

    model = on_mesh(affine)
    coarse = OnCoarse(model.function, model.parameters, model.outputs, model.jacobian, model.exact)
    _, found = studied(MonteCarlo(samples=64), coarse)
    assert np.isnan(found["mesh_error"]).all()
    assert any("3 of 3 estimates" in one.text and "much too coarse" in one.text for one in findings(found))


def test_errors_of_their_own_shape_change_moments_and_indices():
    model = on_mesh(other)
    before, found = studied(Chaos(samples=64, max_order=8), model, count=12)
    coarse, exact = exact_moments(model)
    np.testing.assert_allclose(found["mesh_error"], (exact - coarse).mean(axis=0), rtol=0.01)
    np.testing.assert_allclose(found["std_mesh_error"], exact.std(axis=0) - coarse.std(axis=0), rtol=0.15)
    reference = Chaos(samples=64, max_order=8).run(
        INPUTS, SerialEvaluate(replace(model.exact, jacobian=slopes_of_exact))
    )
    for name in ("sobol_first", "sobol_total"):
        moved = reference[name] - before[name]
        np.testing.assert_allclose(found[f"{name}_mesh_error"], moved, rtol=0.02, atol=2e-4)
        assert abs(moved).max() > 0.005
    local = slopes_of_exact(INPUTS.mean) - before["derivative"]
    np.testing.assert_allclose(found["derivative_mesh_error"], local, atol=2e-3)
    nominal = model.exact.solve(INPUTS.mean).outputs - before["nominal"]
    np.testing.assert_allclose(found["nominal_mesh_error"], nominal, atol=1e-3)


def slopes_of_exact(p):
    first, second = (
        [1 / p[1] + 0.04, -p[0] / p[1] ** 2 - 0.02],
        [2 * p[0] / p[1], -((p[0] / p[1]) ** 2) + 0.2 * (p[1] - 1.5)],
    )
    return np.array([first, second])


def test_correlated_parameters():
    inputs = Inputs({"a": Normal(mean=1.2, std=0.05), "b": LogNormal(mean=1.5, std=0.2)}, (("a", "b", 0.8),))
    model = on_mesh(lambda p: [0.3 * (p[0] - 1.2) * np.log(p[1]), 0.1 * p[0]])
    _, found = studied(QuasiMonteCarlo(samples=256), model, count=12, inputs=inputs)
    coarse, exact = exact_moments(model, inputs)
    np.testing.assert_allclose(found["mesh_error"], (exact - coarse).mean(axis=0), rtol=0.1)
    np.testing.assert_allclose(found["std_mesh_error"], exact.std(axis=0) - coarse.std(axis=0), rtol=0.1)


@pytest.mark.few(1)
@pytest.mark.parametrize(("more", "method"), [(20, Chaos(samples=48, max_order=3)), (300, MonteCarlo(samples=400))])
def test_many_parameters_by_few_estimates(more, method):
    names = ("a", "b", *(f"z{i}" for i in range(more)))
    inputs = Inputs(INPUTS.marginals | {name: Normal(mean=0.0, std=1.0) for name in names[2:]})
    model = on_mesh(lambda p: [0.05 * p[0] / p[1] * (1 + 0.01 * p[2]), 0.1 * p[0] ** 2 / p[1] + 0.001 * p[3]], names)
    _, found = studied(method, model, count=4, inputs=inputs)
    coarse, exact = exact_moments(model, inputs)
    np.testing.assert_allclose(found["mesh_error"], (exact - coarse).mean(axis=0), rtol=0.05)
    np.testing.assert_allclose(found["std_mesh_error"], exact.std(axis=0) - coarse.std(axis=0), rtol=0.25)


@pytest.mark.unit
def test_local_derivatives_alone():
    _, found = studied(LocalSensitivity(), on_mesh(lambda p: [0.05 * p[0] / p[1], 0.1 * p[0] ** 2 / p[1]]))
    np.testing.assert_allclose(found["derivative_mesh_error"][0], 0.05 * found["derivative"][0], rtol=1e-5)
    assert "mesh_error" not in found


def test_what_an_expansion_leaves_is_claimed():
    rough = lambda p: [0.01 + 0.02 * np.sin(40 * p[0] + 90 * p[1]), 0.05 * p[0] ** 2 / p[1]]  # noqa: E731
    _, found = studied(Chaos(samples=24), on_mesh(rough), count=8)
    assert 0.005 < found["mesh_error_doubt"][0] < 0.05
    assert found["mesh_error_doubt"][1] == pytest.approx(UNCALIBRATED * found["mesh_error"][1].item(), rel=0.05)
    assert any("does not follow" in one.text and "u" in one.text for one in findings(found))


def test_what_is_seen_is_doubted_more_where_it_varies():
    """A ratio to the output that stays says that one calibration holds; one that does not says that it may not."""
    follows = lambda p: [0.05 * p[0] / p[1], 0.02 * p[0] ** 2 / p[1]]  # noqa: E731
    varies = lambda p: [0.05 * p[0] / p[1], 0.02 * (p[0] / p[1]) ** 6]  # noqa: E731
    steady, moving = (
        studied(Chaos(samples=24), replace(on_mesh(error), doubt=1e-4))[1]["mesh_error_unknown"].to_numpy()
        for error in (follows, varies)
    )
    assert steady[0] == pytest.approx(moving[0], rel=1e-6) == pytest.approx(ELSEWHERE, rel=0.05)
    assert moving[1] > steady[1] + 0.1


def test_what_has_no_estimate_is_named():
    _, found = studied(DerivativeBased(samples=64), on_mesh(affine))
    assert sum("not estimated of the active subspace" in one.text for one in findings(found)) == 1
    _, found = studied(Chaos(samples=24), on_mesh(affine))
    assert not any("not estimated of" in one.text for one in findings(found))


@pytest.mark.parametrize("measured", [True, False])
def test_estimates_with_a_typical_calibration_say_so(measured):
    model = replace(on_mesh(affine), seen=0.8, measured=measured)
    _, found = studied(Chaos(samples=24), model)
    assert any("not measured on a finer mesh" in one.text for one in findings(found)) is not measured


def test_failed_estimates_are_said_and_left_out():
    def error(p):
        if p[1] > limit:
            message = "no factor"
            raise SolveError(message)
        return affine(p)

    limit = 1.8
    model = on_mesh(error)
    _, found = studied(Chaos(samples=24), model, count=10)
    lost = (found["mesh_error_points"][:, 1] > limit).to_numpy()
    assert 0 < lost.sum() < 9
    assert np.isnan(found["mesh_error_values"].values[lost]).all()
    assert any(one.text.endswith(" Why: no factor.") for one in findings(found))
    np.testing.assert_allclose(found["std_mesh_error"] / found["std"], [0.05, -0.1], rtol=0.02)
    limit = 0.0  # none is left
    before, found = studied(Chaos(samples=24), model)
    assert np.isnan(found["mesh_error"]).all()
    assert np.isnan(found["total_error"]).all()
    np.testing.assert_array_equal(found["mean"], before["mean"])
    assert "nothing is known" in findings(found)[0].text
    assert findings(found)[0].severity == "error"


def test_what_is_not_estimated_is_said_by_name():
    _, found = studied(Chaos(samples=24), on_mesh(lambda p: [0.0, np.nan]))
    assert any(
        "no estimate" in one.text and "of v (3 of 3)" in one.text and one.severity == "error" for one in findings(found)
    )
    np.testing.assert_array_equal(np.isnan(found["total_error"]), [False, True])
    told = Told(TOLD.units, frozenset({"v"}))
    _, found = studied(Chaos(samples=24), on_mesh(lambda p: [0.0, np.nan]), told=told)
    said = [one for one in findings(found) if "estimate" in one.text]
    assert [one.severity for one in said] == ["note"]
    assert "not estimated of v: such outputs need not converge" in said[0].text


def test_what_is_zero_by_symmetry_is_of_no_interest():
    """Its errors are many times it, and of no meaning."""
    model = on_mesh(lambda p: [0.01 * p[0], 1e-17 * p[1]])
    coarse = model.function
    small = np.array([1.0, 1e-16])
    exact = replace(model.exact, function=lambda p: (small * (coarse(p) + np.array([0.2 * p[0], 3 * p[1]])).T).T)
    zero = replace(model, function=lambda p: (small * coarse(p).T).T, jacobian=None, exact=exact)
    _, found = studied(MonteCarlo(samples=64), zero, told=Told({"u": "m", "v": "m"}))
    assert abs(found["mesh_error"][1]) > 0.1 * abs(found["mean"][1])
    said = [one.text for one in findings(found) if "mesh" in one.text]
    assert said
    assert not any(" v " in text or " v," in text for text in said)


def test_a_tolerance_that_hides_the_mesh_is_told():
    model = on_mesh(lambda p: [1e-6 * p[0], 0.01 * p[1]])
    for tolerance, hidden in ((1e-4, True), (1e-10, False)):
        _, found = studied(MonteCarlo(samples=64), model, told=Told(TOLD.units, tolerance=tolerance))
        said = [one for one in findings(found) if "The solver's tolerance" in one.text]
        assert bool(said) == hidden
    _, found = studied(MonteCarlo(samples=64), model, told=Told(TOLD.units, tolerance=1e-4))
    (said,) = (one for one in findings(found) if "The solver's tolerance" in one.text)
    assert said.severity == "warning"
    assert "mesh in u:" in said.text


@pytest.mark.few(1)
@pytest.mark.parametrize("method", METHODS, ids=lambda m: f"{m.kind}-{getattr(m, 'design', '')}")
def test_what_facets_hide_is_doubted_in_all_that_has_units(method):
    """As if each output were so many per cent larger: no share of a variance changes by that."""
    whole = replace(on_mesh(affine), doubt=1e-3)
    (_, without), (_, found) = (studied(method, replace(whole, hidden=part)) for part in (None, -0.04))
    sizes = {"mesh_error_doubt": "mean", "std_mesh_error_doubt": "std", "quantiles_mesh_error_doubt": "quantiles"}
    for name, value in sizes.items():
        more = (found[name] - without[name]) / abs(found[value])
        assert ((more > 0.04) & (more < 0.1)).all(), (name, more)  # low quantiles are two thirds of the values there
    for name in ("mean", "mesh_error", "mean_corrected"):
        np.testing.assert_array_equal(found[name], without[name])
    if "sobol_first" in found:
        np.testing.assert_array_equal(found["sobol_first_mesh_error_doubt"], without["sobol_first_mesh_error_doubt"])
    (said,) = (one for one in findings(found) if one.code == "facets")
    assert "u 4.0%, v 4.0%" in said.text
    _, unknown = studied(method, replace(whole, hidden=np.nan))
    assert "facets-unknown" in [one.code for one in findings(unknown)]


@pytest.mark.parametrize("unstable", [False, True])
def test_a_state_that_is_stable_on_its_mesh_alone_is_an_error(unstable):
    _, found = studied(Chaos(samples=12), replace(on_mesh(affine), doubt=1e-3, unstable=unstable))
    assert [one.code for one in findings(found) if one.severity == "error"] == ["unstable-on-finer-mesh"] * unstable


def test_where_the_mesh_decides_and_where_it_is_coarse():
    _, found = studied(Chaos(samples=24), on_mesh(lambda p: [0.02 * p[0] / p[1], 0.2 * p[0] ** 2 / p[1]]))
    said = {one.severity: one.text for one in findings(found)}
    assert "u 1.7 cm against" in said["note"]
    assert "v 220 mPa against" in said["note"]
    assert "mean: v 20%" in said["warning"] or "standard deviation: v 20%" in said["warning"]
    assert "u" not in said["warning"].rpartition(":")[2]
    _, found = studied(MonteCarlo(samples=8), on_mesh(lambda p: [1e-6 * p[0], 1e-6]))
    assert not any("mesh" in one.text for one in findings(found))


@pytest.mark.parametrize(("count", "d"), [(3, 2), (3, 30), (4, 2), (16, 4), (5, 1)])
def test_designs_begin_at_the_mean_and_are_spread(count, d):
    inputs = Inputs({f"z{i}": Normal(mean=1.0, std=2.0) for i in range(d)})
    slopes = np.random.default_rng(1).normal(size=(2, d))
    points = design(inputs, slopes, count, 3)
    np.testing.assert_array_equal(points[0], inputs.mean)
    np.testing.assert_array_equal(points, design(inputs, slopes, count, 3))
    assert not np.array_equal(points[1:], design(inputs, slopes, count, 4)[1:])
    t = (
        (inputs.coordinates.of(points) @ np.linalg.svd(slopes, full_matrices=False)[2][0])
        if count < d + 2
        else inputs.coordinates.of(points)[:, 0]
    )
    assert 0.5 < t.std() < 1.6
    if d == 2:  # no line of points, from which one of two slopes would not be known
        assert np.linalg.svd(inputs.coordinates.of(points))[1][1] > 0.9


@pytest.mark.unit
def test_the_number_of_estimates_is_a_fifth_of_the_solves():
    assert [estimates_for(n) for n in (1, 50, 100, 200, 10_000)] == [3, 3, 5, 10, MOST]
    assert [estimates_for(100, paid) for paid in (-3.0, 2.9, 3.2, 4.0, 100.0)] == [2, 2, 3, 4, 5]


@pytest.mark.unit
def test_results_of_other_shapes_are_left_alone():
    """As methods from outside may give them."""
    model = on_mesh(affine)
    recorder = Recorder(SerialEvaluate(model))
    centre = linearised(INPUTS, recorder, LocalSensitivity().run(INPUTS, recorder) and recorder.first)
    found = estimate(INPUTS, SerialEvaluate(model), centre, FEWEST, 0, fields=True)
    strange = xr.Dataset(
        {
            "mean": ("output", [1.0, 2.0]),  # without an error
            "values": (("draw", "output"), np.zeros((5, 2))),
            "quantiles": ("output", [0.0, 1.0]),
            "sobol_first": ("parameter", [0.5, 0.5]),
        },
        coords={"output": ["u", "v"]},
    )
    after = with_mesh_errors(strange, INPUTS, centre, found, TOLD)
    np.testing.assert_allclose(after["nominal_mesh_error"], affine(INPUTS.mean), rtol=1e-3)
    assert "mesh_error" not in after
    assert "quantiles_mesh_error" not in after


def test_estimates_are_calibrated_once_at_the_mean():
    part = replace(on_mesh(affine), seen=0.6)
    _, plain = studied(Chaos(samples=24), on_mesh(affine))
    _, found = studied(Chaos(samples=24), part)
    for name in ("mesh_error", "std_mesh_error", "quantiles_mesh_error", "derivative_mesh_error"):
        np.testing.assert_allclose(found[name], plain[name], rtol=1e-6)
    np.testing.assert_allclose(found["mesh_error_saturation"], 1 / 0.6)
    relative = np.hypot(UNCALIBRATED, ELSEWHERE), UNCALIBRATED  # nobody says how far this calibration may be wrong
    for one, share in zip((found, plain), relative, strict=True):
        np.testing.assert_allclose(one["mesh_error_doubt"], share * abs(one["mesh_error"]), rtol=0.05)


def test_what_estimates_miss_is_added_and_its_doubt_is_told():
    _, plain = studied(Chaos(samples=24), on_mesh(affine))
    sure, unsure = (
        studied(Chaos(samples=24), replace(on_mesh(affine), missed=0.2, doubt=doubt))[1] for doubt in (0.01, 0.2)
    )
    for name in ("mesh_error", "std_mesh_error", "quantiles_mesh_error", "derivative_mesh_error"):
        np.testing.assert_allclose(sure[name], plain[name], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(sure["mesh_error_shift"], 0.2 * on_mesh(affine).function(INPUTS.mean))
    at_mean = abs(np.array(affine(INPUTS.mean)))
    for found, doubt in ((sure, 0.01), (unsure, 0.2)):
        relative = found["mesh_error_unknown"].to_numpy()
        assert (relative >= np.hypot(doubt / at_mean, ELSEWHERE)).all()
        assert (relative <= np.hypot(doubt / at_mean, np.hypot(ELSEWHERE, CHANGED))).all()
        np.testing.assert_allclose(found["mesh_error_doubt"], relative * abs(found["mesh_error"]), rtol=0.05)
    told = "of the error of the mesh is known for u, v: errors of several places cancel"
    assert any(told in one.text for one in findings(unsure))
    assert not any("several places cancel" in one.text for one in findings(sure))


@pytest.mark.unit
@pytest.mark.parametrize("error", [0.02, -0.05])
def test_errors_are_what_is_to_be_added(error):
    """Exact minus computed: they have the sign of what the mesh misses, and corrected values are the exact ones."""
    exact = FunctionModel(
        lambda p: np.array([p[0] / p[1] + error, 2 * p[0] / p[1] * (1 + error)]), ("a", "b"), ("u", "v")
    )

    def coarse(p):
        return np.array([p[0] / p[1], 2 * p[0] / p[1]])

    def slopes(p):
        return np.array([[1 / p[1], -p[0] / p[1] ** 2], [2 / p[1], -2 * p[0] / p[1] ** 2]])

    model = OnMesh(coarse, ("a", "b"), ("u", "v"), slopes, exact)
    data, found = studied(MonteCarlo(samples=64), model)
    mean, std = data["mean"].to_numpy(), data["std"].to_numpy()
    np.testing.assert_allclose(found["mesh_error"], [error, error * mean[1]], rtol=0.05)
    np.testing.assert_allclose(found["mean_corrected"], mean + found["mesh_error"], rtol=1e-12)
    np.testing.assert_allclose(found["std_corrected"], std * [1, 1 + error], rtol=0.01)
    np.testing.assert_allclose(found["nominal_corrected"], exact.function(INPUTS.mean), rtol=1e-3)
    for name, sampling in (("", data["mean_error"]), ("std_", data["std_error"])):
        doubt, size = found[f"{name}mesh_error_doubt"].to_numpy(), np.abs(found[f"{name}mesh_error"].to_numpy())
        np.testing.assert_allclose(found[f"{name}total_error"], np.hypot(sampling, size + doubt), rtol=1e-12)
        corrected = found["mean_corrected_error" if not name else "std_corrected_error"]
        np.testing.assert_allclose(corrected, np.hypot(sampling, doubt), rtol=1e-12)
