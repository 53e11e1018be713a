"""Doubts about posteriors: each is raised by what it is meant for, by name, and not by what is right."""

import numpy as np
import pytest
import xarray as xr

from inverse.criticism.doubts import (
    at_an_end,
    far_from_prior,
    little_seen,
    noise_far,
    of_mesh,
    scores,
    strangers,
    too_large_errors,
)
from uq.inputs.distributions import Beta, LogNormal, LogUniform, Normal, Uniform

pytestmark = pytest.mark.unit

RNG = np.random.default_rng(2)
BELL = Normal(mean=1e3, std=300.0)


def test_distances_are_in_prior_deviations():
    np.testing.assert_allclose(scores(BELL, np.array([1e3, 3.4e3, -1.4e3])), [0, 8, -8], atol=1e-9)
    skewed = LogNormal(mean=3.0, std=3.0)
    z = np.array([-3.0, 0.0, 2.5])
    np.testing.assert_allclose(scores(skewed, skewed.from_normal(z)[0]), z, atol=1e-4)


def test_a_posterior_far_from_its_prior_is_named():
    priors = {"mu": BELL, "kappa": Normal(mean=0.0, std=1.0)}
    mode, mean = np.array([3.4e3, 0.5]), np.array([3.3e3, 0.4])
    (doubt,) = far_from_prior(priors, mode, mean, 64.0, 2.0)
    assert doubt.severity == "error"
    assert "mu (3,400) lies 8.0 prior deviations from the prior (1,000)" in doubt.text
    assert "kappa" not in doubt.text
    assert not far_from_prior(priors, np.array([1500.0, 1.0]), np.array([1500.0, 1.0]), 3.0, 2.0)
    (doubt,) = far_from_prior(priors, np.array([1500.0, 0.0]), np.array([2000.0, 0.0]), 3.0, 2.0)  # the mean alone
    assert doubt.severity == "warning"


def test_all_together_may_be_far_where_none_is():
    priors = {f"p{i}": Normal(mean=0.0, std=1.0) for i in range(30)}
    x = np.full(30, 1.9)
    (doubt,) = far_from_prior(priors, x, x, float(x @ x), 30.0)
    assert "All unknowns together" in doubt.text
    assert not far_from_prior(priors, 0 * x, 0 * x, 30.0, 30.0)
    assert not far_from_prior(priors, 0 * x, 0 * x, 0.0, 0.0)


@pytest.mark.parametrize(
    "prior", [Uniform(lower=1, upper=3), LogUniform(lower=1, upper=3), Beta(a=2, b=2, lower=1, upper=3)]
)
def test_ends_of_ranges_are_named(prior):
    u = RNG.uniform(size=400)
    draws = prior.quantile(u)[:, None]
    middle = prior.quantile(np.array([0.5]))
    assert not at_an_end({"a": prior}, middle, draws)  # the prior itself
    assert not at_an_end({"a": prior}, middle, prior.quantile(0.4 + 0.05 * u)[:, None])
    (doubt,) = at_an_end({"a": prior}, prior.quantile(np.array([0.99])), prior.quantile(1 - 0.05 * u)[:, None])
    assert doubt.text.startswith("a is at the upper end of its range (3)")
    (doubt,) = at_an_end({"a": prior}, prior.quantile(np.array([0.002])), prior.quantile(0.3 * u)[:, None])
    assert "lower end of its range (1)" in doubt.text
    assert not at_an_end({"a": BELL}, np.array([9e3]), np.full((10, 1), 9e3))


@pytest.mark.parametrize(
    ("factor", "told"),
    [
        (1.2, None),
        (2.9, None),
        (12.0, "12 times the stated"),
        (0.1, "0.1 times"),
        (92.0, "does not explain these data"),
    ],
)
def test_an_inferred_noise_far_from_the_stated_one_is_said(factor, told):
    values = RNG.standard_normal(200)
    found = noise_far(factor, 1.0, np.full(200, 0.01), values)
    assert (told is None and not found) or told in found[0].text
    assert not found or found[0].severity == ("error" if factor > 50 else "warning")


def test_a_prior_of_the_noise_may_expect_it_elsewhere():
    assert not noise_far(0.1, 0.1, np.full(9, 0.01), np.ones(9))
    assert noise_far(12.0, 2.0, np.full(9, 0.01), np.ones(9))


def test_errors_that_are_said_too_large():
    assert too_large_errors(1.0, 100.0, 1.0)[0].text.startswith("Residuals are 0.1 times the stated errors")
    assert not too_large_errors(80.0, 100.0, 0.9)
    assert not too_large_errors(0.0, 0.0, 1.0)


