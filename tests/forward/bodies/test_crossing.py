"""Bodies that pass through themselves: bent to a ring whose ends meet, and lips of a cut that are pressed."""

import meshio
import numpy as np
import pytest
from mpi4py import MPI

from forward.bodies.crossing import deepest, least_stretch
from forward.bodies.mesh import CORNERS, TETRAHEDRA, surface_of
from forward.hyperelastic import Hyperelastic
from tests.forward.bodies.test_slits import CELLS, NAMES, block
from uq.evaluation.evaluate import Recorder, SerialEvaluate
from uq.inputs.distributions import Uniform
from uq.inputs.random_parameters import Inputs
from uq.surrogates.linearisation import linearise
from workflows.studies.solves import crossings


def ring(turn, cell):
    """A beam of 40 × 3 × 3 cells that is bent by an angle, and where it was."""
    ends = 40, 3, 3
    points = np.stack(np.meshgrid(*[np.arange(n + 1.0) for n in ends], indexing="ij"), axis=-1).reshape(-1, 3)
    numbers = np.arange(len(points)).reshape([n + 1 for n in ends])
    corners = [numbers[tuple(slice(a, n + a) for a, n in zip(at, ends, strict=True))].ravel() for at in CORNERS]
    cells = np.column_stack(corners)
    if cell == "tetrahedron":
        cells = cells[:, TETRAHEDRA["hexahedron"]].reshape(-1, 4)
    radius = ends[0] / turn
    angle, far = points[:, 0] / radius, radius + 1.5 - points[:, 1]
    return points, np.column_stack([far * np.sin(angle), radius - far * np.cos(angle), points[:, 2]]), cells


@pytest.mark.parametrize("cell", ["hexahedron", "tetrahedron"])
def test_ends_that_meet_are_seen(cell):
    points, bent, cells = ring(6.0, cell)
    faces, _ = surface_of(cells, cell)
    assert deepest(points, cells, cell, faces) is None
    assert deepest(bent, cells, cell, faces) is None  # 0.28 of an angle is left between the ends
    _, bent, cells = ring(6.5, cell)
    found = deepest(bent, cells, cell, faces)
    assert found is not None
    assert points[found[0], 0] in {0.0, 40.0}  # of an end
    # The ends overlap by 6.5 − 2π of an angle; the outer surface of a corner is nearer than the end in front of it.
    assert 0.1 < found[1] < (6.5 - 2 * np.pi) * (40 / 6.5 + 1.5) * 1.05


@pytest.mark.unit
@pytest.mark.parametrize("stretch", [0.6, 0.7, 1.5])
def test_the_least_stretch_of_a_free_surface(stretch):
    """Of a block between plates: its sides are as short as it is, the plates only grow in their planes."""
    points, _, cells = ring(1.0, "hexahedron")
    across = stretch**-0.5
    faces, _ = surface_of(cells, "hexahedron")
    vertex, least = least_stretch(points, points * [stretch, across, across], faces)
    assert least == pytest.approx(min(stretch, across))
    assert (points[vertex, 1:] % 3 == 0).any()  # on a side
    assert least_stretch(points, points * [stretch, 1.0, 1.0], faces)[1] == 1.0  # all sides are held in their planes
    turned = points @ [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    assert least_stretch(points, turned, faces)[1] == pytest.approx(1.0)


@pytest.mark.fem
def test_lips_that_are_pressed_are_seen(tmp_path):
    """By 3.3 mm in the middle of the cut, as without contact both lips move on."""
    meshio.write(tmp_path / "cut.vtu", block())
    spec = Hyperelastic.model_validate(
        {
            "formulation": "displacement",
            "body": {"kind": "mesh", "file": str(tmp_path / "cut.vtu"), "names": NAMES, "degree": 1},
            "material": {"kind": "mooney-rivlin", "C1": 1000, "C2": 500, "D1": 4000},
            "clamp": ["held"],
            "loads": [{"kind": "traction", "on": "pulled", "direction": [1, 0, 0], "size": 36}],
            "outputs": [{"name": "lift", "kind": "mean-displacement", "on": "pulled", "component": "x"}],
        }
    )
    inputs = Inputs({"loads.traction.size": Uniform(lower=-37, upper=-35)})
    model = spec.build(MPI.COMM_SELF, inputs.names)
    at_mean, at_six = Recorder(SerialEvaluate(model)), Recorder(SerialEvaluate(model))
    linearise(inputs, at_mean)
    first = at_mean.first
    nodes, (cells, _) = model.space.coordinates, model.space.cells()
    assert len(cells) == np.prod(CELLS)
    (said,) = crossings(first, inputs.mean[None], nodes, cells, "hexahedron")
    assert said.code == "passes-through-itself"
    assert "At the mean" in said.text
    assert "3.3 mm" in said.text
    linearise(inputs, at_six, np.array([6.0]))
    pulled = at_six.first
    assert not list(crossings(pulled, np.array([[6.0], [30.0]]), nodes, cells, "hexahedron"))
    (said,) = crossings(pulled, np.array([[6.0], [-36.0]]), nodes, cells, "hexahedron")
    assert "predicted to be largest" in said.text
