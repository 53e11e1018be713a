"""Bodies that turn: surfaces of meshes, what is on them, and how they travel in the page."""

import base64
import json
import zlib
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from tests.workflows.report.test_report import CUBE, HEXAHEDRON, PNG, solve, study
from workflows.report.bodies import refined, still
from workflows.report.plots.figure import png_of
from workflows.report.scene.scene import Inside, Quantity, Scene, forward_scene, packed
from workflows.report.scene.sliders import Packer, sliders
from workflows.results.surfaces import crossing, level, skin, split, tetrahedra

pyvista = pytest.importorskip("pyvista")


def lattice(kind, degree, cells=(2, 1, 3)):
    """A box of cells of VTK with nodes on a lattice: points, cells."""
    source = pyvista.ImageData(dimensions=np.array(cells) + 1).cast_to_unstructured_grid()
    if kind in (10, 71):
        source = source.triangulate()
    corners = source.cells.reshape(source.n_cells, -1)[:, 1:]
    if kind == 11 or degree == 1:
        order = [0, 1, 3, 2, 4, 5, 7, 6] if 11 in source.celltypes else list(range(corners.shape[1]))
        return np.asarray(source.points, dtype=float), corners[:, order], 12 if corners.shape[1] == 8 else 10
    hexahedral = corners.shape[1] == 8
    if hexahedral and 11 in source.celltypes:
        corners = corners[:, [0, 1, 3, 2, 4, 5, 7, 6]]
    at = np.asarray(source.points, dtype=float)[corners]
    edges = (
        [(0, 1), (1, 2), (3, 2), (0, 3), (4, 5), (5, 6), (7, 6), (4, 7), (0, 4), (1, 5), (3, 7), (2, 6)]
        if hexahedral
        else [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]
    )
    middles = [at[:, list(edge)].mean(axis=1) for edge in edges]
    if hexahedral:
        sides = [(0, 3, 7, 4), (1, 2, 6, 5), (0, 1, 5, 4), (3, 2, 6, 7), (0, 1, 2, 3), (4, 5, 6, 7)]
        middles += [at[:, list(side)].mean(axis=1) for side in sides] + [at.mean(axis=1)]
    every = np.concatenate([at, np.stack(middles, axis=1)], axis=1)
    points, inverse = np.unique(every.reshape(-1, 3).round(9), axis=0, return_inverse=True)
    return points, inverse.reshape(every.shape[:2]), 72 if hexahedral else 71


def volume(points, triangles):
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return np.einsum("ij,ij->", np.cross(a, b), c) / 6


@pytest.mark.parametrize(("kind", "degree"), [(12, 1), (10, 1), (72, 2), (71, 2)])
def test_the_surface_of_a_mesh_is_closed_and_holds_its_volume(kind, degree):
    points, cells, of = lattice(kind, degree)
    found = skin(points, cells, of)
    triangles = found.nodes[found.triangles]
    assert volume(points, triangles) == pytest.approx(6.0)
    ends = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    assert (np.unique(ends, axis=0, return_counts=True)[1] == 2).all()
    # A box has six smooth sides and twelve edges.
    length = np.linalg.norm(points[found.edges[:, 0]] - points[found.edges[:, 1]], axis=1).sum()
    assert length == pytest.approx(4 * (2 + 1 + 3))
    counts = np.bincount(found.nodes)
    assert sorted(np.unique(counts[counts > 0])) in ([1, 2, 3], [2, 3])
    assert (counts == 3).sum() == 8
    assert volume(points, outward(points, tetrahedra(cells, of))) == pytest.approx(6.0)


def outward(points, four):
    return np.concatenate([four[:, list(face)] for face in ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))])


def test_levels_are_where_a_function_is_zero():
    def distance(x):
        return np.linalg.norm(x - [0.5, 0.4, 0.5], axis=1) - 0.3

    points, triangles = level(distance, np.zeros(3), np.ones(3))
    assert np.abs(distance(points)).max() < 2e-3
    assert volume(points, triangles) == pytest.approx(4 / 3 * np.pi * 0.027, rel=0.02)
    assert len(split(points, triangles).nodes) == len(np.unique(triangles))


def unpacked(told, text):
    """What viewer.js does."""
    data, at, found = zlib.decompress(base64.b64decode(text)), 0, []
    for one in told:
        count = one["n"] * one["m"]
        planes = np.frombuffer(data, np.uint8, one["planes"] * count, at).reshape(one["planes"], count)
        at += one["planes"] * count
        z = sum(plane.astype(np.int64) << (8 * k) for k, plane in enumerate(planes))
        differences = (z >> 1) ^ -(z & 1)
        values = np.cumsum(differences.reshape(one["m"], one["n"]), axis=1).T * float(one["step"])
        values[one.get("missing", [])] = np.nan
        found.append(values)
    return found


def test_arrays_travel_to_their_step():
    rng = np.random.default_rng(0)
    arrays = [rng.normal(size=(50, 3)), np.array([[1e-9], [-2e-9]]), np.arange(7)[:, None] ** 5, np.zeros((3, 2))]
    arrays[0][7] = np.nan
    steps = [1e-6, 1e-13, 1.0, 1.0]
    pack = Packer()
    for array, step in zip(arrays, steps, strict=True):
        pack.add(array, step)
    for array, step, found in zip(arrays, steps, unpacked(json.loads(json.dumps(pack.told)), pack.text()), strict=True):
        np.testing.assert_allclose(found, array, rtol=0, atol=0.5001 * step)


