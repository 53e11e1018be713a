"""What pictures are computed from, and what is written at their axes."""

import numpy as np
import pytest
import xarray as xr
from scipy.stats import gaussian_kde, multivariate_normal

from workflows.report import plots
from workflows.report.plots import places, posterior
from workflows.report.plots.figure import in_fitting_units
from workflows.report.scene.scene import spread_over


@pytest.mark.parametrize("d", [1, 2])
def test_densities_are_those_of_scipy(d):
    rng = np.random.default_rng(d)
    draws = rng.normal(size=(60, d)) @ np.diag([3e-5, 4e8][:d]) + [1.0, -2e9][:d]
    weights = rng.uniform(size=60)
    shares = weights / weights.sum()
    at = draws[:7] * 1.0000001
    known = gaussian_kde(draws.T, weights=weights)  # Scott's rule with the effective number of draws
    # SciPy's covariance is that of a sample: divided by one minus the sum of squared shares.
    slight = 1 - (shares**2).sum()
    known.set_bandwidth(known.factor * np.sqrt(slight))
    np.testing.assert_allclose(posterior.density(draws, shares, at), known(at.T), rtol=1e-6)


def test_contours_hold_what_they_say():
    x = np.linspace(-6, 6, 241)
    lattice = np.stack(np.meshgrid(x, x), axis=-1)
    density = multivariate_normal([0, 0], [[1, 0.6], [0.6, 1]]).pdf(lattice)
    outer, inner = posterior.levels(density)
    # A Gaussian in two dimensions has the share p where it is above (1 - p) times its top.
    assert outer == pytest.approx(0.1 * density.max(), rel=0.02)
    assert inner == pytest.approx(0.5 * density.max(), rel=0.02)


def test_draws_that_are_worth_few_are_smoothed():
    draws = np.repeat([[0.0], [1.0]], 200, axis=0)
    shares, at = np.full(400, 1 / 400), np.array([[0.0], [0.5]])
    peak, middle = posterior.density(draws, shares, at)
    assert middle < 0.2 * peak
    peak, middle = posterior.density(draws, shares, at, 2.0)
    assert middle > 0.8 * peak


@pytest.mark.parametrize(
    ("values", "label", "written", "numbers"),
    [
        ([0.0, 0.04], "x (m)", "x (cm)", ["0", "1", "2", "3", "4"]),
        ([0.0288, 0.0289], "inclusion x (m)", "inclusion x (cm)", ["2.88", "2.89"]),
        ([-2e6, 2e6], "stress (Pa)", "stress (MPa)", ["−2", "0", "2"]),
        ([0.0, 2.0], "stretch", "stretch", ["0", "1", "2"]),
    ],
)
def test_axes_are_in_fitting_units(values, label, written, numbers):
    ax = plots.axes()
    ax.plot([0, 1], values)
    ax.set_ylim(values)
    ax.locator_params(axis="y", nbins=max(2, len(numbers) - 1))
    ax.set_ylabel(label)
    in_fitting_units(ax.figure)
    ax.figure.draw_without_rendering()
    assert ax.get_ylabel() == written
    if label != "stretch":
        assert _shown(ax) == numbers
    assert ax.lines[0].get_ydata().tolist() == values  # which stay in SI units


def _shown(ax):
    low, high = ax.get_ylim()
    return [t.get_text() for t in ax.get_yticklabels() if low - 1e-9 <= t.get_position()[1] <= high + 1e-9]


def test_powers_of_ten_are_letters():
    ax = plots.axes()
    ax.set_yscale("log")
    ax.set_ylim(0.8e-3, 12)
    in_fitting_units(ax.figure)
    ax.figure.draw_without_rendering()
    assert _shown(ax) == ["10⁻³", "10⁻²", "10⁻¹", "1", "10"]


def test_values_between_points_are_those_of_the_nearest():
    lattice = np.stack(np.meshgrid([0.0, 1, 2], [0.0, 1, 2], [0.0]), axis=-1).reshape(-1, 3)
    at = np.array([[1.0, 1, 0], [0.5, 0.5, 0], [2.0, 2, 3]])
    (found,) = spread_over(lattice, at, lattice[:, 0])
    assert found[0] == pytest.approx(1.0)
    assert found[1] == pytest.approx(0.5)
    assert np.isnan(found[2])  # far from all points


def test_the_most_probable_model_stands_out():
    of = xr.Dataset(
        {"log_evidence": ("model", [-3.0, -1.0, -2.0]), "probability": ("model", [0.1, 0.7, 0.2])},
        {"model": ["gent", "ogden", "yeoh"]},
    )
    of = of.assign(prior_probability=("model", [1 / 3] * 3))
    found = plots.selection.colours(of)
    assert [name for name, colour in found.items() if colour == plots.HIGH] == ["ogden"]
    assert len(set(found.values())) == 3


def test_measured_displacements_are_drawn_over_predicted_ones_in_one_unit():
    predicted = np.array([1e-3, 2e-3, -3e-3, 0.5])
    one = xr.Dataset(
        {
            "measured": ("datum", predicted + 1e-4),
            "predicted": ("datum", predicted),
            "datum_axis": ("datum", [0, 1, 2, 3]),  # the last is a force
            "datum_case": ("datum", [0, 0, 1, 1]),
        },
        coords={"case": ["shear", "press", "unseen"]},
    )
    ax = places.agreement(one)
    shear, press, line = (np.array(drawn.get_xydata()) for drawn in ax.lines)
    np.testing.assert_allclose(shear, [[1, 1.1], [2, 2.1]])
    np.testing.assert_allclose(press, [[-3, -2.9]])
    np.testing.assert_allclose(line, [[-3, -3], [2.1, 2.1]])
    assert ax.get_xlabel() == "predicted displacement (mm)"
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["shear", "press"]
