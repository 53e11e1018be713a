"""Uncertain registrations: what they do to data, intervals that hold, a posterior that does not turn with a scan."""

import numpy as np
import pytest
from mpi4py import MPI

from forward.bodies.surface import Surface
from forward.specimen import Specimen
from inverse.data.noise import Noise, StudentErrors
from inverse.data.registration import Rigid, exponential
from inverse.data.shared_motion import SharedMotion, determined
from inverse.fields.low_rank import Spectrum

pytestmark = pytest.mark.fem

SIZE = 0.05
PARAMETERS = ("material.mu", "inclusions.lump.x", "inclusions.lump.contrast")
MEAN, SPREAD = np.array([1e3, 0.03, 3.0]), np.array([200.0, 5e-3, 1.0])
LUMP = {"name": "lump", "x": 0.03, "y": 0.02, "z": 0.03, "radius": 0.015, "contrast": 3.0, "width": 0.01}
STD = np.repeat([np.radians(1.0), 5e-4], 3)  # of the registration


@pytest.fixture(scope="module")
def cube():
    traction = {"kind": "traction", "on": "z-max", "direction": [0, 0, -1], "size": 150.0}
    spec = Specimen.model_validate(
        {
            "body": {"size": [SIZE] * 3, "cells": [3, 3, 3], "degree": 1},
            "material": {"kind": "neo-hookean-coupled", "mu": 1e3, "lmbda": 4e3},
            "inclusions": [LUMP],
            "cases": [
                {"name": "press", "clamp": ["z-min"], "loads": [traction]},
                {"name": "shear", "clamp": ["z-min"], "loads": [traction | {"direction": [1, 0, 0]}]},
            ],
        }
    )
    model = spec.build(MPI.COMM_SELF, PARAMETERS)
    return model, model.solve(MEAN)


def scan_of(count, seed=0):
    """Points on all faces but the held one, every component in both cases: places, axes, cases."""
    rng = np.random.default_rng(seed)
    points, face = rng.uniform(size=(count, 3)), rng.integers(5, size=count)
    axis = np.array([0, 0, 1, 1, 2])[face]
    points[np.arange(count), axis] = np.array([0, 1, 0, 1, 1])[face]
    places = np.repeat(SIZE * points, 3, axis=0)
    axes = np.tile([0, 1, 2], count)
    return np.tile(places, (2, 1)), np.tile(axes, 2), np.repeat([0, 1], 3 * count)


def observed(cube, where, states):
    """Values (k, m) of states (k, U) at places, along directions, in load cases."""
    model, _ = cube
    other = model.observing(*where)
    parts = zip(other.bodies, other.states(np.atleast_2d(states)), strict=True)
    return np.concatenate([(body.rows.matrix(body.equations) @ u.T).T for body, u in parts], axis=-1)


def motion_of(scan, cube, *, root, between=None):
    places, axes, cases = scan
    surface = Surface.of(cube[0].spec.body)
    project = lambda points: surface.nearest(points)[0]  # noqa: E731
    between = np.zeros(6) if between is None else between
    return SharedMotion(places, np.eye(3)[axes], cases, root, between, np.full(3, SIZE / 2), project)


def misplaced(scan, cube, motion, centre):
    """Where a scan belongs in truth, and along what: as it was put, moved by the error of its registration."""
    places, axes, cases = scan
    surface = Surface.of(cube[0].spec.body)
    there = surface.nearest(Rigid().moved(motion, centre)(places))[0]
    return there, axes, cases, np.eye(3)[axes] @ exponential(motion[:3]).T


