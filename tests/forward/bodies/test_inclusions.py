"""Inclusions: the factor on the energy, its limits, and its derivatives in every number."""

import numpy as np
import pytest
from mpi4py import MPI
from scipy.spatial.transform import Rotation

from forward.bodies.inclusions import Ellipsoid, Sphere, derived, log_factor
from forward.conformance import EXACT, check_derivatives
from forward.fem.dolfinx import assembly, version
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
    found = check_derivatives(model, point, scale, accuracy=1e-13)
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
    model.equations.set_parameters(changed({"tumour.contrast": contrast, "tumour.radius": 30.0, "gap.contrast": 1.0}))
    model.equations.set_state(plain.state)
    names = model.outputs
    for name in ("energy", "stress"):
        found = model.functionals[names.index(name)].value()
        assert found == pytest.approx(contrast * plain.outputs[names.index(name)], rel=1e-12)


def test_factors_of_inclusions_that_overlap_multiply(model):
    equations = model.equations
    density = assembly.ScalarAssembler(equations.stiffness_factor * equations.dx, equations.comm)
    equations.set_parameters(changed({"tumour.radius": 30.0, "gap.radius": 30.0}))
    assert density() == pytest.approx(8.0 * 0.2 * np.prod(model.spec.body.size), rel=1e-12)


def test_the_factor_follows_its_formula():
    spec = loaded_body(
        "mooney-rivlin", body=BODY, inclusions=(TUMOUR,), outputs=({"kind": "strain-energy", "name": "W"},)
    )
    equations = spec.build(MPI.COMM_SELF, ()).equations
    places = [(0.55, 0.3, 0.45), (0.85, 0.3, 0.45), (0.55, 0.3, 0.6), (1.0, 0.7, 0.8)]
    distances = np.linalg.norm(np.array(places) - [0.55, 0.3, 0.45], axis=1)
    expected = 8.0 ** ((1 - np.tanh((distances - 0.3) / 0.15)) / 2)
    size = np.array(spec.body.size)
    found = []
    for place in places:
        # The 2 × 2 × 2 cells are halves of the box: cells and reference points of the places.
        low = np.minimum(np.floor(np.array(place) / size * 2), 1)
        reference = np.array(place) / size * 2 - low
        values = assembly.PointValues(equations.stiffness_factor, reference[None], equations.space, equations.comm)
        centres = equations.mesh.geometry.x[version.corners_of_cells(equations.mesh)].mean(axis=1)
        cell = np.argmin(np.abs(centres - (low + 0.5) * size / 2).sum(axis=1))
        found.append(float(values()[cell, 0]))
    np.testing.assert_allclose(found, expected, rtol=1e-6)  # what is tiny at the centre


@pytest.mark.parametrize("material", MATERIALS)
def test_without_inclusions_forms_stay_the_same(material):
    equations = loaded_body(material).build(MPI.COMM_SELF, ()).equations
    assert equations.stiffness_factor == 1
    assert "tanh" not in str(equations.stored_energy)


# --- ellipsoids ------------------------------------------------------------------------------------------------------

TURNED = {
    "kind": "ellipsoid",
    "name": "tumour",
    "x": 0.55,
    "y": 0.3,
    "z": 0.45,
    "a": 0.4,
    "b": 0.3,
    "c": 0.2,
    "turn_x": 0.3,
    "turn_y": -0.2,
    "turn_z": 0.5,
    "contrast": 8.0,
    "width": 0.15,
}
PLACES = np.random.default_rng(0).uniform(0, 0.8, (400, 3))


def factor(inclusion, places):
    spec = Ellipsoid.model_validate(inclusion) if inclusion.get("kind") == "ellipsoid" else Sphere(**inclusion)
    return np.exp(log_factor([spec], (), np.zeros((1, 0)), places)[0])


def test_derivatives_in_every_number_of_an_ellipsoid():
    numbers = [name for name in TURNED if name not in {"kind", "name"}]
    paths = tuple(f"inclusions.tumour.{number}" for number in numbers)
    outputs = ({"kind": "mean-displacement", "name": "mean", "on": "x-max", "component": "y"},)
    spec = loaded_body("neo-hookean-coupled", body=BODY, inclusions=(TURNED,), outputs=outputs)
    point = np.array([TURNED[number] for number in numbers])
    scale = np.where(np.char.startswith(numbers, "turn"), 0.3, 0.1 * np.abs(point))
    model = spec.build(MPI.COMM_SELF, paths)
    for at in (point, np.where(np.char.startswith(numbers, "turn"), 0.0, point)):  # also where nothing is turned
        found = check_derivatives(model, at, scale, steps=(1 / 32, 1 / 64, 1 / 128), accuracy=1e-13)
        assert found.mistakes() == ()
        assert found.adjoint.max() <= EXACT


def test_an_ellipsoid_of_equal_radii_is_a_sphere():
    ball = TURNED | {"a": 0.3, "b": 0.3, "c": 0.3}
    np.testing.assert_allclose(factor(ball, PLACES), factor(TUMOUR, PLACES), rtol=1e-12)


def test_an_ellipsoid_is_turned_as_its_rotation_vector_says():
    rotation = Rotation.from_rotvec([TURNED[f"turn_{axis}"] for axis in "xyz"])
    centre = np.array([TURNED[axis] for axis in "xyz"])
    straight = TURNED | dict.fromkeys(("turn_x", "turn_y", "turn_z"), 0.0)
    np.testing.assert_allclose(factor(TURNED, centre + rotation.apply(PLACES)), factor(straight, centre + PLACES))
    # On the surface the indicator is ½, and its slope is that of a transition of the given width.
    directions = PLACES / np.linalg.norm(PLACES, axis=1)[:, None]
    normal = directions / [0.4, 0.3, 0.2]
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    surface = centre + rotation.apply(directions * [0.4, 0.3, 0.2])
    s = np.log(factor(TURNED, surface)) / np.log(8)
    np.testing.assert_allclose(s, 0.5, atol=1e-9)
    h = 1e-6
    slope = (np.log(factor(TURNED, surface + h * rotation.apply(normal))) / np.log(8) - s) / h
    np.testing.assert_allclose(slope, -0.5 / 0.15, rtol=0.05)


def test_what_follows_from_the_numbers():
    bodies = (Ellipsoid.model_validate(TURNED), Sphere(**GAP))
    points = np.array([[0.5, 2.0], [0.1, 4.0]])
    names, places = ("inclusions.tumour.b", "inclusions.gap.contrast"), np.array([[0.55, 0.3, 0.45]])
    found = derived(bodies, names, points)
    np.testing.assert_allclose(found["inclusions.tumour.volume"], 4 / 3 * np.pi * 0.4 * 0.2 * points[:, 0])
    np.testing.assert_allclose(found["inclusions.gap.volume"], 4 / 3 * np.pi * 0.2**3)
    expected = [factor(TURNED | {"b": b}, places) * factor(GAP | {"contrast": k}, places) for b, k in points]
    np.testing.assert_allclose(np.exp(log_factor(bodies, names, points, places)), expected)
