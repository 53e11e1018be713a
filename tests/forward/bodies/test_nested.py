"""Meshes within that of a body: they contain its vertices, and fields that are linear between these are the same."""

import numpy as np
import pytest

from forward.bodies.geometry import Block, Box
from forward.bodies.location import locate, shapes
from forward.bodies.mesh import faces_of
from forward.bodies.tetrahedra import RATIO, layers_of, within
from forward.model import ModelError

CORNERS = tuple((2 * x + 0.3 * z * y, y, z + 0.2 * x) for z in (0.0, 1.0) for y in (0.0, 1.0) for x in (0.0, 1.0))
BODIES = {
    "box": Box(size=(2.0, 1.0, 1.0), cells=(3, 2, 2), cell="hexahedron"),
    "graded": Box(size=(2.0, 1.0, 1.0), cells=(3, 2, 2), cell="hexahedron", grading={"z-min": 3.0}),
    "block": Block(corners=CORNERS, cells=(3, 2, 2), cell="hexahedron"),
}
X_FIRST = {8: [0, 1, 3, 2, 4, 5, 7, 6], 4: [0, 1, 2, 3]}  # of cells in VTK's order, as `locate` has them


def own(body):
    """The mesh of a body: that which is not divided."""
    return within(body, 1, (), (0, 0, 0)).load()


def interpolated(mesh, values, places):
    cells = mesh.cells[:, X_FIRST[mesh.cells.shape[1]]]
    found = locate(mesh.points[cells], places)
    assert found.distances.max() < 1e-9
    return (shapes(found.local, cells.shape[1]) * values[cells[found.cells]]).sum(axis=1)


@pytest.mark.parametrize("cell", ["hexahedron", "tetrahedron"])
@pytest.mark.parametrize("name", BODIES)
def test_fields_between_vertices_are_the_same(name, cell):
    body = BODIES[name].model_copy(update={"cell": cell})
    coarse, body_within = own(body), within(body, 2, ("z-min",), (1, 1, 2))
    fine = body_within.load()
    rng = np.random.default_rng(0)
    values = rng.standard_normal(len(coarse.points))
    there = interpolated(coarse, values, fine.points)
    shares = rng.dirichlet(np.ones(fine.cells.shape[1]), len(fine.cells))  # a place in each cell
    places = np.einsum("ck,cka->ca", shares, fine.points[fine.cells])
    np.testing.assert_allclose(interpolated(fine, there, places), interpolated(coarse, values, places), atol=1e-8)
    gaps = np.linalg.norm(coarse.points[:, None] - fine.points, axis=2).min(axis=1)
    assert gaps.max() < 1e-12
    if name == "box" or cell == "hexahedron":
        unique, count = np.unique(np.sort(faces_of(fine.cells, cell), axis=1), axis=0, return_counts=True)
        assert count.max() == 2  # conforming
        outer = {tuple(face) for face in unique[count == 1].tolist()}
        named = [tuple(sorted(facet)) for facets in fine.boundaries.values() for facet in facets.tolist()]
        assert len(named) == len(outer)
        assert set(named) == outer
    assert (body_within.degree, body_within.cell) == (body.degree, cell)
    if name == "box":
        assert body_within.contents.areas == pytest.approx(
            {"x-min": 1.0, "x-max": 1.0, "y-min": 2.0, "y-max": 2.0, "z-min": 2.0, "z-max": 2.0}
        )
        assert sum(body_within.contents.regions.values()) == pytest.approx(2.0)


def test_cells_are_thinner_at_the_rims_of_what_is_held():
    """On both sides of a rim, by layers of the same ratio; nowhere else."""
    points = within(BODIES["box"], 2, ("z-min",), (1, 2, 2)).load().points
    x, y, z = (np.diff(np.unique(points[:, axis].round(12))) for axis in range(3))
    assert z[0] == pytest.approx(RATIO**2 / 4)
    assert z[-1] == pytest.approx(1 / 4)
    assert y[0] == pytest.approx(y[-1]) == pytest.approx(RATIO**2 / 4)
    assert x[0] == pytest.approx(RATIO * 2 / 6)
    assert x.max() == pytest.approx(2 / 6)
    mesh = within(BODIES["box"].model_copy(update={"cell": "tetrahedron"}), 1, ("z-min",), (2, 2, 2)).load()
    at = mesh.points[mesh.cells]
    sizes = np.linalg.norm(at - at.mean(axis=1, keepdims=True), axis=2).max(axis=1)
    rim = (np.isclose(at[..., 2], 0) & (np.isclose(at[..., 1], 0) | np.isclose(at[..., 0], 0))).any(axis=1)
    assert sizes[rim].max() < sizes.max() / 2.5
    # Where nothing is held, cells are divided and no more.
    plain = within(BODIES["box"], 2, (), (2, 2, 2))
    assert plain.cell_count == 8 * BODIES["box"].cell_count


@pytest.mark.unit
def test_layers_make_first_cells_as_thin_as_they_are_to_be():
    body = BODIES["box"].model_copy(update={"cells": (4, 12, 40)})
    layers = layers_of(body, 2)
    assert layers == (2, 1, 0)
    first = [RATIO**extra / (2 * n) for extra, n in zip(layers, body.cells, strict=True)]
    assert max(first) <= 1 / 32


@pytest.mark.unit
def test_meshes_that_are_too_large_are_not_made():
    large = BODIES["box"].model_copy(update={"cells": (150, 150, 150)})
    with pytest.raises(ModelError, match="unknowns, expected"):
        within(large, 2, (), (0, 0, 0))
