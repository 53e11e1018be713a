"""Inversion of stiffness fields by finite elements: load cases, derivatives, recovery, and what the data constrain."""

from functools import cache

import numpy as np
import pytest
from mpi4py import MPI
from pydantic import ValidationError
from scipy.stats import chi2

from benchmarks.inversion import FIELD, NOISE, problem, specimen, truth
from forward.bodies.geometry import Box
from forward.bodies.random_fields import Matern
from forward.conformance import check_derivatives
from forward.hyperelastic import Hyperelastic
from forward.model import Guess, SolveError, Stability
from forward.specimen import Specimen
from inverse.criticism.field_samples import bent
from inverse.data.noise import Noise
from inverse.fields.field_posterior import FieldPosterior, Point
from inverse.fields.low_rank import LowRankPosterior
from inverse.fields.newton_cg import CLOSE, find_mode
from tests.launch import on_kept_ranks
from tests.matern import inflation

POINTS = 9  # along each edge of the cube
SMALL = {"size": (1.0, 0.7, 0.8), "cells": (2, 2, 2), "degree": 1}
MATERIAL = {"kind": "neo-hookean-coupled", "mu": 1e4, "lmbda": 4e4}
PULLED = {
    "name": "pulled",
    "clamp": ("z-min",),
    "loads": ({"kind": "traction", "on": "z-max", "direction": (1, 0, 1), "size": 900.0},),
}
MOVED = {"name": "moved", "clamp": ("x-min",), "displacements": ({"on": "x-max", "x": 0.1, "y": 0.05},)}
OBSERVED = ({"on": "y-max", "components": "xz"}, {"at": ((0.55, 0.3, 0.71), (1.0, 0.0, 0.8)), "cases": ("moved",)})


def small(**changes):
    blocks = {
        "body": SMALL,
        "material": MATERIAL,
        "fields": ({"of": "stiffness", "length": 0.6, "std": 0.4, "basis": "nodes"},),
        "cases": (PULLED, MOVED),
        "observed": OBSERVED,
        "solver": {"tolerance": 1e-12},
    }
    return Specimen.model_validate(blocks | changes)


def built(comm=MPI.COMM_SELF):
    spec = small()
    names = ("material.mu", "displacements.x-max.x", *spec.coefficients)
    point = np.concatenate([[1.1e4, 0.12], 0.3 * np.random.default_rng(0).standard_normal(len(spec.coefficients))])
    return spec.build(comm, names), point


# --- load cases ------------------------------------------------------------------------------------------------------


def test_observations_are_displacements_of_the_same_body_in_each_case():
    model, point = built()
    found = model.solve(point).outputs
    assert len(found) == len(model.outputs) == len(model.places) == 2 * 9 * 2 + 2 * 3
    assert model.outputs[0] == "pulled.y-max.0.x"
    assert model.outputs[-1] == "moved.points.1.z"
    np.testing.assert_allclose(model.places[:18, 1], 0.7)
    expected = []
    for number, case in enumerate((PULLED, MOVED)):
        mine = model.cases == number
        outputs = tuple(
            {"kind": "displacement", "name": str(i), "at": tuple(place), "component": "xyz"[axis]}
            for i, (place, axis) in enumerate(zip(model.places[mine].tolist(), model.axes[mine], strict=True))
        )
        blocks = {name: getattr(model.spec, name) for name in ("body", "material", "fields", "solver")}
        acting = {name: value for name, value in case.items() if name != "name"}
        body = Hyperelastic.model_validate(blocks | acting | {"outputs": outputs})
        names = tuple(name for name in model.parameters if name in body.scalars or name.startswith("fields"))
        values = [value for name, value in zip(model.parameters, point, strict=True) if name in names]
        expected.append(body.build(MPI.COMM_SELF, names).solve(np.array(values)).outputs)
    np.testing.assert_allclose(found, np.concatenate(expected), rtol=1e-9, atol=1e-14)