def test_shared_errors_are_those_of_differences(cube):
    """The same as small motions of the scan, one after another, and motions between scans."""
    scan = scan_of(8)
    motion = motion_of(scan, cube, root=np.diag(STD), between=2 * STD)
    state = cube[1].state
    rows = motion.errors(observed(cube, motion.observed, state)[0])
    assert rows.shape == (6 + 12, 48)
    at = observed(cube, (*scan, np.eye(3)[scan[1]]), state)[0]
    for k in range(6):
        small = 1e-4 * np.diag(STD)[k]
        there = observed(cube, misplaced(scan, cube, small, motion.centre), state)[0]
        np.testing.assert_allclose(1e4 * (there - at), rows[k], atol=2e-3 * np.abs(rows[:6]).max())
    places = scan[0] + np.array([at[i - i % 3 : i - i % 3 + 3] for i in range(48)])
    for k in range(6):
        moved = Rigid().moved(2e-6 * np.diag(STD)[k], motion.centre)(places) - places
        expected = 1e6 * moved[np.arange(48), scan[1]]
        np.testing.assert_allclose(rows[6 + k] + rows[12 + k], expected, atol=1e-6 * np.abs(expected).max())


def test_intervals_hold_with_an_uncertain_registration(cube):
    """Of 60 truths in 95 % intervals: with the motions among the errors, and without."""
    scan = scan_of(40)
    solution = cube[1]
    tangents = solution.state_tangent(np.diag(SPREAD))
    here = (*scan, np.eye(3)[scan[1]])
    at, J = observed(cube, here, solution.state)[0], observed(cube, here, tangents)
    sigma = np.full(len(at), 0.01 * np.sqrt((at**2).mean()))
    motion = motion_of(scan, cube, root=np.diag(STD))
    shared = motion.errors(observed(cube, motion.observed, solution.state)[0])
    rng, inside = np.random.default_rng(0), {"with": [], "without": []}
    for _ in range(60):
        x, error = rng.standard_normal(3), STD * rng.standard_normal(6)
        truth = observed(cube, misplaced(scan, cube, error, motion.centre), solution.state + x @ tangents)[0]
        residual = (truth + sigma * rng.standard_normal(len(at)) - at) / sigma
        for name, one in (("with", shared), ("without", None)):
            noise = Noise(sigma, shared=one)
            A = noise.whitened(J / sigma)
            covariance = np.linalg.inv(np.eye(3) + A @ A.T)
            gap = covariance @ A @ noise.whitened(residual) - x
            inside[name].append(np.abs(gap) < 1.96 * np.sqrt(np.diag(covariance)))
    share = {name: float(np.mean(found)) for name, found in inside.items()}
    assert 0.90 <= share["with"] <= 0.98, share
    assert share["without"] < 0.75, share


def test_errors_that_are_shared_are_a_covariance():
    rng = np.random.default_rng(0)
    shared, sigma, r = rng.normal(size=(3, 7)), rng.uniform(0.5, 2, size=7), rng.normal(size=7)
    noise = Noise(sigma, shared=shared)
    covariance = np.diag(sigma**2) + shared.T @ shared
    white = noise.whitened(r / sigma)
    assert white @ white == pytest.approx(r @ np.linalg.solve(covariance, r))
    log = 0.5 * np.linalg.slogdet(covariance)[1] - np.log(sigma).sum()
    assert noise.log_determinant == pytest.approx(log)
    np.testing.assert_allclose(noise.coloured(noise.whitened(r)), r)
    wider = Noise(sigma, StudentErrors().dof, shared=shared)
    np.testing.assert_allclose(wider.scale**2, np.diag(covariance))
    # What data say about a motion, given unknowns of unit prior: dense linear algebra.
    J = rng.normal(size=(7, 2))
    A = noise.whitened((J / sigma[:, None]).T)
    values, turn = np.linalg.eigh(A @ A.T)
    spectrum = Spectrum(values[::-1], turn[:, ::-1].T, turn[:, ::-1].T @ A, 0.0, 0)
    found = determined(spectrum, noise, np.ones(7))
    together = np.diag(sigma**2) + J @ J.T
    np.testing.assert_allclose(found, np.linalg.eigvalsh(shared @ np.linalg.solve(together, shared.T))[::-1])
