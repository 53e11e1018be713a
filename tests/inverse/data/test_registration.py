"""Rigid registration: found again, as uncertain as it says, and one line for what cannot be one."""

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from forward.bodies.geometry import Box
from forward.bodies.surface import Surface
from inverse.data.registration import Given, Landmarks, Rigid, ToSurface, crosses, slopes, turned
from inverse.data.table import DataError

SIZE = np.array([0.05, 0.04, 0.03])
BOX = Surface.of(Box(size=tuple(SIZE), cells=(2, 2, 2)))
TRUE = Rigid(turned((2.0, -1.0, 5.0)), np.array([0.01, -0.004, 0.002]))


def on_box(count, seed=0):
    """Points on the faces of the box."""
    rng = np.random.default_rng(seed)
    points, axis = rng.uniform(size=(count, 3)), rng.integers(3, size=count)
    points[np.arange(count), axis] = rng.integers(2, size=count)
    return points * SIZE


def back(points):
    """Where a scanner sees points of the body: the inverse of the true motion."""
    return (points - TRUE.shift) @ TRUE.rotation


def gap(found):
    """The motion (ω, τ) (6,) from a registration to the truth, about its centre."""
    more = TRUE.rotation @ found.motion.rotation.T
    turn = Rotation.from_matrix(more).as_rotvec()
    origin = found.motion.rotation.T @ (found.centre - found.motion.shift)
    return np.concatenate([turn, TRUE(origin[None])[0] - found.centre])


@pytest.mark.unit
def test_rotations_are_those_of_scipy():
    angles = (20.0, -35.0, 110.0)
    np.testing.assert_allclose(turned(angles), Rotation.from_euler("xyz", angles, degrees=True).as_matrix(), atol=1e-15)
    np.testing.assert_allclose(Rigid(turned(angles)).angles, angles)
    u, v = np.random.default_rng(0).normal(size=(2, 3))
    np.testing.assert_allclose(crosses(u[None])[0] @ v, np.cross(u, v))


@pytest.mark.unit
def test_slopes_are_those_of_differences():
    points, centre, h = on_box(4), np.array([0.01, 0.02, 0.0]), 1e-7
    J = slopes(points, centre)
    for k in range(6):
        moved = Rigid().moved(h * np.eye(6)[k], centre)(points)
        np.testing.assert_allclose((moved - points) / h, J[:, :, k], atol=1e-8)


@pytest.mark.unit
def test_known_motions():
    """Angles and shift, or a matrix, in the unit of the file."""
    points = back(on_box(20))
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = TRUE.rotation, 1e3 * TRUE.shift
    for how in (
        Given(rotation=(2.0, -1.0, 5.0), translation=(10.0, -4.0, 2.0)),
        Given(matrix=tuple(map(tuple, whole.tolist()))),
        Given(matrix=tuple(map(tuple, whole[:3].tolist()))),
    ):
        found = how.registered(points, 1e-3, None, 0.05, "scan")
        np.testing.assert_allclose(found.motion(points), on_box(20), atol=1e-12)
        assert not found.uncertain
    found = Given(rotation_std=1.0, translation_std=0.5).registered(points, 1e-3, None, 0.05, "scan")
    assert found.uncertain
    np.testing.assert_allclose(found.std, [np.radians(1.0)] * 3 + [5e-4] * 3)


