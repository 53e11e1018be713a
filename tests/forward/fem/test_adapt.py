"""Meshes that are refined until they make small errors."""

from dataclasses import replace

import meshio
import numpy as np
import pytest
from mpi4py import MPI
from pydantic import ValidationError

from forward.bodies.tetrahedra import tetrahedra
from forward.fem.adapt import BULK, Cycle, adapt, largest, recovery, saturation
from forward.fem.model import HyperelasticModel
from forward.hyperelastic import Hyperelastic
from forward.model import ModelError
from tests.launch import UP_TO_RANKS, on_kept_ranks
from tests.meshes import box, corner

pytestmark = pytest.mark.fem
NOTHING = np.zeros(0)
# Outputs of the bracket, extrapolated from meshes of 25 000 to 36 000 unknowns, of degree 2, which stress jumps and the
# output `near` have refined: both agree to 2e-4.
EXACT = {"near": -0.05121, "end": -0.15823}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("adapt") / "corner.msh"
    meshio.write(path, corner(), file_format="gmsh22", binary=False)
    return str(path)


def bent(body, **settings):
    """A bracket that hangs from its top, pulled down at its right end."""
    return Hyperelastic.model_validate(
        {
            "formulation": "displacement",
            "body": {"degree": 1} | body,
            "material": {"kind": "neo-hookean-coupled", "mu": 2e4, "lmbda": 4e4},
            "clamp": ("top",) if body.get("kind") == "mesh" else ("y-max",),
            "loads": (
                {
                    "kind": "traction",
                    "on": "right" if body.get("kind") == "mesh" else "x-max",
                    "direction": (0.0, -1.0, 0.0),
                    "size": 400.0,
                },
            ),
            "outputs": (
                {"kind": "displacement", "name": "near", "at": (0.55, 0.45, 0.125), "component": "y"},
                {"kind": "mean-displacement", "name": "end", "on": "right", "component": "y"}
                if body.get("kind") == "mesh"
                else {"kind": "mean-displacement", "name": "end", "on": "x-max", "component": "y"},
                {"kind": "max-von-mises", "name": "stress"},
            ),
            "adapt": {"tolerance": 0.05} | settings,
        }
    )


@pytest.mark.slow
@pytest.mark.parametrize("indicator", ["dual-weighted", "recovery"])
@pytest.mark.parametrize("degree", [1, 2])
def test_the_errors_that_are_left_are_those_that_are_said(file, indicator, degree):
    body = {"kind": "mesh", "file": file, "degree": degree}
    spec = bent(body, tolerance=0.05 if degree == 1 else 0.019, outputs=("near",), indicator=indicator)
    found = adapt(spec, MPI.COMM_SELF, (), NOTHING)
    assert found.stopped is None
    last, right = found.cycles[-1], EXACT["near"] - found.cycles[-1].values[0]
    assert last.errors[0] / right == pytest.approx(1, abs=0.3)
    assert last.relative[0] <= spec.adapt.tolerance
    assert last.errors[1] / (EXACT["end"] - last.values[1]) == pytest.approx(1, abs=0.3)
    assert np.isnan(last.errors[2])
    assert found.indicators.sum() == pytest.approx(1)
    assert len(found.indicators) == last.cells == found.contents.cells


def test_cells_are_refined_at_the_corner_and_named_boundaries_stay(file):
    spec = bent({"kind": "mesh", "file": file}, tolerance=0.19, outputs=("near",))
    lines = []
    found = adapt(spec, MPI.COMM_SELF, (), NOTHING, lines.append)
    assert found.stopped is None
    mesh, last = found.mesh, found.cycles[-1]
    assert len(lines) == len(found.cycles) >= 3
    assert lines[-1].startswith(f"mesh of {last.unknowns:,} unknowns: estimated errors near ")
    unknowns = [cycle.unknowns for cycle in found.cycles]
    assert unknowns == sorted(unknowns)
    assert found.contents.areas == pytest.approx(spec.body.contents.areas)
    assert found.contents.regions == pytest.approx(spec.body.contents.regions)
    at = mesh.points[mesh.cells].mean(axis=1)
    size = np.abs(np.linalg.det(mesh.points[mesh.cells][:, 1:] - mesh.points[mesh.cells][:, :1]))
    near = np.linalg.norm(at[:, :2] - 0.5, axis=1) < 0.2
    assert np.median(size[near]) < 0.5 * np.median(size[~near])


