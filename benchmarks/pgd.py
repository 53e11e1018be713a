"""Separated responses (proper generalised decomposition): rod, beam, organ; pairs, errors, times of an evaluation."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from docs.examples.separated import Operator, Separated, Stencil, alternating, cubic_stencil, from_snapshots
from forward.model import FloatArray

ORGAN = Path(__file__).parent.parent / "configs" / "organ.toml"
SPREAD = 0.015  # m: width of a fingertip
PAIRS = (5, 10, 20, 40, 80, 160, 320)
LONG, WIDE, YOUNG, FORCE = 400.0, 40.0, 1.0, 320.0  # mm, mm, MPa, N: the rod and the beam of the literature


# --- the rod ---------------------------------------------------------------------------------------------------------


def tip() -> float:
    """Displacement (mm) of the end of a Saint Venant–Kirchhoff rod pulled there: (λ³ − λ)/2 = F/EA, by Cardano."""
    k = FORCE / (YOUNG * WIDE**2)
    beta = (k + np.sqrt(k**2 - 1 / 27)) ** (1 / 3)
    return float((beta - 1 + 1 / (3 * beta)) * LONG)


def rod(steps: int, cells: int = 20) -> tuple[FloatArray, int]:
    """Displacements u(x, s) (nodes, places) of the rod pulled at any place s, in explicit steps of the force.

    Every step adds what alternating directions find for the linearised problem, with all forces out of balance.

    Returns
    -------
    tuple of numpy.ndarray and int
        u, and the number of pairs that hold it to 1e-6.
    """
    from scipy.sparse import csc_matrix, diags

    h = LONG / cells
    slope = (diags([np.ones(cells), -np.ones(cells - 1)], [0, -1], (cells, cells)) / h).tocsc()  # of the free nodes
    places = h * np.arange(1, cells + 1)
    loaded = (h * (np.arange(cells) + 0.5)[:, None] < places).astype(float)  # cells between the support and the force
    area, weights = WIDE**2, [np.full(cells, h)]
    u = np.zeros((cells, cells))
    for step in range(1, steps + 1):
        stretch = 1 + slope @ u
        force = YOUNG * area * (stretch**3 - stretch) / 2
        stiffness = from_snapshots(YOUNG * area * (3 * stretch**2 - 1) / 2, 1e-9)
        operators = [
            Operator(csc_matrix(slope.T @ diags(h * field) @ slope), (values,))
            for field, values in zip(stiffness.fields, stiffness.factors[0], strict=True)
        ]
        rest = from_snapshots(h * (FORCE * step / steps * loaded - force), 1e-9)
        load = Separated(rest.fields @ slope, rest.of, rest.factors)
        u = u + alternating(operators, load, weights, 1e-4).whole()
    return np.vstack([np.zeros(cells), u]), from_snapshots(u, 1e-6).pairs


# --- linear tetrahedra, as in the literature -------------------------------------------------------------------------


def elasticity(points: FloatArray, cells: NDArray[np.int64], young: float, poisson: float) -> Any:
    """Stiffness (3n, 3n) of linear tetrahedra for small strains."""
    from scipy.sparse import csc_matrix

    corners = points[cells]
    edges = corners[:, 1:] - corners[:, :1]
    volume = np.abs(np.linalg.det(edges)) / 6
    inner = np.linalg.inv(edges).swapaxes(1, 2)  # gradients of the last three shape functions
    slopes = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)
    mu, lam = young / 2 / (1 + poisson), young * poisson / (1 + poisson) / (1 - 2 * poisson)
    across = np.einsum("cai,cbj->caibj", slopes, slopes)
    dots = np.einsum("cai,cbi->cab", slopes, slopes)
    local = lam * across + mu * across.transpose(0, 1, 4, 3, 2) + mu * np.einsum("cab,ij->caibj", dots, np.eye(3))
    local = local * volume[:, None, None, None, None]
    dofs = (3 * cells[:, :, None] + np.arange(3)).reshape(len(cells), 12)
    rows, columns = np.repeat(dofs, 12, axis=1).ravel(), np.tile(dofs, (1, 12)).ravel()
    return csc_matrix((local.reshape(-1), (rows, columns)), shape=(3 * len(points), 3 * len(points)))


def beam_mesh(cells: tuple[int, int, int] = (20, 8, 8)) -> tuple[FloatArray, NDArray[np.int64]]:
    """Vertices and tetrahedra of the beam, six to a cube."""
    n = np.array(cells) + 1
    grid = np.stack(np.meshgrid(*[np.arange(k) for k in n], indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(n.prod()).reshape(n)
    corner = {
        b: number[b[0] : n[0] - 1 + b[0], b[1] : n[1] - 1 + b[1], b[2] : n[2] - 1 + b[2]].ravel()
        for b in np.ndindex(2, 2, 2)
    }
    found = []
    for order in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        at, path = np.zeros(3, dtype=int), [corner[0, 0, 0]]
        for axis in order:
            at[axis] = 1
            path.append(corner[tuple(at)])
        found.append(np.stack(path, axis=1))
    return grid * np.array([LONG, WIDE, WIDE]) / np.array(cells), np.concatenate(found)


def pressed(
    stiffness: Any, free: NDArray[np.bool_], forces: FloatArray, title: str, tolerance: float, most: int
) -> None:
    """Print errors of the response to a force at any of S places (S, 3n), by pairs; times of an evaluation.

    Without alternating directions if their tolerance is 0.
    """
    from scipy.sparse.linalg import splu

    K, F, S = stiffness[free][:, free].tocsc(), forces[:, free], len(forces)
    begin = time.process_time()
    factor = splu(K)
    exact = factor.solve(np.ascontiguousarray(F.T))
    solved = time.process_time() - begin
    begin = time.process_time()
    best = from_snapshots(exact, 1e-6)
    cut = time.process_time() - begin
    said = f"{best.pairs} pairs to 1e-6 by singular values in {cut:.2g} s"
    found = best.first(min(most, best.pairs))
    if tolerance:
        weights, load = [np.full(S, 1 / S)], Separated(F, np.arange(S), (np.eye(S),))
        begin = time.process_time()
        found = alternating([Operator(K, (np.ones(S),))], load, weights, tolerance, most)
        said += f", {found.pairs} by alternating directions in {time.process_time() - begin:.2g} s"
    print(f"\n{title}: {len(exact):,} unknowns, {S} places. Solved at all places in {solved:.2g} s; {said}.\n")
    print("| pairs | alternating directions | its largest error | singular values | a point (µs) | the surface (µs) |")
    print("|---|---|---|---|---|---|")
    size, largest = np.linalg.norm(exact), np.abs(exact).max()
    surface = np.unique(np.abs(F).max(axis=0).nonzero()[0])
    for pairs in [*(p for p in PAIRS if p < found.pairs), found.pairs]:
        by_svd = np.linalg.norm(best.first(min(pairs, best.pairs)).whole() - exact) / size
        some = found.first(pairs)
        some = Separated(some.fields[:pairs], some.of, some.factors)
        alone = "– | –"
        if tolerance:
            error = some.whole() - exact
            alone = f"{np.linalg.norm(error) / size:.2g} | {np.abs(error).max() / largest:.2g}"
        places: list[Stencil] = [
            (np.array([i, (i + 1) % S]), np.array([0.4, 0.6])) for i in range(0, S, max(1, S // 200))
        ]
        micro = [_microseconds(some.within(rows), places) for rows in (surface[:3], surface)]
        print(f"| {pairs} | {alone} | {by_svd:.2g} | {micro[0]:.2g} | {micro[1]:.2g} |", flush=True)


def _microseconds(response: Separated, places: Sequence[Stencil]) -> float:
    times = []
    for place in list(places) * 5:
        begin = time.perf_counter()
        response.at(place)
        times.append(time.perf_counter() - begin)
    return float(1e6 * np.median(times))


def beam(most: int) -> None:
    """The beam: pulled down at any node of its upper side."""
    points, cells = beam_mesh()
    upper = np.flatnonzero((points[:, 2] == WIDE) & (points[:, 0] > 0))
    forces = np.zeros((len(upper), 3 * len(points)))
    forces[np.arange(len(upper)), 3 * upper + 2] = -1.0
    free = np.repeat(points[:, 0] > 0, 3)
    pressed(elasticity(points, cells, YOUNG, 0.25), free, forces, "The beam, small strains", 1e-6, most)


def organ(most: int, levels: int, tolerance: float) -> None:
    """An organ held at a vessel, pressed along the normal at any vertex of the rest of its surface."""
    from forward.bodies.mesh_file import MeshFile
    from workflows.config.study import load

    spec: Any = load(ORGAN).model
    assert isinstance(spec.body, MeshFile)
    mesh = spec.body.model_copy(update={"levels": levels}).load()
    held = np.unique(mesh.boundaries["vessel"])
    faces = np.concatenate([mesh.cells[:, list(f)] for f in ((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))])
    opposite = mesh.cells.T.ravel()
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    outer, inside = faces[first[count == 1]], opposite[first[count == 1]]
    corners = mesh.points[outer]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inwards = np.einsum("fi,fi->f", normal, mesh.points[inside] - corners[:, 0]) > 0
    normal = np.where(inwards[:, None], normal, -normal)
    total = np.zeros_like(mesh.points)
    np.add.at(total, outer.ravel(), np.repeat(normal, 3, axis=0))
    places = np.setdiff1d(np.unique(outer), held)
    forces = np.zeros((len(places), 3 * len(mesh.points)))
    size = np.linalg.norm(total[places], axis=1)
    forces[np.arange(len(places))[:, None], 3 * places[:, None] + np.arange(3)] = total[places] / size[:, None]
    free = np.repeat(~np.isin(np.arange(len(mesh.points)), held), 3)
    stiffness = elasticity(mesh.points, mesh.cells, 160e3, 0.48)
    title = "The organ, small strains, E = 160 kPa, ν = 0.48, "
    if not levels:  # a vertex is a smaller place on a finer mesh: its dents are of the mesh, not of the organ
        pressed(stiffness, free, forces, title + "a force at a vertex", tolerance, most)
    away = np.linalg.norm(mesh.points[places][:, None] - mesh.points[places], axis=2)
    spread = np.exp(-((away / SPREAD) ** 2) / 2) * size
    spread = spread / spread.sum(axis=1, keepdims=True)
    pressed(stiffness, free, spread @ forces, title + f"spread over {1e3 * SPREAD:.0f} mm", tolerance, most)


# --- large deformations, from snapshots ------------------------------------------------------------------------------

SPOT = {
    "kind": "spot",
    "on": "z-max",
    "direction": [0, 0, -1],
    "size": 10.0,
    "x": 0.2,
    "y": 0.02,
    "z": 0.04,
    "width": 0.02,
}
BENT = {
    "body": {"kind": "box", "size": [0.4, 0.04, 0.04], "cells": [16, 2, 2], "cell": "hexahedron", "degree": 2},
    "material": {"kind": "saint-venant-kirchhoff", "mu": 4e5, "lmbda": 4e5},
    "clamp": ["x-min"],
    "loads": [SPOT],
    "outputs": [{"name": "uz", "kind": "displacement", "at": [0.4, 0.02, 0.04], "component": "z"}],
}


def bent(places: int = 17, sizes: int = 6, unseen: int = 20) -> None:
    """The beam as a Saint Venant–Kirchhoff body under a spot: place and force are coordinates."""
    from mpi4py import MPI

    from forward.hyperelastic import Hyperelastic
    from forward.model import gathered

    names = ("loads.spot.x", "loads.spot.size")
    model = Hyperelastic.model_validate(BENT).build(MPI.COMM_SELF, names)
    x, force = np.linspace(0.04, 0.4, places), np.linspace(0.0, 6.0, sizes)

    def solved(points: FloatArray) -> tuple[FloatArray, float]:
        begin = time.process_time()
        states = [gathered(model, model.solve(point).state[None])[0] for point in points]  # type: ignore[index]
        return np.array(states), time.process_time() - begin

    grid = np.stack(np.meshgrid(x, force, indexing="ij"), axis=-1).reshape(-1, 2)
    states, offline = solved(grid)
    snapshots = states.reshape(places, sizes, -1).transpose(2, 0, 1)
    random = np.random.default_rng(0).random((unseen, 2))
    points = np.array([x[0], force[1]]) + random * np.array([x[-1] - x[0], force[-1] - force[1]])
    truth, online = solved(points)
    print(
        f"\nThe beam, Saint Venant–Kirchhoff, {snapshots.shape[0]:,} unknowns: {places} places and {sizes} forces "
        f"solved in {offline:.2g} s, largest displacement {1e3 * np.abs(snapshots).max():.0f} mm; a solve "
        f"{1e3 * online / unseen:.0f} ms; "
        f"{unseen} unseen places and forces, cubic interpolation of the factors.\n"
    )
    print("| tolerance | fields | products | error at the grid | at unseen points | largest | an evaluation (µs) |")
    print("|---|---|---|---|---|---|---|")
    for tolerance in (1e-1, 1e-2, 1e-3, 1e-4):
        found = from_snapshots(snapshots, tolerance)
        at = [(cubic_stencil(x, a), cubic_stencil(force, b)) for a, b in points]
        errors = np.array([found.at(*place) for place in at]) - truth
        whole = found.whole() - snapshots
        times = []
        tip = found.within(np.arange(3))
        for place in at * 5:
            begin = time.perf_counter()
            tip.at(*place)
            times.append(time.perf_counter() - begin)
        print(
            f"| {tolerance:g} | {len(found.fields)} | {found.pairs} | "
            f"{np.linalg.norm(whole) / np.linalg.norm(snapshots):.1e} | "
            f"{np.linalg.norm(errors) / np.linalg.norm(truth):.1e} | "
            f"{np.abs(errors).max() / np.abs(truth).max():.1e} | "
            f"{1e6 * np.median(times):.2g} |",
            flush=True,
        )


def main(words: Sequence[str] = ()) -> None:
    """Print everything, or one part of it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks pgd")
    parser.add_argument("--only", choices=["rod", "beam", "organ", "bent"], default=None)
    parser.add_argument("--most", type=int, default=320, help="pairs")
    parser.add_argument("--levels", type=int, default=0, help="how often the cells of the organ are divided")
    parser.add_argument(
        "--tolerance", type=float, default=1e-4, help="of alternating directions for the organ; 0: none"
    )
    given = parser.parse_args(words)
    if given.only in (None, "rod"):
        print(f"The rod: closed form {tip():.4f} mm\n\n| step of the force | tip (mm) | error | pairs | CPU (s) |")
        print("|---|---|---|---|---|")
        for steps in (5, 10, 20, 40):
            begin = time.process_time()
            u, pairs = rod(steps)
            taken = time.process_time() - begin
            print(
                f"| {1 / steps:.2g} | {u[-1, -1]:.4f} | {u[-1, -1] / tip() - 1:+.1e} | {pairs} | {taken:.2g} |",
                flush=True,
            )
    if given.only in (None, "beam"):
        beam(given.most)
    if given.only in (None, "organ"):
        organ(given.most, given.levels, given.tolerance)
    if given.only in (None, "bent"):
        bent()
