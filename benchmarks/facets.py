"""What flat facets hide of a curved surface, against the radial equation of a thick sphere under pressure."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import meshio
import numpy as np
from mpi4py import MPI
from scipy.integrate import solve_bvp

from forward.bodies.mesh import FACES, TETRAHEDRA, IntArray
from forward.hyperelastic import Hyperelastic
from forward.model import FloatArray

INNER, OUTER, PRESSURE = 0.5, 1.0, 4000.0  # m, m, Pa
C1, D1 = 5e3, 2e4  # Pa
MESHES = [(cell, along, layers) for cell in ("hexahedron", "tetrahedron") for along, layers in ((2, 2), (3, 3), (4, 3))]
NAMES = ("energy", "inner", "outer", "middle")
PLANES = {7 + axis: f"{name}-min" for axis, name in enumerate("xyz")}


def main() -> None:
    """Print, in per cent of each output: its error, what the mesh is said to do, and what facets are said to hide."""
    true = exact()
    print(f"| cells | {' | '.join(f'{name}: error, mesh ± doubt, facets' for name in NAMES)} |\n|{'---|' * 5}")
    with tempfile.TemporaryDirectory() as folder:
        for cell, along, layers in MESHES:
            spec = body(Path(folder), cell, along, layers)
            solution = spec.build(MPI.COMM_SELF, ()).solve(np.zeros(0))
            known = solution.saturation()
            assert known.doubts is not None
            assert known.hidden is not None
            of_mesh = solution.mesh_error().calibrated(known).outputs
            parts = 100 * np.array([true - solution.outputs, of_mesh, known.doubts, known.hidden]) / solution.outputs
            found = (f"{error:.2f}, {e:.2f} ± {doubt:.2f}, {hidden:.2f}" for error, e, doubt, hidden in parts.T)
            print(f"| {spec.body.cells_in_words} × {cell} | {' | '.join(found)} |", flush=True)


def body(folder: Path, cell: str, along: int, layers: int) -> Hyperelastic:
    """Return an eighth of the sphere, of which each of three patches has so many cells along its edges."""
    points, cells = octant(cell, along, layers)
    radii, facets, tags = np.linalg.norm(points, axis=1), [], []
    for corners in cells:
        for face in FACES[cell]:
            on = corners[face]
            places = {5: radii[on] - INNER, **{7 + axis: points[on, axis] for axis in range(3)}}
            for tag in (tag for tag, away in places.items() if np.abs(away).max() < 1e-9):
                facets.append(on)
                tags.append(tag)
    kinds = ("hexahedron", "quad") if cell == "hexahedron" else ("tetra", "triangle")
    blocks = [(kinds[0], cells), (kinds[1], np.array(facets))]
    path = folder / f"{cell}-{along}-{layers}.vtu"
    if not path.exists():  # another rank may be reading it
        parts = [np.ones(len(cells), dtype=int), np.array(tags)]
        meshio.write(path, meshio.Mesh(points, blocks, cell_data={"part": parts}))
    at = {"inner": (INNER, 0.0, 0.0), "outer": (OUTER, 0.0, 0.0), "middle": ((INNER + OUTER) / 2, 0.0, 0.0)}
    outputs = [{"kind": "displacement", "name": name, "at": place, "component": "x"} for name, place in at.items()]
    return Hyperelastic.model_validate(
        {
            "formulation": "displacement",
            "body": {"kind": "mesh", "file": str(path), "names": {"inside": 5} | {v: k for k, v in PLANES.items()}},
            "material": {"kind": "neo-hookean", "C1": C1, "D1": D1},
            "displacements": [{"on": name, name[0]: 0.0} for name in PLANES.values()],
            "loads": [{"kind": "pressure", "on": "inside", "size": PRESSURE}],
            "outputs": [{"kind": "strain-energy", "name": "energy"}, *outputs],
        }
    )


def octant(cell: str, along: int, layers: int) -> tuple[FloatArray, IntArray]:
    """Return the points and cells of an eighth of a hollow sphere: three sides of a cube, on spheres."""
    numbers: dict[tuple[float, ...], int] = {}

    def number(axis: int, place: tuple[int, int, int]) -> int:
        sides = np.tan(np.pi / 4 * np.array([along, *place[:2]]) / along)
        way = np.roll(sides, axis) / np.linalg.norm(sides)
        point = way * (INNER + (OUTER - INNER) * place[2] / layers)
        return numbers.setdefault(tuple(np.round(point, 12) + 0.0), len(numbers))

    def corners() -> Iterator[list[int]]:
        square = [(0, 0), (1, 0), (1, 1), (0, 1)]
        for axis, i, j, k in product(range(3), range(along), range(along), range(layers)):
            yield [number(axis, (i + a, j + b, k + c)) for c in (0, 1) for a, b in square]

    cells = np.array(list(corners()))
    return np.array(list(numbers)), cells if cell == "hexahedron" else cells[:, TETRAHEDRA["hexahedron"]].reshape(-1, 4)


def exact() -> FloatArray:
    """Return the outputs by collocation: dP/dR + 2 (P − S)/R = 0 with the nominal stresses P along R and S across."""
    import sympy

    along, across = sympy.symbols("along across")
    J = along * across**2
    W = C1 * (J ** sympy.Rational(-2, 3) * (along**2 + 2 * across**2) - 3) + D1 * (J - 1) ** 2
    P, S = sympy.diff(W, along), sympy.diff(W, across) / 2
    energy, radial, other, stiffness, coupling = (
        sympy.lambdify((along, across), what) for what in (W, P, S, sympy.diff(P, along), sympy.diff(P, across))
    )

    def slopes(R: FloatArray, y: FloatArray) -> FloatArray:
        a, b = y[1], y[0] / R
        return np.array([a, -(2 * (radial(a, b) - other(a, b)) + coupling(a, b) * (a - b)) / (R * stiffness(a, b))])

    def ends(first: FloatArray, last: FloatArray) -> FloatArray:
        inside = first[0] / INNER
        return np.array([radial(first[1], inside) + PRESSURE * inside**2, radial(last[1], last[0] / OUTER)])

    R = np.linspace(INNER, OUTER, 200)
    found = solve_bvp(slopes, ends, R, np.array([R, np.ones_like(R)]), tol=1e-10, max_nodes=100_000)
    assert found.status == 0, found.message
    nodes, weights = np.polynomial.legendre.leggauss(40)
    at = (INNER + OUTER) / 2 + (OUTER - INNER) / 2 * nodes
    r, slope = found.sol(at)
    stored = np.pi / 2 * (OUTER - INNER) / 2 * (weights * energy(slope, r / at) * at**2).sum()
    places = np.array([INNER, OUTER, (INNER + OUTER) / 2])
    return np.array([stored, *(found.sol(places)[0] - places)])


if __name__ == "__main__":
    main()