def test_a_mesh_that_is_good_enough_stays(file):
    spec = bent({"kind": "mesh", "file": file}, tolerance=0.9)
    found = adapt(spec, MPI.COMM_SELF, (), NOTHING)
    assert len(found.cycles) == 1
    assert found.contents.cells == spec.body.cell_count
    assert found.cycles[0].factors == (1.0, 1.0, 1.0)


def test_a_mesh_that_may_not_grow_says_so(file):
    found = adapt(bent({"kind": "mesh", "file": file}, tolerance=1e-4, unknowns=100), MPI.COMM_SELF, (), NOTHING)
    assert found.stopped.startswith("the next mesh would have")
    assert found.stopped.endswith("unknowns = 100")
    assert found.cycles[-1].unknowns <= 100
    found = adapt(bent({"kind": "mesh", "file": file}, tolerance=1e-4, cycles=1), MPI.COMM_SELF, (), NOTHING)
    assert found.stopped == "cycles = 1"
    assert len(found.cycles) == 2


def test_refined_boxes_begin_as_they_are_meshed_without():
    box_of = {"size": (1.0, 0.7, 0.25), "cells": (2, 1, 1), "cell": "tetrahedron", "grading": {"y-max": 4.0}}
    spec = bent(box_of, tolerance=0.9)
    plain = spec.model_copy(update={"adapt": None})
    found = adapt(spec, MPI.COMM_SELF, (), NOTHING)
    assert found.cycles[0].values == pytest.approx(plain.build(MPI.COMM_SELF, ()).solve(NOTHING).outputs, rel=1e-9)
    assert found.cycles[0].unknowns == plain.unknowns
    with pytest.raises(ModelError, match=r"model\.adapt: meshes are refined by studies that sample"):
        spec.build(MPI.COMM_SELF, ())


@pytest.mark.slow
@pytest.mark.mpi
@UP_TO_RANKS
def test_the_ranks_do_not_decide(file, ranks):
    """Shared by ranks, sums are rounded otherwise: the same cells are marked all the same."""
    script = f"""
import hashlib, sys
import numpy as np
from forward.bodies.tetrahedra import packed
from forward.fem.adapt import adapt
from tests.forward.fem.test_adapt import bent
from tests.ranks import groups
for comm in groups():
    for indicator in ("dual-weighted", "recovery"):
        spec = bent({{"kind": "mesh", "file": {file!r}}}, tolerance=0.31, outputs=("near", "end"), indicator=indicator)
        found = adapt(spec, comm, (), np.zeros(0))
        if comm.rank == 0:
            print(len(found.cycles), found.cycles[-1].unknowns, hashlib.sha256(packed(found.mesh)).hexdigest())
"""
    done = on_kept_ranks(ranks, script)
    assert done.returncode == 0, done.stderr
    said = done.stdout.splitlines()
    assert len(said) == 2 * ranks
    assert all(said[2 * k : 2 * k + 2] == said[:2] for k in range(ranks))


def test_errors_are_relative_to_the_corrected_outputs():
    cycle = Cycle(6, 36, (1.0, -0.5, 0.0, 2e-3, 3.0), (0.25, 0.5, 0.0, -1e-3, np.nan), (1.0,) * 5, 0.0)
    assert cycle.relative[:4] == pytest.approx([0.2, 1.0, 0.0, 1.0])
    assert np.isnan(cycle.relative[4])