def test_derivatives_of_all_cases():
    model, point = built()
    scale = np.concatenate([[300.0, 0.01], np.full(len(point) - 2, 0.3)])
    directions = np.vstack([np.eye(len(point))[[0, 1, 5]], np.random.default_rng(2).uniform(-1, 1, len(point))])
    check_derivatives(
        model, point, scale, directions=directions, steps=(1 / 32, 1 / 64, 1 / 128), accuracy=1e-12
    ).require()


def test_products_use_the_factors_of_their_solution():
    model, point = built()
    solution = model.solve(point)
    solution.tangent(point)
    before = solution.work
    for _ in range(3):
        solution.adjoint(solution.tangent(np.stack([point, point])))
    assert solution.work.factorisations == before.factorisations
    assert solution.work.back_substitutions == before.back_substitutions + 3 * 2 * 2 * 2  # rows, cases, ways


def test_states_of_all_cases_start_solves():
    model, point = built()
    solution = model.solve(point)
    near = point * (1 + 1e-6)
    assert model.solve(near, Guess(solution.state)).work.factorisations < model.solve(near).work.factorisations
    whole = model.space.gather(solution.state[None])
    np.testing.assert_array_equal(model.space.scatter(whole)[0], solution.state)


def test_the_case_without_an_answer_is_named():
    model, point = built()
    with pytest.raises(SolveError, match="load case 'moved'"):
        model.solve(np.array([point[0], -1.5, *point[2:]]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cases": (PULLED, PULLED)}, "2 of them are called 'pulled'"),
        ({"cases": (PULLED, {**MOVED, "clamp": ()})}, "nothing holds the body along z"),
        ({"observed": ({"on": "top"},)}, "unknown boundary"),
        ({"observed": ({"on": "z-max", "cases": ("push",)},)}, "unknown load case"),
        ({"observed": ({"on": "z-max", "cases": ("moved",)},)}, "nothing is measured"),
        ({"observed": ({"at": ((2.0, 0.0, 0.0),)},)}, "outside the body"),
        ({"observed": ({"name": "top"},)}, "either a boundary"),
    ],
)
def test_mistakes_are_named(changes, message):
    with pytest.raises(ValidationError, match=message):
        small(**changes)


SCRIPT = """
import sys
import numpy as np
from mpi4py import MPI
from tests.inverse.fields.test_field_inversion import built

model, point = built(MPI.COMM_WORLD)
solution = model.solve(point)
found = solution.outputs, solution.tangent(point), solution.adjoint(np.ones(len(model.outputs)))
state = model.space.gather(solution.state[None])
if MPI.COMM_WORLD.rank == 0:
    np.savez(sys.argv[1], *found, state)
"""


@pytest.mark.mpi
def test_ranks_do_not_matter(tmp_path):
    run = on_kept_ranks(2, SCRIPT, tmp_path / "found.npz")
    assert run.returncode == 0, run.stderr
    model, point = built()
    solution = model.solve(point)
    expected = solution.outputs, solution.tangent(point), solution.adjoint(np.ones(len(model.outputs)))
    with np.load(tmp_path / "found.npz") as found:
        for name, values in zip(found.files, (*expected, model.space.gather(solution.state[None])), strict=True):
            np.testing.assert_allclose(found[name], values, atol=1e-9 * np.abs(values).max())


# --- prior -----------------------------------------------------------------------------------------------------------


def test_the_prior_has_the_variance_that_was_asked_and_the_closed_form_inside():
    body = Box(size=(1.0, 1.0, 1.0), cells=(8, 8, 8), degree=1)
    prior = FIELD.prior(body)
    identity = np.eye(body.vertex_count)
    root = prior.root(identity)  # rows: the columns of the root
    np.testing.assert_allclose((root**2).sum(axis=0), np.log1p(0.6**2), rtol=1e-10)
    np.testing.assert_allclose(prior.variance, np.log1p(0.6**2))
    np.testing.assert_allclose(prior.root_transposed(identity), root.T, atol=1e-12)
    # Before it is divided by its standard deviation, the field at the centre has the variance of unbounded space.
    assert inflation(Matern.on(body, 0.4), 0.4)[364] == pytest.approx(1, abs=0.1)


# --- inversion -------------------------------------------------------------------------------------------------------


@cache
def coarse():
    posterior, true = problem(4)
    return posterior, true, find_mode(posterior)


