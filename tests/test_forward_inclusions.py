"""Inclusions: the factor on the energy, its limits, and its derivatives in every number."""

import numpy as np
import pytest
from mpi4py import MPI

from forward import fenicsx
from forward.conformance import EXACT, check_derivatives
from tests.bodies import MATERIALS, loaded_body

pytestmark = pytest.mark.fem
NUMBERS = ("x", "y", "z", "radius", "contrast", "width")
TUMOUR = {"name": "tumour", "x": 0.55, "y": 0.3, "z": 0.45, "radius": 0.3, "contrast": 8.0, "width": 0.15}
GAP = {"name": "gap", "x": 0.8, "y": 0.5, "z": 0.3, "radius": 0.2, "contrast": 0.2, "width": 0.2}
BODY = {"cells": (2, 2, 2)}
PATHS = tuple(f"inclusions.{name}.{number}" for name in ("tumour", "gap") for number in NUMBERS)
VALUES = np.array([inclusion[number] for inclusion in (TUMOUR, GAP) for number in NUMBERS])


@pytest.fixture(scope="module")
def model():
    spec = loaded_body("mooney-rivlin", body=BODY, inclusions=(TUMOUR, GAP))
    return spec.build(MPI.COMM_SELF, ("material.C1", *PATHS))


@pytest.fixture(scope="module")
def homogeneous():
    return loaded_body("mooney-rivlin", body=BODY).build(MPI.COMM_SELF, ("material.C1",))


def changed(changes):
    """The parameters with some numbers of the inclusions changed: {"tumour.contrast": 1.0}."""
    values = dict(zip(PATHS, VALUES, strict=True)) | {f"inclusions.{name}": value for name, value in changes.items()}
    return np.array([1e4, *values.values()])


def test_derivatives_in_every_number(model):
    point = np.array([1e4, *VALUES])
    scale = np.where([path.endswith(".contrast") for path in model.parameters], 0.3, 0.1) * point
    found = check_derivatives(model, point, scale, noise=1e-13)
    assert found.mistakes() == ()
    assert found.adjoint.max() <= EXACT
    assert found.directions[:-1] == tuple(f"'{path}'" for path in ("material.C1", *PATHS))


def test_without_contrast_the_body_is_homogeneous(model, homogeneous):
    plain = homogeneous.solve(np.array([1e4]))
    found = model.solve(changed({"tumour.contrast": 1.0, "gap.contrast": 1.0}))
    np.testing.assert_allclose(found.state, plain.state, rtol=0, atol=1e-13)
    np.testing.assert_allclose(found.outputs, plain.outputs, rtol=1e-11)


@pytest.mark.parametrize("contrast", [1e-4, 0.5, 1e4])
def test_an_inclusion_that_covers_the_body_multiplies_its_energy(model, homogeneous, contrast):
    plain = homogeneous.solve(np.array([1e4]))
    model.body.set_parameters(changed({"tumour.contrast": contrast, "tumour.radius": 30.0, "gap.contrast": 1.0}))
    model.body.set_state(plain.state)
    names = model.outputs
    for name in ("energy", "stress"):
        found = model._functionals[names.index(name)].value()
        assert found == pytest.approx(contrast * plain.outputs[names.index(name)], rel=1e-12)


def test_factors_of_inclusions_that_overlap_multiply(model):
    body = model.body
    density = fenicsx.ScalarAssembler(body.stiffness_factor * body.dx, body.comm)
    body.set_parameters(changed({"tumour.radius": 30.0, "gap.radius": 30.0}))
    assert density() == pytest.approx(8.0 * 0.2 * np.prod(model.spec.body.size), rel=1e-12)


def test_the_factor_follows_its_formula():
    spec = loaded_body(
        "mooney-rivlin", body=BODY, inclusions=(TUMOUR,), outputs=({"kind": "strain-energy", "name": "W"},)
    )
    body = spec.build(MPI.COMM_SELF, ()).body
    places = [(0.55, 0.3, 0.45), (0.85, 0.3, 0.45), (0.55, 0.3, 0.6), (1.0, 0.7, 0.8)]
    distances = np.linalg.norm(np.array(places) - [0.55, 0.3, 0.45], axis=1)
    expected = 8.0 ** ((1 - np.tanh((distances - 0.3) / 0.15)) / 2)
    size = np.array(spec.body.size)
    found = []
    for place in places:
        # The 2 × 2 × 2 cells are halves of the box: cells and reference points of the places.
        low = np.minimum(np.floor(np.array(place) / size * 2), 1)
        reference = np.array(place) / size * 2 - low
        values = fenicsx.PointValues(body.stiffness_factor, reference[None], body.space, body.comm)
        centres = body.mesh.geometry.x[body.mesh.geometry.dofmap.array.reshape(-1, 8)].mean(axis=1)
        cell = np.argmin(np.abs(centres - (low + 0.5) * size / 2).sum(axis=1))
        found.append(float(values()[cell, 0]))
    np.testing.assert_allclose(found, expected, rtol=1e-6)  # what is tiny at the centre


@pytest.mark.parametrize("material", MATERIALS)
def test_without_inclusions_forms_stay_the_same(material):
    body = loaded_body(material).build(MPI.COMM_SELF, ()).body
    assert body.stiffness_factor == 1
    assert "tanh" not in str(body.stored_energy)
