"""Tools on a body so large that it counts as a half-space: forces against closed forms, by meshes and by sizes.

The body is a quarter of a cylinder, bonded below, whose cells are thin at the edge of the area in contact and grow
geometrically from there on, along r and along z, so that a body of 640 radii has few more cells than one of ten.
"""

from __future__ import annotations

import math
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mpi4py import MPI
from scipy.integrate import trapezoid
from scipy.interpolate import PchipInterpolator
from scipy.optimize import brentq

from forward.bodies.mesh import Loaded
from forward.bodies.tetrahedra import packed
from forward.hyperelastic import Hyperelastic
from forward.model import FloatArray
from forward.terms.indenter import Indenter

C1, D1 = 1e3, 2e3  # ν = 2/7
CONTACT, DEPTH = 1e-3, 2e-6  # radius in contact and depth (m): small strains
SHARP = 1 / 20  # radii of the edge of a punch and of the tip of a cone, over the radius in contact
TOOLS: dict[str, dict[str, Any]] = {
    "sphere": {"radius": CONTACT**2 / DEPTH},
    "flat": {"radius": CONTACT, "edge": SHARP * CONTACT},
    "cone": {"angle": math.degrees(math.atan(math.pi / 2 * CONTACT / DEPTH)), "tip": SHARP * CONTACT},
}
SINGULAR = 1 / 8  # at the edge of a punch pressures are singular: how much thinner cells are there
SECTORS = 3  # cells around the quarter


class Mesh(NamedTuple):
    """How a cylinder is meshed.

    Attributes
    ----------
    side
        Its radius and height, over the radius in contact (by the closed form).
    first
        Edge of the cells where contact ends, over the radius in contact; SINGULAR times that for a punch.
    growth
        From one cell to the next.
    """

    side: float
    first: float
    growth: float

    @classmethod
    def read(cls, text: str) -> Mesh:
        """Read "side,first,growth"."""
        return cls(*map(float, text.split(",")))


MESHES = (
    Mesh(640, 0.4, 2.0),
    Mesh(640, 0.2, 1.6),
    Mesh(640, 0.1, 1.4),
    Mesh(160, 0.2, 1.6),
    Mesh(40, 0.2, 1.6),
)


def ticks(first: float, end: float, growth: float) -> FloatArray:
    """Places from 0 to `end`, the first two of them `first` apart and the others by nearly `growth` times more each."""
    n = max(2, round(math.log1p(end / first * (growth - 1)) / math.log(growth)))
    exact = brentq(lambda g: first * sum(g**k for k in range(n)) - end, 1e-2, 1e2)
    return np.append(0, np.cumsum(first * exact ** np.arange(n)))