def part(posterior, measured):
    """The same posterior of some of its data."""
    return FieldPosterior(posterior.model, np.where(measured, posterior.data, np.nan), posterior.noise, posterior.prior)


def test_gradient_and_product_are_derivatives_of_the_density():
    posterior, _, _ = coarse()
    rng = np.random.default_rng(0)
    whitened, direction = 0.3 * rng.standard_normal((2, posterior.size))
    exact = FieldPosterior(
        posterior.model, posterior.model.solve(posterior.values(whitened)).outputs, posterior.noise, posterior.prior
    )
    for which, about in ((posterior, whitened + 0.1), (exact, whitened)):
        point = which.at(about)
        gradient, curve = point.gradient, direction + point.product(direction)
        moved = {h: which.at(about + h * direction) for h in (1e-2, 5e-3)}
        errors = [abs(there.cost - point.cost - h * gradient @ direction) for h, there in moved.items()]
        assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.2)
        if which is exact:  # nothing is left of the residual: Gauss–Newton is Newton
            errors = [np.linalg.norm(there.gradient - gradient - h * curve) for h, there in moved.items()]
            assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.2)


def test_the_mode_is_found_and_explains_the_data():
    _, true, mode = coarse()
    assert mode.converged
    assert 1 + sum(row.solves for row in mode.iterations) <= 20
    assert mode.products <= 400
    found = LowRankPosterior.at(mode.point, cutoff=1.0)
    residual = mode.point.residual
    square = residual @ residual + found.whitened @ found.whitened
    assert chi2(len(residual)).sf(square) > 0.01
    assert (np.abs(found.mean - true) < 2 * found.std).mean() >= 0.9
    again = mode.point.product(found.spectrum.vectors[:3])
    expected = found.spectrum.values[:3, None] * found.spectrum.vectors[:3]
    np.testing.assert_allclose(again, expected, atol=1e-2 * found.spectrum.values[2])


def test_samples_near_the_mode_are_screened_rather_than_counted():
    posterior, _, mode = coarse()
    seen = []

    class Watched:
        def __getattr__(self, name):
            return getattr(posterior.model, name)

        def solve(self, parameters, guess=None):
            solution = posterior.model.solve(parameters, guess)
            seen.append(solution.stability)
            return solution

    watched = FieldPosterior(Watched(), posterior.data, posterior.noise, posterior.prior)
    point = Point(watched, mode.point.whitened, mode.point.values, mode.point.solution)
    found = LowRankPosterior.at(mode.point, cutoff=1.0)
    _, densities = bent(point, found)(np.random.default_rng(3).standard_normal((4, posterior.size)))
    assert np.isfinite(densities).all()
    assert len(seen) == 8
    assert seen.count(Stability.SCREENED) >= 4  # some are counted at random, in any of three cases


def test_three_load_cases_constrain_more_directions_than_any_one():
    posterior, _, mode = coarse()
    whitened = mode.point.whitened

    def spectrum(measured):
        return LowRankPosterior.at(part(posterior, measured).at(whitened), cutoff=1.0).spectrum.values

    cases = posterior.model.cases
    together = spectrum(cases >= 0)
    for number in range(3):
        alone = spectrum(cases == number)
        assert len(alone) < len(together)
        assert (alone < together[: len(alone)] * (1 + 1e-6)).all()