def test_the_fewest_cells_that_make_half_of_the_error():
    indicators = np.array([0.1, 0.3, 0.05, 0.2, 0.2 * (1 - 1e-9), 0.15])
    assert largest(indicators).tolist() == [1, 3, 4]  # of two that tie both, whatever rounding does to them
    shares = np.random.default_rng(0).random(1000) ** 6
    marked = largest(shares)
    assert shares[marked].sum() >= BULK * shares.sum()
    assert shares[marked].sum() - shares[marked].min() < BULK * shares.sum()


def test_what_estimates_miss_is_learnt_from_the_meshes_before():
    errors = np.array([[0.4, 1.0], [0.25, 0.4], [0.1, 0.2], [0.02, 0.1]])
    values = np.array([3.0, -2.0]) - errors
    seen = errors * np.array([0.6, 1.4])
    assert saturation(values[:2], seen[:2]).tolist() == [1.0, 1.0]
    assert saturation(values, seen) == pytest.approx([1 / 0.6, 1.0])  # never less than what is seen
    unknown = np.full((4, 1), np.nan)
    assert saturation(values[:, :1], unknown).tolist() == [1.0]


def test_recovered_stresses_are_those_that_do_not_jump():
    mesh, place = tetrahedra(
        Hyperelastic.model_validate(
            bent({"size": (1.0, 0.7, 0.25), "cells": (2, 1, 1), "cell": "tetrahedron"}).model_dump()
        ).body
    )
    mesh = replace(mesh, points=place(mesh.points))
    linear = mesh.points[mesh.cells] @ np.random.default_rng(1).normal(size=(3, 9))
    assert recovery(mesh, linear) == pytest.approx(0, abs=1e-25)
    # Stresses that are constant on each of two regions jump at the interface, and that is no error.
    halves = replace(
        mesh, regions=("left", "right"), region=(mesh.points[mesh.cells].mean(axis=1)[:, 0] > 0.5).astype(int)
    )
    constant = np.repeat(halves.region[:, None, None], 4, axis=1) * np.ones(9)
    assert recovery(halves, constant) == pytest.approx(0, abs=1e-25)
    assert recovery(mesh, constant).max() > 0
    # One cell against a mean: ∫(P* − P)² by quadrature of the linear function on the cell.
    stresses = np.random.default_rng(2).normal(size=(len(mesh.cells), 4, 9))
    points = np.array([[0.58541020, 0.13819660, 0.13819660, 0.13819660]])
    points = np.array([np.roll(points[0], k) for k in range(4)])  # exact to degree 2
    at = mesh.points[mesh.cells]
    volumes = np.abs(np.linalg.det(at[:, 1:] - at[:, :1])) / 6
    means = np.zeros((len(mesh.points), 9))
    for vertex in range(len(mesh.points)):
        cells, corners = np.nonzero(mesh.cells == vertex)
        means[vertex] = np.average(stresses[cells, corners], weights=volumes[cells], axis=0)
    jump = points @ (means[mesh.cells] - stresses)
    expected = volumes / 4 * (jump**2).sum(axis=(1, 2))
    assert recovery(mesh, stresses) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("body", "settings", "message"),
    [
        ({"cell": "hexahedron"}, {}, "hexahedra are not refined locally, expected body.cell = 'tetrahedron'"),
        ({}, {"outputs": ("neer",)}, "no output has this name; did you mean 'near'"),
        ({}, {"outputs": ("stress",)}, "the error of the mesh in this output cannot be estimated"),
        ({}, {"outputs": ()}, "at least 1 item"),
        ({}, {"tolerance": 1e-9}, "below what the solver reaches .* expected at least 1e-07"),
        ({}, {"tolerance": 1.0}, "less than 1"),
        ({}, {"tolerance": float("nan")}, "finite number"),
        ({}, {"unknowns": 20}, "the mesh has 36 before it is refined"),
        ({}, {"indicator": "residual"}, "dual-weighted"),
    ],
)
def test_mistakes(body, settings, message):
    sides = {"size": (1.0, 0.7, 0.25), "cells": (2, 1, 1), "cell": "tetrahedron"}
    with pytest.raises(ValidationError, match=message) as caught:
        bent(sides | body, **settings)
    assert len(caught.value.errors()) == 1