def cylinder(side: float, first: float, growth: float) -> Loaded:
    """Return a quarter of a cylinder of that radius and height, on the unit of the radius in contact.

    Prisms over triangles of rings, each divided into three tetrahedra by the numbers of its vertices. Rings are
    polygons that are as large as their circles.
    """
    radii = np.append(1 - ticks(first, 1, growth)[::-1], 1 + ticks(first, side - 1, growth)[1:])
    heights = -ticks(2 * first, side, growth)
    angles = np.linspace(0, math.pi / 2, SECTORS + 1)
    swollen = math.sqrt(angles[1] / math.sin(angles[1]))
    rings = swollen * radii[1:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    plane = np.concatenate([[[0.0, 0.0]], rings.reshape(-1, 2)])
    plane[np.abs(plane) < 1e-12 * side] = 0
    i, j = (one.ravel() for one in np.meshgrid(np.arange(len(radii) - 2), np.arange(SECTORS), indexing="ij"))
    a = 1 + i * (SECTORS + 1) + j
    b = a + SECTORS + 1
    inner = np.array([(0, 1 + k, 2 + k) for k in range(SECTORS)])
    triangles = np.concatenate([inner, np.stack([a, b, b + 1], axis=1), np.stack([a, a + 1, b + 1], axis=1)])
    points = np.concatenate([np.column_stack([plane, np.full(len(plane), height)]) for height in heights])
    below = len(plane)
    cells = np.concatenate(
        [
            np.concatenate([triangles[:, : k + 1], triangles[:, k:] + below], axis=1) + below * layer
            for layer in range(len(heights) - 1)
            for k in range(3)
        ]
    )
    edges = points[cells][:, 1:] - points[cells][:, :1]
    turned = np.linalg.det(edges) < 0
    cells[turned] = cells[turned][:, [0, 1, 3, 2]]
    faces = np.concatenate([np.delete(cells, k, axis=1) for k in range(4)])
    boundaries = {
        name: faces[(points[faces][:, :, axis] == at).all(axis=1)]
        for name, axis, at in (("top", 2, 0.0), ("bottom", 2, heights[-1]), ("x-min", 0, 0.0), ("y-min", 1, 0.0))
    }
    return Loaded(points, cells, "tetrahedron", boundaries, ("body",), np.zeros(len(cells), dtype=np.int64))


def pressed(shape: str) -> Indenter:
    """Return a tool of that shape at its depth."""
    place = {"on": "top", "at": [0.0, 0.0, 0.0], "direction": [0.0, 0.0, -1.0], "depth": DEPTH}
    return Indenter.model_validate({"shape": shape} | place | TOOLS[shape])


def specification(shape: str, mesh: Mesh, folder: Path, unit: float) -> Hyperelastic:
    """Return a tool on a cylinder, whose mesh, with `unit` (m) in contact, is put into a folder."""
    file = folder / "cylinder.npz"
    file.write_bytes(packed(cylinder(mesh.side, edge(shape, mesh), mesh.growth)))
    return Hyperelastic.model_validate(
        {
            "body": {"kind": "mesh", "file": str(file), "unit": unit, "degree": 2},
            "material": {"kind": "neo-hookean", "C1": C1, "D1": D1},
            "formulation": "displacement",
            "displacements": [{"on": "x-min", "x": 0.0}, {"on": "y-min", "y": 0.0}],
            "clamp": ["bottom"],
            "loads": [pressed(shape).model_dump(exclude_none=True)],
            "outputs": [{"name": "force", "kind": "force", "times": 4}],
        }
    )


def edge(shape: str, mesh: Mesh) -> float:
    """Edge of the thinnest cells, over the radius in contact."""
    return mesh.first * (SINGULAR if shape == "flat" else 1)


def textbook(shape: str, modulus: float) -> float:
    """Force (N) on a half-space by an ideal tool with `CONTACT` in contact at `DEPTH`: Hertz, Boussinesq, Sneddon."""
    return {"sphere": 4 / 3, "flat": 2.0, "cone": 1.0}[shape] * modulus * CONTACT * DEPTH


class HalfSpace(NamedTuple):
    """What a tool does to a half-space.

    Attributes
    ----------
    force
        On the tool (N).
    radius
        Of the area in contact (m).
    """

    force: float
    radius: float


def half_space(tool: Indenter, modulus: float) -> HalfSpace:
    """Press a tool with its own profile f(r) against a half-space: L. A. Galin; I. N. Sneddon, 1965.

    δ = ∫ f'(r) a/√(a² − r²) dr and F = 2E* ∫ f'(r) r²/√(a² − r²) dr over the radius a of the area in contact, so what
    differs from Hertz's sphere, a punch and a cone (rounded edges and tips) is no error here.
    """
    end = min(0.999999 * (tool.radius or 1.0), 20 * CONTACT)
    r = end * np.sin(np.linspace(0, np.pi / 2, 4001))
    slope = PchipInterpolator(r, _heights(tool, r)).derivative()
    angles = np.linspace(0, np.pi / 2, 20001)

    def of(a: float) -> tuple[float, float]:
        slopes = slope(a * np.sin(angles))
        return a * trapezoid(slopes, angles), 2 * modulus * a**2 * trapezoid(slopes * np.sin(angles) ** 2, angles)

    radius = float(brentq(lambda a: of(a)[0] - tool.depth, 1e-3 * CONTACT, end))
    return HalfSpace(float(of(radius)[1]), radius)


def _heights(tool: Indenter, r: FloatArray) -> FloatArray:
    """How far (m) the surface of a tool lies behind its tip, at distances r (n,) from its axis, by bisection."""
    d = np.array(tool.along)
    beside = np.array(tool.at) + tool.depth * d + np.outer(r, [1.0, 0.0, 0.0])
    low, high = np.full(len(r), -1e-6), np.full(len(r), 1e-1)
    for _ in range(60):
        middle = (low + high) / 2
        outside = tool.gaps(beside - np.outer(middle, d)) > 0
        low, high = np.where(outside, middle, low), np.where(outside, high, middle)
    return (low + high) / 2


class Compared(NamedTuple):
    """A force over that by closed forms.

    Attributes
    ----------
    own
        By that of the tool as it is, with its rounded edge or tip.
    ideal
        By that of the textbook.
    penetration
        Over the depth.
    unknowns, factors, seconds
        What it took (processor time, s).
    """

    own: float
    ideal: float
    penetration: float
    unknowns: int
    factors: int
    seconds: float


def compared(shape: str, mesh: Mesh) -> Compared:
    """Press a tool against a cylinder."""
    known = half_space(pressed(shape), 1.0)  # radii do not depend on the modulus
    with tempfile.TemporaryDirectory() as folder:
        spec = specification(shape, mesh, Path(folder), known.radius)
        model = spec.build(MPI.COMM_SELF, ())
    start = time.process_time()
    found = model.solve(np.zeros(0))
    seconds = time.process_time() - start
    force = float(found.outputs[0]) / spec.contact_modulus
    into = model.equations.penetrations()["indenter"] / DEPTH
    ratios = force / known.force, force / textbook(shape, 1.0)
    return Compared(*ratios, into, spec.unknowns, found.work.factorisations, seconds)


def closed_forms(meshes: list[Mesh], shapes: list[str]) -> None:
    """Print forces over those on a half-space."""
    sys.stdout.write(
        "Force over that on a half-space: radius and height of the cylinder and first edge over the radius in contact,"
        " growth; by the tool as it is, and by the textbook's\n"
    )
    for shape in shapes:
        for mesh in meshes:
            found = compared(shape, mesh)
            sys.stdout.write(
                f"{shape:6s} {mesh.side:3g}, {edge(shape, mesh):5g}, {mesh.growth:3g}; {found.unknowns:7,d} unknowns: "
                f"{found.own:.4f}, {found.ideal:.4f}; penetration {found.penetration:.1e} of the depth; "
                f"{found.factors} factors, {found.seconds:.1f} s of CPU\n"
            )
            sys.stdout.flush()
