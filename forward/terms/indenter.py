"""Rigid tools that are pressed against a body.

The pressure is proportional to the penetration, p = ε s, by a stiffness ε that follows from the numbers as they are
stated, so that it is the same in all solutions of a study and on all meshes. With the contact modulus E* = E/(1 − ν²)
the largest pressures over the depth δ are those of Hertz, (2/π) E*/√(R δ), for a sphere of radius R (and a cylinder);
PEAK times the mean ones of a punch of radius a, (2/π) E*/a, and of Sneddon's cone, E*/(2 tan α δ); and E* over the
extent of the body under a plane. ε is MARGIN times that over the penetration that is aimed at, relative to the depth;
where the body enters a tool further all the same, it is raised by steps of a factor (`forward.fem.model`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from annotated_types import Ge, Gt, Le, Lt, Unit
from pydantic import model_validator

from forward.bodies.geometry import Body, Direction, Vector, tolerance, unit_vector
from forward.bodies.surface import edges, facets, points
from forward.findings import Finding
from forward.model import FloatArray
from forward.readable import listed, told
from forward.scalars import Scalar
from forward.terms import tools
from forward.terms.term import Place, Term

SHARP = 1 / 20  # radius of an edge relative to that of the tool, and of a tip relative to the depth
SMOOTH = 0.1  # width over which contact sets in, relative to the penetration that is aimed at
PEAK = 3.0  # largest pressure over the mean one under flat tools and cones
MARGIN = 6.0  # stiffness beyond that for the aim: single points are pressed more, most of all on coarse meshes
ROUND = 3.0  # times that for balls and cylinders, whose edges of the area in contact move from point to point
AT_REST = 1e-3  # depth relative to the size that stands for a depth of zero
BORNE = 1e-6  # width over which contact sets in on a plane that does not move, relative to the extent of the body
ALONG = 5  # points along the edge of a facet at which contact is looked for
STARTED = 1e-3  # part of the width that keeps the share of an increment in contact defined where nothing touches
SLACK = 0.01  # of the depth, and of the inaccuracy of positions, that a tool may be inside the body at the start
POINTING = ("direction_x", "direction_y", "direction_z")
Shape = Literal["sphere", "flat", "cylinder", "cone", "plane"]
NEEDED: dict[str, tuple[str, ...]] = {
    "sphere": ("radius",),
    "flat": ("radius",),
    "cylinder": ("radius", "axis"),
    "cone": ("angle",),
    "plane": (),
}
ALLOWED: dict[str, tuple[str, ...]] = {"flat": ("edge",), "cone": ("tip",)}


class Indenter(Term):
    """A rigid tool that touches a boundary and is moved by `depth` against it.

    The body may slide along it, with Coulomb's friction or without, and leave it; points of the boundary resist
    penetration by a pressure that is proportional to it, so stiff that they enter the tool by no more than a thousandth
    of the depth (docs/theory/contact.md).

    Parameters
    ----------
    shape
        "sphere", the end of a rod; "flat", a round punch whose edge is rounded; "cylinder", lying along `axis`; "cone"
        with a rounded tip (a hyperboloid); "plane", which may also be the table on which a body rests.
    on
        The boundary that it may touch.
    at
        Its foremost point (m) before it is moved; x, y and z can be random.
    direction
        The way it points and moves; its components direction_x, … can be random.
    depth
        How far (m) it is moved.
    radius
        Of a sphere, a punch or a cylinder (m).
    edge
        Width (m) over which the edge of a punch is rounded; a twentieth of its radius by default.
    axis
        Direction of the axis of a cylinder.
    angle
        Between the side of a cone and its axis (degrees).
    tip
        Radius of curvature (m) of the tip of a cone; a twentieth of the depth by default.
    friction
        Coefficient of friction. Where it is not 0, the load grows in increments, and can be random then.
    increments
        In how many increments it grows, or goes from one step of a path to the next; by default ten in all.
    penetration
        Largest penetration that is aimed at, relative to the depth.
    """

    contact: ClassVar[bool] = True
    degree: ClassVar[int] = 8  # of the quadrature under it
    kind: Literal["indenter"] = "indenter"
    shape: Shape
    on: str
    at: Vector
    direction: Direction
    depth: Annotated[float, Ge(0), Unit("m")]
    radius: Annotated[float | None, Gt(0), Unit("m")] = None
    edge: Annotated[float | None, Gt(0), Unit("m")] = None
    axis: Direction | None = None
    angle: Annotated[float | None, Gt(0), Lt(90), Unit("°")] = None
    tip: Annotated[float | None, Gt(0), Unit("m")] = None
    friction: Annotated[float, Ge(0), Unit("1")] = 0.0
    increments: Annotated[int | None, Ge(1)] = None
    penetration: Annotated[float, Gt(0), Le(0.1)] = 1e-3

    @property
    def scalars(self) -> dict[str, Scalar]:
        found = {name: scalar for name, scalar in super().scalars.items() if scalar.value is not None}
        if not self.friction:  # then it is not in the forms
            found.pop("friction")
        places, pointing = zip("xyz", self.at, strict=True), zip(POINTING, self.along, strict=True)
        found |= {axis: Scalar(value, field=axis, besides=(Unit("m"),)) for axis, value in places}
        return found | {name: Scalar(value, field=name) for name, value in pointing}

    @property
    def size(self) -> float:
        """Radius (m) of the area that it touches at its depth, roughly; infinite for a plane."""
        depth = self.depth
        match self.shape:
            case "plane":
                return math.inf
            case "flat":
                return float(self.radius or 0)
            case "cone":
                return 2 / math.pi * depth * math.tan(math.radians(self.angle or 0))
            case _:
                return math.sqrt((self.radius or 0) * depth)

    @property
    def along(self) -> Vector:
        """Unit vector of its direction."""
        return unit_vector(self.direction)

    def resistance(self, modulus: float, extent: float) -> tuple[float, float]:
        """Return the stiffness that keeps the penetration small, and the width over which contact sets in.

        Of a body with modulus E/(1 − ν²) (Pa) and this extent (m) along the direction, by the formulas at the top.
        """
        size = self.model_copy(update={"depth": self._depth}).size
        match self.shape:
            case "plane":
                slope = modulus / extent
            case "flat":
                slope = PEAK * 2 / math.pi * modulus / size
            case "cone":
                slope = PEAK * modulus / (math.pi * size)
            case _:
                slope = ROUND * 2 / math.pi * modulus / size
        width = BORNE * extent if self.shape == "plane" and self.depth == 0 else SMOOTH * self.penetration * self._depth
        return MARGIN * slope / self.penetration, width

    @property
    def _depth(self) -> float:
        """The depth, or a small one in place of zero."""
        return self.depth or AT_REST * (self.radius or self.tip or 1e-3)

    def gap(self, ops: Any, x: Any, numbers: Mapping[str, Any], constant: Callable[[Any], Any] = np.asarray) -> Any:
        """Return the signed distance (m) from the tool to points, of which `x` lists the three coordinates.

        Parameters
        ----------
        ops
            Functions for numbers (`tools.NUMPY`) or forms.
        x
            Places of the deformed body (m).
        numbers
            Its numbers, by the names of `scalars`.
        constant
            Makes a constant of forms.
        """
        d = self.pointing(ops, numbers)
        apart = [x[i] - numbers[axis] for i, axis in enumerate("xyz")]
        t = tools.dot(apart, d) - numbers["depth"]
        if self.axis is not None:
            side = tools.cross(d, unit_vector(self.axis))
            across = tools.dot(apart, side) ** 2 / tools.dot(side, side)
        else:  # |a − (a·d) d|² as |a × d|², which loses no digits
            across = sum(part**2 for part in tools.cross(apart, d))
        sized = dict(numbers)  # in all that its shape needs
        if self.shape == "flat" and self.edge is None:
            sized["edge"] = SHARP * sized["radius"]
        if self.shape == "cone":
            sized["angle"] = sized["angle"] * (math.pi / 180)
            if self.tip is None:
                sized["tip"] = constant(SHARP * self._depth)
        return tools.distance(ops, self.shape, t, across, sized)

    def pointing(self, ops: Any, numbers: Mapping[str, Any]) -> tuple[Any, Any, Any]:
        """Unit vector of its direction, of numbers or forms."""
        x, y, z = (numbers[name] for name in POINTING)
        length = ops.sqrt(x**2 + y**2 + z**2)
        return x / length, y / length, z / length

    def gaps(self, points: FloatArray, **changed: float) -> FloatArray:
        """Return the signed distances (n,) of points (n, 3) (m), with its own numbers or with others."""
        numbers = {name: scalar.value for name, scalar in self.scalars.items()} | changed
        return np.asarray(self.gap(tools.NUMPY, list(points.T), numbers))

    def entered(self, body: Body, numbers: Mapping[str, float]) -> float:
        """How deep (m) the boundary of the body at rest is inside it, with these numbers."""
        d = np.array(self.pointing(tools.NUMPY, numbers))
        tip = np.array([numbers[axis] for axis in "xyz"])
        return -float(self.gaps(points(facets(body, self.on), tip, d), **numbers).min())

    def potential(self, at: Place) -> Any:
        """Potential ∫ φ(g(X + u)) dS of the gap g, over the undeformed boundary."""
        touch = self.touch(at, at.X + at.u)
        return tools.energy(at.ops, touch.gap, touch.stiffness, touch.width) * self.measure(at)

    def expected_gap(self, at: Place) -> Any:
        """Return the gap ĝ (m) to which the last step was to lead, to first order."""
        import ufl

        assert at.last is not None
        before = ufl.variable(at.X + at.last[0])
        gap = self.gap(at.ops, before, at.numbers, at.constant)
        return gap + ufl.dot(ufl.diff(gap, before), at.last[1])

    def expected(self, at: Place, direction: Any) -> tuple[Any, Any]:
        """Stiffness ∫ φ''(ĝ) (∇g·v)(∇g·w) dS and that of friction; work ∫ (φ'(ĝ) + φ''(ĝ)(g − ĝ) − φ'(g)) ∇g·v dS.

        ĝ = g, unless the body has left the tool.
        """
        import ufl

        x = ufl.variable(at.X + at.u)
        touch = self.touch(at, x)
        gap = touch.gap + at.left * (self.expected_gap(at) - touch.gap)
        here, there = (tools.pressure(at.ops, g, touch.stiffness, touch.width) for g in (touch.gap, gap))
        closed = touch.stiffness * tools.contact(at.ops, gap, touch.width)
        normal = ufl.diff(touch.gap, x)
        stiffness = closed * ufl.dot(normal, at.v) * ufl.dot(normal, direction) * self.measure(at)
        if self.friction:
            stiffness += self.rubbing_stiffness(at, direction, secant=True)
        beyond = here - there + closed * (touch.gap - gap)
        return stiffness, beyond * ufl.dot(normal, at.v) * self.measure(at)

    @property
    def symmetric(self) -> bool:
        """Whether it has no friction, which has no potential."""
        return not self.friction

    @property
    def edged(self) -> bool:
        """Whether it is no plane."""
        return self.shape != "plane"

    def rubbing(self, at: Place) -> Any | None:
        """Virtual work ∫ t·v dS of the tractions t of friction; None without friction."""
        if not self.friction:
            return None
        import ufl

        return ufl.dot(self.rub(at).traction, at.v) * self.measure(at)

    def rubbing_stiffness(self, at: Place, direction: Any, *, secant: bool = False) -> Any:
        """Stiffness of friction, at pressures and normals that stay.

        Tangent, or the secant t/slip, which is the larger one: far from equilibrium slip is far from what it will be.
        """
        import ufl

        rub = self.rub(at)
        v, w = rub.along(at.v), rub.along(direction)
        straight = ufl.dot(v, w) / rub.length
        if not secant:
            straight -= ufl.dot(rub.slip, v) * ufl.dot(rub.slip, w) / rub.length**3
        return rub.limit * straight * self.measure(at)

    def rub(self, at: Place) -> tools.Rub:
        """Return how the tool rubs on the body in this increment, in UFL.

        Pressures are those of its end, and slip is what the body has moved along the tool since the increment before,
        or since it touched the tool: an implicit Euler step. The width of the slip over which tractions grow is the
        penetration that is aimed at over the number of increments, so that all that sticks creeps by no more than such
        a penetration.
        """
        import ufl

        assert at.since is not None
        since, x = at.since, ufl.variable(at.X + at.u)
        touch = self.touch(at, x)
        slope = ufl.diff(touch.gap, x)
        size = ufl.sqrt(ufl.dot(slope, slope) + tools.TINY**2)
        normal = slope / size
        d = ufl.as_vector(self.pointing(at.ops, at.numbers))
        aside = ufl.as_vector([since.shift[i] for i in range(3)])
        moved = d * (since.share * at.numbers["depth"] + since.shift[3]) + aside
        # What was not in contact before has slid since it touched only, by linear interpolation of the gap.
        before = self.gap(at.ops, at.X + since.u + moved, at.numbers, at.constant)
        entered, left = (tools.pressure(at.ops, gap, 1.0, touch.width) for gap in (touch.gap, before))
        since_touched = entered / (entered + before + left + STARTED * touch.width)
        apart = since_touched * (at.u - since.u - moved)
        width = touch.width / (SMOOTH * since.count)
        limit = at.numbers["friction"] * tools.pressure(at.ops, *touch) * size
        return tools.Rub(limit, apart - ufl.dot(apart, normal) * normal, width, normal)

    def touch(self, at: Place, x: Any) -> tools.Touch:
        """Return how a place `x` of the deformed body is touched, in UFL."""
        stiffness, width = map(at.constant, self.resistance(at.modulus(), self.extent(at.bounds)))
        return tools.Touch(self.gap(at.ops, x, at.numbers, at.constant), at.stiffer * stiffness, width)

    def measure(self, at: Place) -> Any:
        """Measure of its boundary, fine enough for the pressure under it."""
        return at.on(self.on, self.degree)

    def extent(self, bounds: tuple[tuple[float, float], ...]) -> float:
        """Extent (m) along its direction of a body within bounds (m)."""
        return sum(abs(d) * (high - low) for d, (low, high) in zip(unit_vector(self.direction), bounds, strict=True))

    def mistakes(self, body: Body, *, alone: bool) -> Iterator[tuple[str, str, Any]]:
        """Find a tool that starts inside the body, or that never touches it."""
        tip, d = np.array(self.at), np.array(unit_vector(self.direction))
        extent = self.extent(body.bounds)
        if self.depth >= extent and self.shape != "plane":
            yield "depth", f"as deep as the body is thick there ({extent:.3g} m), expected less", self.depth
            return
        corners = facets(body, self.on)
        looked_at = points(corners, tip, d)
        inside = -float(self.gaps(looked_at, depth=0.0).min())
        if inside > max(SLACK * self.depth, tolerance(body) * SLACK):
            message = (
                f"the tool starts inside the body, {inside:.3g} m deep at '{self.on}', expected it to touch at most"
            )
            yield "at", message, list(self.at)
            return
        if _behind(body, tip, d, extent):
            message = f"the tool starts inside the body, which lies behind its tip at {listed(self.at)} m as it points"
            yield "direction", message, list(self.direction)
        elif alone and self.depth > 0:
            left = float(self.gaps(looked_at).min())
            if left > 0:
                yield "depth", f"the tool does not reach '{self.on}': at its depth, {left:.3g} m are left", self.depth

    def findings(self, body: Body) -> Iterator[Finding]:
        """Find a tool that touches too little of the mesh."""
        corners = facets(body, self.on)
        near = np.linalg.norm(corners.mean(axis=1) - np.array(self.at), axis=1).argmin()
        edge = float(edges(corners[[near]])[0])
        if 0 < self.size < edge:
            radius, cell = told(self.size, "m"), told(edge, "m")
            yield Finding(
                "tool-small", "warning", {"label": self.label, "boundary": self.on, "radius": radius, "cell": cell}
            )
        rim = self.edge or SHARP * (self.radius or 0)
        if self.shape == "flat" and rim < edge / ALONG:
            over, apart = told(rim, "m"), told(edge / ALONG, "m")
            yield Finding(
                "tool-edge", "warning", {"label": self.label, "over": over, "boundary": self.on, "apart": apart}
            )

    def findings_over(self, body: Body, ranges: Mapping[str, tuple[float, float]]) -> Iterator[Finding]:
        """Find samples, at the ends of ranges, in which it starts deep in the body, misses it or goes through it."""
        found: dict[str, tuple[float, str]] = {}
        for numbers, where in self.at_ends({name: ends for name, ends in ranges.items() if name != "friction"}):
            if not any(numbers[name] for name in POINTING):
                continue
            inside, left = self.entered(body, numbers | {"depth": 0.0}), -self.entered(body, numbers)
            tip, d = np.array([numbers[axis] for axis in "xyz"]), np.array(self.pointing(tools.NUMPY, numbers))
            extent = float(sum(abs(d) * [high - low for low, high in body.bounds]))
            far = numbers["depth"] - extent if self.shape != "plane" else 0.0
            away = extent if inside <= tolerance(body) and _behind(body, tip, d, extent) else 0.0
            for what, size, least in (
                ("starts {} inside the body, which counts as a deeper push", inside, self.depth),
                ("stays {} off the body, and its force is 0", left, 0.0),
                ("goes {} through the body, for which there is no answer", far, 0.0),
                ("points away from the body, in which it starts", away, 0.0),
            ):
                if size > max(least + tolerance(body), found.get(what, (0.0, ""))[0]):
                    found[what] = size, where
        for what, (size, where) in found.items():
            yield Finding(
                "tool-misses", "warning", {"label": self.label, "what": what.format(told(size, "m", 3)), "where": where}
            )

    def holds(self, body: Body) -> list[tuple[Vector, Vector]]:
        """Return where it holds the body along its direction: a plane all of its boundary, others at their tip."""
        places = body.corners_of(self.on) if self.shape == "plane" else [self.at]
        return [(place, unit_vector(self.direction)) for place in places]

    def words(self, numbers: Mapping[str, str]) -> str:
        shape = {"flat": "flat punch"}.get(self.shape, self.shape)
        sizes = ", ".join(f"{name} {numbers[name]}" for name in ("radius", "edge", "angle", "tip") if name in numbers)
        place = ", ".join(numbers[axis] for axis in "xyz")
        moved = f"moved by {numbers['depth']} along {listed(self.direction)} from ({place})"
        rubs = f"friction {numbers['friction']}" if self.friction else "without friction"
        return f"{self.label} on {self.on}: rigid {shape}{', ' + sizes if sizes else ''}; {moved}, {rubs}"

    @model_validator(mode="after")
    def _check(self) -> Indenter:
        problems = list(self._problems())
        if problems:
            raise ValueError("; ".join(problems))
        return self

    def _problems(self) -> Iterator[str]:
        needed, allowed = NEEDED[self.shape], ALLOWED.get(self.shape, ())
        for name in ("radius", "edge", "axis", "angle", "tip"):
            given = getattr(self, name) is not None
            if name in needed and not given:
                yield f"a tool with shape = '{self.shape}' needs {name}"
            if given and name not in (*needed, *allowed):
                yield f"a tool with shape = '{self.shape}' has no {name}"
        if self.increments is not None and not self.friction:
            yield "increments are there for friction, expected friction > 0 (or none of them)"
        if self.edge is not None and self.radius is not None and self.edge > self.radius:
            yield f"its edge is rounder ({self.edge:g} m) than the tool (radius {self.radius:g} m)"
        if self.axis is not None and np.linalg.norm(np.cross(self.axis, self.direction)) < 1e-9 * np.linalg.norm(
            self.axis
        ) * np.linalg.norm(self.direction):
            yield "the axis of a cylinder lies along its direction, expected one across it"


def _behind(body: Body, tip: FloatArray, d: FloatArray, extent: float) -> bool:
    """Whether the body lies behind the tip (m) of a tool that points along d."""
    behind = tip - np.outer([1e-3, 0.01, 0.05], extent * d)
    return bool((np.linalg.norm(body.nearest(behind) - behind, axis=1) < 1e-9 * extent).any())