def test_mistakes_of_files_and_fields(tmp_path):
    meshio.write(tmp_path / "box.msh", box("hexahedron"), file_format="gmsh22", binary=False)
    blocks = bent({"size": (1.0, 0.7, 0.25), "cells": (2, 1, 1), "cell": "tetrahedron"}).model_dump()
    with pytest.raises(ValidationError, match="not refined locally, expected a mesh of tetrahedra"):
        Hyperelastic.model_validate(
            blocks
            | {"body": {"kind": "mesh", "file": str(tmp_path / "box.msh")}}
            | {"outputs": ({"kind": "strain-energy", "name": "energy"},), "clamp": ("x-min",)}
            | {"loads": ({"kind": "gravity", "density": 1.0},)}
        )
    with pytest.raises(ValidationError, match="its coefficients would change with the mesh"):
        Hyperelastic.model_validate(
            blocks | {"fields": ({"of": "stiffness", "length": 0.3, "std": 0.2, "basis": "noise"},)}
        )


@pytest.mark.parametrize("degree", [1, 2])
def test_each_mesh_starts_from_the_one_before(file, monkeypatch, degree):
    """Displacements are carried over exactly where the finer mesh can hold them."""
    guesses, solve = [], HyperelasticModel.solve

    def solved(model, parameters, guess=None):
        found = solve(model, parameters, guess)
        first, second = (
            None if u is None else model.space.gather(u[None])[0] for u in (guess and guess.state, found.state)
        )
        guesses.append((first, second, model.space.coordinates, found.work))
        return found

    monkeypatch.setattr(HyperelasticModel, "solve", solved)
    body = {"kind": "mesh", "file": file, "degree": degree}
    adapt(bent(body, tolerance=0.01, cycles=2), MPI.COMM_SELF, (), NOTHING)
    (none, first, nodes, whole), (guess, second, finer, less), _ = guesses
    assert none is None
    known = {tuple(place): u for place, u in zip(nodes.round(9).tolist(), first.reshape(-1, 3), strict=True)}
    shared = [i for i, place in enumerate(finer.round(9).tolist()) if tuple(place) in known]
    before = np.array([known[tuple(place)] for place in finer[shared].round(9).tolist()])
    np.testing.assert_allclose(guess.reshape(-1, 3)[shared], before, atol=1e-12)
    assert np.linalg.norm(guess - second) < 0.6 * np.linalg.norm(second)  # linear cells bend twice as far
    assert less.residuals < whole.residuals


def test_meshes_too_coarse_for_estimates_are_refined_where_stresses_jump():
    """A beam of linear tetrahedra that lock: richer elements bend it farther than a few Newton steps reach."""
    spec = Hyperelastic.model_validate(
        {
            "formulation": "displacement",
            "body": {"size": (2.0, 1.0, 1.0), "cells": (4, 1, 1), "cell": "tetrahedron", "degree": 1},
            "material": {"kind": "neo-hookean-coupled", "mu": 2e4, "lmbda": 4e7},
            "clamp": ("x-min",),
            "loads": ({"kind": "traction", "on": "x-max", "direction": (0, 0, -1), "size": 1000.0},),
            "outputs": ({"kind": "mean-displacement", "name": "tip", "on": "x-max", "component": "z"},),
            "adapt": {"tolerance": 0.1, "cycles": 1},
        }
    )
    said = []
    found = adapt(spec, MPI.COMM_SELF, (), NOTHING, said.append)
    assert np.isnan([cycle.errors for cycle in found.cycles]).all()
    assert found.cycles[1].cells > found.cycles[0].cells
    assert found.indicators.sum() == pytest.approx(1)
    assert all("too coarse for estimates" in line for line in said)
    assert found.stopped == "cycles = 1"