def test_data_that_do_not_belong_are_listed():
    r = RNG.standard_normal(300)
    labels = [f"line {i}" for i in range(300)]
    assert not strangers(r, np.zeros(300), labels, heavy=False)
    r[[7, 200]] = 9.0, -6.0
    (doubt,) = strangers(r, np.zeros(300), labels, heavy=False)
    assert "2 data do not belong" in doubt.text
    assert "line 7: +9.0; line 200: −6.0" in doubt.text
    assert doubt.severity == "warning"
    assert strangers(r, np.zeros(300), labels, heavy=True)[0].severity == "note"
    assert not strangers(
        10 * RNG.standard_normal(300), np.zeros(300), labels, heavy=False
    )  # all are: the model is wrong
    r = RNG.standard_normal(300)
    r[3] = 1.5
    resolution = np.zeros(300)
    resolution[3] = 0.95  # a datum that all but decides on its own prediction
    (doubt,) = strangers(r, resolution, labels, heavy=False)
    assert "line 3: +6.7" in doubt.text


def moved(shifts, left=None, nodes=(), why=""):
    """Results with shifts by a mesh, and what is left of its correction; without that it is not corrected."""
    found = {"mesh_corrected": left is not None, "mesh_checked": not why, "mesh_why": why}
    found["mesh_shift"] = ("parameter", list(shifts.values()))
    found["mesh_left"] = ("parameter", [(left or {}).get(name, np.nan) for name in shifts])
    if len(nodes):
        found["stiffness_mesh_shift"] = ("node", nodes)
    return xr.Dataset(found, {"parameter": list(shifts)})


def test_the_mesh_is_doubted_by_what_it_does_to_the_unknowns():
    error = np.array([0.1, -0.3])
    (note,) = of_mesh(moved({"x": 0.1, "noise": np.nan}), error, settled=True)
    assert note.severity == "note"
    (doubt,) = of_mesh(moved({"x": 0.1, "radius": -0.9}), error, settled=True)
    assert doubt.severity == "warning"
    assert "radius −0.9, x +0.1" in doubt.text
    assert of_mesh(moved({"x": 2.5}), error, settled=True)[0].severity == "error"
    assert of_mesh(moved({"mean": 0.0}, nodes=np.full(9, 0.7)), error, settled=True)[0].severity == "warning"
    (doubt,) = of_mesh(moved({"x": np.nan}, why="method.mesh_check = false"), np.full(2, np.nan), settled=True)
    assert doubt.text == "Not checked for the mesh: method.mesh_check = false."
    assert doubt.severity == "warning"


def test_a_corrected_mesh_is_a_note_unless_it_decides():
    error, shifts = np.array([0.4, -1.2]), {"x": 3.1, "y": -0.2, "noise": np.nan}
    (note,) = of_mesh(moved(shifts, {"x": 0.3, "noise": np.nan}), error, settled=True)
    assert note.severity == "note"
    assert "was corrected" in note.text
    assert "x +3.1, y −0.2" in note.text
    assert "up to 0.3 of these deviations" in note.text
    for changed in ({"settled": False}, {"left": {"x": 0.9}}, {"shifts": {"x": -25.0}}, {"nodes": np.full(3, 30.0)}):
        given = {"shifts": shifts, "left": {"x": 0.3}, "settled": True} | changed
        settled = given.pop("settled")
        (doubt,) = of_mesh(moved(**given), error, settled=settled)
        assert doubt.severity == "warning"
        assert "take a finer one" in doubt.text
    one = moved(shifts, {"x": 0.3})
    (doubt,) = of_mesh(one, 10 * error, settled=False)
    assert doubt.severity == "error"
    for size, severity in ((1.5, "note"), (3.0, "warning")):  # as far as intervals of bodies from files hold
        (doubt,) = of_mesh(one, np.full(9, size), settled=True, from_file=True)
        assert doubt.severity == severity
    # Of a field, what the data determine best may be wrong where vertices are not.
    one = moved({"mean": 0.4}, {"mean": 0.3}, np.full(3, 0.4))
    for size, counted, severity in ((3.5, True, "note"), (4.5, True, "warning"), (3.5, False, "warning")):
        (doubt,) = of_mesh(one, np.full(9, size), settled=True, counted=counted)
        assert doubt.severity == severity
        assert ("what the data determine best" in doubt.text) == (severity == "warning")


def test_where_a_field_is_its_prior_is_said():
    """Of four vertices two are as wide as before; where the prior knows everything, data cannot add to it."""
    places = np.arange(12.0).reshape(4, 3)
    (doubt,) = little_seen(np.array([0.1, 0.49, 0.5, 0.3]), np.full(4, 0.5), places)
    assert doubt.severity == "note"
    assert "At 50 % of the vertices" in doubt.text
    assert "0.2 of it at (0, 1, 2) m" in doubt.text
    assert "1 of it at (6, 7, 8) m" in doubt.text
    assert little_seen(np.full(4, 0.1), np.full(4, 0.5), places) == []
    assert little_seen(np.zeros(4), np.zeros(4), places)[0].text.startswith("At 100 %")