def test_a_large_body_stays_small():
    """10⁵ triangles with four quantities and a displacement."""
    u, v = (x.ravel() for x in np.meshgrid(np.linspace(0, 1, 130), np.linspace(0, 1, 130)))
    count = 130
    points = np.concatenate([np.column_stack([u, v, z + 0.05 * np.sin(9 * u * v)]) for z in (0, 0.1, 0.2)])
    layer = (np.arange(count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    base = np.stack([layer, layer + 1, layer + count + 1, layer + count], axis=1)
    cells = np.concatenate([np.hstack([base + k * count**2, base + (k + 1) * count**2]) for k in (0, 1)])
    motion = 0.1 * np.sin(3 * points)
    quantities = [Quantity(str(k), np.cos(k + 4 * points).sum(axis=1), "m") for k in range(4)]
    scene = Scene(points, cells, 12, np.eye(3)[2], motion, quantities)
    told, text = packed(scene)
    assert len(scene.skin.triangles) > 65_000
    assert len(told) + len(text) < 4e6


def test_scenes_hold_what_results_hold():
    dataset = solve(study())
    scene = forward_scene(dataset, study())
    names = [q.name for q in scene.quantities]
    assert names[:2] == ["Mean displacement", "Standard deviation of the displacement"]
    assert [name.split()[-4] for name in names[2:]] == ["loads.gravity.density,", "material.D1,"]
    np.testing.assert_allclose(scene.quantities[0].values, np.linalg.norm(dataset["field_mean"], axis=1))
    told, text = packed(scene)
    read = json.loads(told)
    arrays = unpacked(read["arrays"], text)
    moved = arrays[read["points"]] + arrays[read["motion"]]
    np.testing.assert_allclose(moved, CUBE + dataset["field_mean"].to_numpy(), atol=3e-6)
    assert read["quantities"][0]["high"] == pytest.approx(np.linalg.norm(dataset["field_mean"], axis=1).max())
    assert "<" not in told


def test_regions_are_surfaces_inside():
    points, cells, kind = lattice(12, 1, (3, 3, 3))
    dataset = xr.Dataset(
        {
            "node_position": (("node", "axis"), points),
            "cell_nodes": (("cell", "corner"), cells, {"vtk_cell_type": kind}),
            "field_nominal": (("node", "component"), 0 * points),
            "cell_region": ("cell", (np.arange(27) == 13).astype(int)),
        },
        {"region": ["tissue", "lump"]},
    )
    (inside,) = forward_scene(dataset).insides
    assert inside.name == "region lump"
    assert volume(points, inside.triangles) == pytest.approx(1.0)


def drawn(figure):
    return png_of(figure, figure.dpi)


def test_stills_are_drawn_with_what_is_inside():
    points, cells, kind = lattice(12, 1)
    at, triangles = level(lambda x: np.linalg.norm(x - [1, 0.5, 1.5], axis=1) - 0.3, np.zeros(3), np.array([2, 1, 3]))
    values = points[:, 0].copy()
    values[0] = np.nan
    for quantity in (Quantity("a $ b", values), Quantity("c", np.round(points[:, 1]), names=["x", "y"])):
        for insides in ([], [Inside("ball", triangles, at, "inside")]):
            scene = Scene(points, cells, kind, np.eye(3)[2], 0.1 * points, [quantity], insides)
            assert drawn(still(scene, quantity)).startswith(PNG)


def test_stills_show_the_surface_that_the_viewer_begins_with():
    points, cells, kind = lattice(12, 1)
    grows = Quantity("stiffness", points[:, 0])
    views = [Scene(points, cells, kind, np.eye(3)[2], 0 * points, [grows], cut=cut) for cut in ("", "v")]
    assert len({drawn(still(scene, grows)) for scene in views}) == 2
    at, triangles = crossing(points, points[:, 0] - 1, tetrahedra(cells, kind))
    np.testing.assert_allclose(at[:, 0], 1)
    corners = at[triangles]
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    across = np.prod(np.ptp(points[:, 1:], axis=0))
    assert np.linalg.norm(sides, axis=1).sum() / 2 == pytest.approx(across)


def test_a_refined_mesh_is_drawn_and_what_is_behind_its_worst_cell():
    points, cells, _ = lattice(10, 1)
    dataset = xr.Dataset(
        {
            "mesh_vertex_position": (("vertex", "axis"), points),
            "mesh_cell_vertices": (("mesh_cell", "corner"), cells),
            "mesh_indicator": ("mesh_cell", np.linspace(0, 2 / len(cells), len(cells))),
        }
    )
    whole, cut = (refined(dataset, cut=cut) for cut in (False, True))
    faces = [len(figure.axes[0].collections[-1].get_paths()) for figure in (whole, cut)]
    assert faces[0] == 2 * (2 * 1 + 2 * 3 + 1 * 3)  # triangles of the three sides that are seen
    assert 0 < faces[1] < 4 * len(cells)
    assert drawn(whole) != drawn(cut)


def test_sliders_have_the_distributions_of_parameters():
    case = study(kind="chaos", samples=8)
    dataset = solve(case)
    found = sliders(dataset, case)
    assert found is not None
    told = found.packed(Packer(), np.arange(8))
    density = told["parameters"][0]
    assert (density["low"], density["high"]) == (600, 900)
    assert told["parameters"][1]["low"] < 3e5 - 3 * 2e4
    # The quantiles have the moments of the coordinate.
    assert np.std(density["quantiles"]) == pytest.approx(1, abs=0.01)
    assert sliders(dataset, SimpleNamespace(given=case.given, correlations=[("a", "b", 0.5)])) is None
    assert sliders(solve(study()), study()) is None
    assert len(HEXAHEDRON) == 1