def recovered(fine, cells, **settings):
    """Posteriors of all data that a finer mesh has made, and of 5 % of the points; with the truth."""
    maker, model = (
        spec.build(MPI.COMM_SELF, spec.coefficients) for spec in (specimen(fine, POINTS), specimen(cells, POINTS))
    )
    clean = maker.solve(truth(maker.space.coordinates)).outputs
    rng = np.random.default_rng(0)
    sigma = (
        NOISE * np.array([np.sqrt((clean[model.cases == k] ** 2).mean()) for k in np.unique(model.cases)])[model.cases]
    )
    data = clean + sigma * rng.standard_normal(len(clean))
    posterior = FieldPosterior(model, data, Noise(sigma), FIELD.prior(model.spec.body))
    few = np.repeat(rng.uniform(size=len(data) // 3) < 0.05, 3)
    posteriors = [posterior, part(posterior, few)]
    found = [LowRankPosterior.at(find_mode(p).point, **settings) for p in posteriors]
    return found, truth(model.space.coordinates)


@pytest.mark.slow
def test_an_inclusion_is_recovered_from_another_mesh():
    (everything, few), true = recovered(12, 8, cutoff=0.5)
    assert (np.abs(everything.mean - true) < 2 * everything.std).mean() >= 0.9
    inside, outside = true > np.quantile(true, 0.95), true < np.quantile(true, 0.5)
    contrast = everything.mean[inside].mean() - everything.mean[outside].mean()
    assert contrast > 0.5 * (true[inside].mean() - true[outside].mean())  # the inclusion is seen
    assert np.corrcoef(everything.mean, true)[0, 1] > 0.7
    assert (few.std > everything.std - 1e-9).mean() > 0.99
    assert few.std.mean() > 1.2 * everything.std.mean()
    assert few.spectrum.determined < everything.spectrum.determined


@pytest.mark.slow
def test_meshes_do_not_matter():
    rows = []
    for cells in (7, 12):
        posterior, _ = problem(cells)
        mode = find_mode(posterior)
        found = LowRankPosterior.at(mode.point, rank=100)
        solves, spectrum = 1 + sum(row.solves for row in mode.iterations), found.spectrum
        rows.append([solves, mode.products + spectrum.products, spectrum.determined, spectrum.values[0]])
    np.testing.assert_allclose(*rows, rtol=0.2)


# --- forces alone ----------------------------------------------------------------------------------------------------


@pytest.mark.flags
def test_a_field_is_felt_from_forces_alone():
    """Palpation at four places: mode and variance are those of dense algebra, and the stiff side is found."""
    ball = {"kind": "indenter", "shape": "sphere", "radius": 0.8, "on": "z-max", "direction": (0, 0, -1), "depth": 0.08}
    at = [(x, y) for x in (0.25, 0.75) for y in (0.25, 0.75)]
    cases = tuple(
        {
            "name": f"place-{number}",
            "clamp": ("z-min",),
            "loads": (ball | {"at": (x, y, 0.5)},),
            "outputs": ({"kind": "force", "name": "force"},),
        }
        for number, (x, y) in enumerate(at)
    )
    field = {"of": "stiffness", "length": 0.5, "std": 0.5, "basis": "nodes"}
    body = {"size": (1.0, 1.0, 0.5), "cells": (3, 3, 2), "degree": 1}
    spec = small(body=body, cases=cases, observed=(), fields=(field,))
    prior, names = spec.fields[0].prior(spec.body), spec.coefficients
    model = spec.build(MPI.COMM_SELF, names)
    places = model.vertices.coordinates
    true = np.where(places[:, 0] > 0.5, 0.6, -0.3)
    assert len(true) == len(names) == 48
    data = model.solve(true).outputs
    sigma = 0.03 * data
    posterior = FieldPosterior(model, data * (1 + 0.03 * np.array([1, -1, 0.5, -0.5])), Noise(sigma), prior)
    mode = find_mode(posterior)
    found = LowRankPosterior.at(mode.point, cutoff=1e-8)
    assert mode.converged
    values = mode.point.values
    J = model.solve(values).adjoint(np.eye(4))
    root = prior.root(np.eye(48))  # rows L e_i
    covariance = root.T @ root
    gap = (posterior.data - mode.point.solution.outputs) / sigma**2
    exact = np.linalg.inv(np.linalg.inv(covariance) + J.T @ np.diag(sigma**-2.0) @ J)
    gradient = np.linalg.solve(covariance, values) - J.T @ gap
    assert np.sqrt(gradient @ exact @ gradient) < CLOSE  # so many posterior deviations from the mode the search ends
    np.testing.assert_allclose(found.std, np.sqrt(np.diag(exact)), rtol=1e-4)
    top = places[:, 2] > 0.4
    stiff, soft = (values[top & side].mean() for side in (places[:, 0] > 0.6, places[:, 0] < 0.4))
    assert stiff - soft > 0.4  # of 0.9: what four forces leave open is the prior's