def test_landmarks_are_those_of_scipy():
    """Weighted, and with the deviations of many repetitions."""
    rng = np.random.default_rng(3)
    there, sigma = on_box(6), 1e-4 * np.array([1.0, 2, 1, 3, 1, 1])
    gaps = []
    for _ in range(400):
        seen = back(there) + sigma[:, None] * rng.normal(size=(6, 3))
        how = Landmarks(
            points=tuple(map(tuple, 1e3 * seen)), onto=tuple(map(tuple, 1e3 * there)), sigma=tuple(1e3 * sigma)
        )
        found = how.registered(seen, 1e-3, None, 0.05, "scan")
        gaps.append(gap(found))
    w = sigma**-2 / (sigma**-2).sum()
    expected = Rotation.align_vectors(there - w @ there, seen - w @ seen, weights=w)[0]
    np.testing.assert_allclose(found.motion.rotation, expected.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(np.std(gaps, axis=0), found.std, rtol=0.15)
    squares = [one @ np.linalg.solve(found.root.T @ found.root, one) for one in gaps]
    assert np.mean(squares) == pytest.approx(6, rel=0.15)


@pytest.mark.slow
def test_points_find_the_surface():
    """From 5° and 10 mm away, also among points of something else, and as uncertain as it says."""
    exact = ToSurface().registered(back(on_box(200)), 1.0, BOX, 0.05, "scan")
    assert np.abs(gap(exact)).max() < 1e-8
    assert exact.unseen == ()
    rng, squares, noise = np.random.default_rng(4), [], 1e-4
    for trial in range(12):
        seen = back(on_box(150, trial) + noise * rng.normal(size=(150, 3)))
        seen[:5] += rng.uniform(-0.02, 0.02, size=(5, 3))
        found = ToSurface(uncertain=True).registered(seen, 1.0, BOX, 0.05, "scan")
        assert found.uncertain
        squares.append(gap(found) @ np.linalg.solve(found.root.T @ found.root, gap(found)))
    assert 3 < np.mean(squares) < 9, np.mean(squares)


def test_motions_that_cannot_be_found():
    """The rotation of a ball, the shift along a face: left as at the start, and named."""
    from scipy.spatial import ConvexHull

    corners = np.random.default_rng(0).normal(size=(4000, 3))
    corners *= 0.02 / np.linalg.norm(corners, axis=1, keepdims=True)
    ball = Surface(corners[ConvexHull(corners).simplices])
    points = 0.02 * np.random.default_rng(1).normal(size=(300, 3))
    points *= 0.02 / np.linalg.norm(points, axis=1, keepdims=True)
    found = ToSurface(uncertain=True).registered(points + np.array([0.001, 0, 0]), 1.0, ball, 0.04, "scan")
    np.testing.assert_allclose(found.motion.shift, [-0.001, 0, 0], atol=3e-5)
    assert len(found.unseen) >= 1
    assert all("rotation" in one for one in found.unseen)
    assert found.std[:3].min() > 0.1
    face = on_box(300)
    face = face[face[:, 2] == SIZE[2]] + np.array([0, 0, 0.002])
    found = ToSurface().registered(face, 1.0, BOX, 0.05, "scan")
    assert found.motion.shift[2] == pytest.approx(-0.002, abs=1e-6)
    assert set(found.unseen) == {"shift along x", "shift along y", "rotation about z"}


MATRIX = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
THREE = tuple(row[:3] for row in MATRIX)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("how", "settings", "told"),
    [
        (Given, {"matrix": ((-1.0, 0, 0, 0), *MATRIX[1:])}, "the matrix mirrors (determinant −1)"),
        (Given, {"matrix": ((1.1, 0, 0, 0), *MATRIX[1:])}, "not rigid: RᵀR differs from I by 0.21 (determinant 1.1)"),
        (Given, {"matrix": ((1.0, 0.1, 0, 0), *MATRIX[1:])}, "not rigid"),
        (Given, {"matrix": MATRIX[:2]}, "expected three rows of four numbers"),
        (Given, {"matrix": (*MATRIX, (0.0, 0, 1.0, 1.0))}, "of which the last is 0, 0, 0, 1"),
        (Given, {"matrix": MATRIX, "rotation": (0.0, 0, 5.0)}, "either matrix, or rotation and translation"),
        (ToSurface, {"matrix": ((-1.0, 0, 0, 0), *MATRIX[1:])}, "the matrix mirrors"),
        (Landmarks, {"points": ((0.0, 0, 0),) * 3, "onto": ((0.0, 0, 0),) * 4}, "3 points onto 4 places"),
        (Landmarks, {"points": ((0.0, 0, 0),) * 2, "onto": ((0.0, 0, 0),) * 2}, "at least 3 items"),
        (
            Landmarks,
            {"points": THREE, "onto": THREE, "uncertain": True},
            "three landmarks do not say how uncertain they are",
        ),
    ],
)
def test_no_rigid_motions(how, settings, told):
    with pytest.raises(ValidationError) as caught:
        how(**settings)
    assert told in str(caught.value)


@pytest.mark.unit
def test_what_cannot_be_registered():
    there = on_box(6)

    def told(seen, onto=there):
        how = Landmarks(points=tuple(map(tuple, seen)), onto=tuple(map(tuple, onto)))
        with pytest.raises(DataError) as caught:
            how.registered(seen, 1.0, None, 0.05, "scan")
        assert len(caught.value.args) == 1
        return str(caught.value)

    assert "the landmarks fit a mirror image" in told(back(there) * [-1, 1, 1])
    assert "the landmarks lie on one line" in told(np.outer(np.arange(3.0), [1, 2, 3]), there[:3])
    assert "in the same order, and in the unit of the file?" in told(1e3 * back(there))
    with pytest.raises(DataError, match="scan: registration: 5 points, expected at least 6 to fit them to a surface"):
        ToSurface().registered(there[:5], 1.0, BOX, 0.05, "scan")
