"""What a body could have beside what a model says of it: other edges and shapes of its lumps, more lumps, and others.

An enlargement takes one of several forms, such as a lump at one of many places. Each form has a few patterns, of which
the strengths are standard normal beforehand: changes of ln of the stiffness at the vertices, or fibres.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations_with_replacement
from typing import Annotated, Any, NamedTuple

import numpy as np
from annotated_types import Unit
from pydantic import create_model

from forward.bodies.geometry import AXES, Body
from forward.bodies.inclusions import RADII, Ellipsoid, Sphere, log_factor
from forward.bodies.mesh import fan
from forward.bodies.random_fields import RandomField
from forward.bodies.surface import Surface, facets
from forward.model import FloatArray
from forward.readable import number, place, told
from forward.solid import Solid
from forward.specimen import Specimen
from forward.terms.term import Place, Term

# Standard deviations beforehand: of ln of an edge's width, of ln of the ratio of two radii over 2, of ln of stiffness.
EDGE, RATIO, STIFFNESS = np.log(2), 0.25, np.log(2)
STEP, TINY = 1e-4, 1e-6  # of these, by which they are changed for derivatives; of a field that is none
SIZES = (1.0, 0.6)  # of another lump, over that of the one that there is
SPACING = 0.6  # of its radius, between the places where it may be
ROUND = 0.5  # standard deviation of ln of its radius, where that is fitted
MOST, WIDER = 600, 1.1  # places of one size, and by what they are farther apart where there would be more
DEPTHS = (0.1, 0.2)  # of a layer, over the smallest extent of the body
LENGTH, MODES = 0.5, 16  # of a field: its correlation length over the smallest extent, and its modes
DIRECTIONS = 48  # of fibres
ASKED = "asked"  # name of what is added
PAIRS = list(combinations_with_replacement(range(3), 2))
QUARTICS = [f"{'x' * p}{'y' * q}{'z' * (4 - p - q)}" for p in range(5) for q in range(5 - p)]
"""Names of the 15 numbers that fibres are described by."""


class _Fibres(Term):
    """Fibres that carry tension and compression: ½ ∫ Σ_f k_f (a_f·E a_f)² dX, E = (C − I)/2.

    A fibre stretched by 1 + e has the tension k e to first order. All families together are the fourth-order tensor
    Σ k a⊗a⊗a⊗a, which is symmetric in all of its indices: its 15 components are the numbers of this load.
    """

    kind: str = "fibres"

    def potential(self, at: Place) -> Any:
        C = at.F.T * at.F
        # Components of E, those off the diagonal twice, with the two axes of each.
        strains = [(C[a, a] - 1) / 2 if a == b else C[a, b] for a, b in PAIRS]
        named = [[at.numbers["".join(sorted(AXES[i] for i in (*one, *other)))] for other in PAIRS] for one in PAIRS]
        stresses = [sum(k * e for k, e in zip(row, strains, strict=True)) for row in named]
        return sum(s * e for s, e in zip(stresses, strains, strict=True)) / 2 * at.dx


_NUMBERS: dict[str, Any] = {name: (Annotated[float, Unit("Pa")], 0.0) for name in QUARTICS}
Fibres: type[Term] = create_model("Fibres", __base__=_Fibres, **_NUMBERS)


def quartics(direction: FloatArray) -> FloatArray:
    """Return the numbers (15,) of fibres along a unit vector (3,), of modulus one."""
    return np.array([np.prod([direction[AXES.index(axis)] for axis in name]) for name in QUARTICS])


class Lump(NamedTuple):
    """Another lump: a form that can be moved. Its place, its radius, and the width of its edge (m)."""

    x: float
    y: float
    z: float
    radius: float
    width: float

    def __str__(self) -> str:
        """Say where it is."""
        return f"at {place(self[:3])}, radius {told(self.radius, 'm')}"

    def pattern(self, places: FloatArray) -> FloatArray:
        """Return what it adds to ln of the stiffness (N,) at places (N, 3)."""
        ball = Sphere(x=self.x, y=self.y, z=self.z, radius=self.radius, contrast=np.exp(STIFFNESS), width=self.width)
        return np.asarray(log_factor([ball], (), np.zeros((1, 0)), places)[0])


def fitted(
    spec: Solid, form: Any, strengths: FloatArray, places: FloatArray
) -> tuple[Lump, FloatArray, FloatArray] | None:
    """Return a lump as it is moved, its patterns (5, N + 15), and the means (5,) of their strengths beforehand.

    The first is the lump, of which the strength is known, others by how many deviations its place and radius change.
    These are normal beforehand, all over the body. None for what is no lump.

    Parameters
    ----------
    spec, places
        As of `enlargements`.
    form, strengths
        The lump, and the most probable strengths: of the lump alone (1,), or of all of these (5,).
    """
    if not isinstance(form, Lump):
        return None
    box = np.array(spec.body.bounds)
    widths = np.append(np.ptp(box, axis=1) / np.sqrt(12), ROUND)
    centre = np.append(box.mean(axis=1), np.log(max(_usual(spec.body, spec.inclusions))))
    here = np.array([*form[:3], np.log(form.radius)])
    if len(strengths) > 1:
        far = np.append(np.full(3, form.radius / 2), ROUND)
        here = here + np.clip(widths * strengths[1:], -far, far)
        here[:3] = np.clip(here[:3], *box.T)

    def at(numbers: FloatArray) -> Lump:
        x, y, z, log_radius = map(float, numbers)
        return Lump(x, y, z, float(np.exp(log_radius)), form.width)

    steps = STEP * np.diag(np.append(np.full(3, form.radius), 1.0))
    slopes = [(at(here + h).pattern(places) - at(here - h).pattern(places)) / (2 * h.sum()) for h in steps]
    moves = strengths[0] * widths[:, None] * slopes
    patterns = np.pad(np.vstack([at(here).pattern(places), moves]), ((0, 0), (0, len(QUARTICS))))
    return at(here), patterns, np.append(0.0, (centre - here) / widths)


def enlarged(spec: Any) -> tuple[Any, tuple[str, ...]]:
    """Return a body with a field of ln of its stiffness and with fibres, and the paths of what they depend on.

    Where all of these numbers are zero it is as it was.
    """
    field = RandomField(of="stiffness", name=ASKED, length=1.0, std=TINY, basis="nodes")
    fibres = Fibres(kind="fibres", name=ASKED)
    more: dict[str, Any] = {"fields": (*spec.fields, field)}
    if isinstance(spec, Specimen):
        more["cases"] = tuple(case.model_copy(update={"loads": (*case.loads, fibres)}) for case in spec.cases)
    else:
        more["loads"] = (*spec.loads, fibres)
    paths = (*field.paths(spec.body), *(f"loads.{ASKED}.{name}" for name in QUARTICS))
    return spec.model_copy(update=more), paths


def asked_of(spec: Any) -> tuple[str, ...]:
    """Return the names of the enlargements of a body."""
    shapes = [("edge", *(["shape"] if isinstance(one, Sphere) else [])) for one in spec.inclusions]
    own = [f"{what} of {one.label}" for one, each in zip(spec.inclusions, shapes, strict=True) for what in each]
    return (*own, "another lump" if own else "a lump", "a layer", "a field", "fibres")


def enlargements(
    spec: Solid, parameters: Sequence[str], point: FloatArray, places: FloatArray
) -> dict[str, dict[Any, FloatArray]]:
    """Return what a body with inclusions could have beside them, by names: its forms, which say what they are.

    Each is an array (k, N + 15) of its patterns: of ln of the stiffness at the vertices, and of fibres.

    Parameters
    ----------
    spec
        The body.
    parameters, point
        Paths of the parameters, and their values (d,), of which some may be numbers of the inclusions.
    places
        The vertices (N, 3) of the body, in canonical order (m).
    """
    body, now = spec.body, [_at(one, parameters, point) for one in spec.inclusions]
    found: list[dict[Any, FloatArray]] = []
    for one in now:
        found.append({"another width": _slope(one, {"width": EDGE}, places)[None]})
        if isinstance(one, Sphere):
            found.append({"an ellipsoid": np.array(list(_squeezed(one, places)))})
    found += [dict(_lumps(body, now, places)), dict(_layers(body, places)), {"all over the body": _field(body)}]
    whole = [{label: np.pad(rows, ((0, 0), (0, len(QUARTICS)))) for label, rows in forms.items()} for forms in found]
    none = np.zeros(len(places))
    modulus = STIFFNESS * spec.contact_modulus
    along = {_told(a): np.append(none, modulus * quartics(a))[None] for a in _directions()}
    return dict(zip(asked_of(spec), [*whole, along], strict=True))


def _extent(body: Body) -> float:
    return min(high - low for low, high in body.bounds)


def _at(one: Sphere | Ellipsoid, parameters: Sequence[str], point: FloatArray) -> Sphere | Ellipsoid:
    """Return an inclusion with its numbers at parameters (d,)."""
    path = f"inclusions.{one.label}."
    known = {name[len(path) :]: float(x) for name, x in zip(parameters, point, strict=True) if name.startswith(path)}
    return one.model_copy(update={"name": one.label, **known})


def _radius(one: Sphere | Ellipsoid) -> float:
    """Geometric mean of the radii (m)."""
    return float(np.prod([getattr(one, name) for name in RADII[one.kind]]) ** (1 / 3))


def _slope(one: Sphere | Ellipsoid, logs: Mapping[str, float], places: FloatArray) -> FloatArray:
    """Return the derivative (N,) of ln of the stiffness by the logarithms of numbers, of which each counts so much."""
    changed = [
        one.model_copy(update={name: getattr(one, name) * np.exp(sign * STEP * size) for name, size in logs.items()})
        for sign in (1, -1)
    ]
    ahead, back = (log_factor([other], (), np.zeros((1, 0)), places)[0] for other in changed)
    return np.asarray((ahead - back) / (2 * STEP))


def _squeezed(ball: Sphere, places: FloatArray) -> Iterator[FloatArray]:
    """Yield the changes (N,) to ellipsoids of the same volume: along two axes, and between the axes of each plane."""
    r, same = ball.radius, ball.model_dump(include={"x", "y", "z", "contrast", "width"})
    plain = Ellipsoid(a=r, b=r, c=r, **same)
    third = RATIO / np.sqrt(3)  # all five are equally large in the mean over directions
    yield _slope(plain, {"a": RATIO, "b": -RATIO}, places)
    yield _slope(plain, {"a": third, "b": third, "c": -2 * third}, places)
    for turn, grown, shrunk in (("turn_z", "a", "b"), ("turn_x", "b", "c"), ("turn_y", "c", "a")):
        turned = plain.model_copy(update={turn: np.pi / 4})
        yield _slope(turned, {grown: RATIO, shrunk: -RATIO}, places)


def _usual(body: Body, inclusions: Sequence[Sphere | Ellipsoid]) -> list[float]:
    """Radii (m) that lumps usually have: those of the inclusions, if there are any."""
    return [_radius(one) for one in inclusions] or [_extent(body) / 4]


def _lumps(
    body: Body, inclusions: Sequence[Sphere | Ellipsoid], places: FloatArray
) -> Iterator[tuple[Lump, FloatArray]]:
    """Yield lumps at places all over the body, as large as those that it has, or somewhat smaller."""
    cell, usual = body.longest_edge, _usual(body, inclusions)
    width = min([one.width for one in inclusions], default=usual[0] / 2)
    for radius in sorted({max(size * max(usual), cell) for size in SIZES}, reverse=True):
        spacing, centres = SPACING * radius, _lattice(body, places, SPACING * radius)
        while len(centres) > MOST:
            spacing *= WIDER
            centres = _lattice(body, places, spacing)
        same = np.zeros(len(centres), dtype=bool)
        for one in inclusions:
            same |= np.linalg.norm(centres - (one.x, one.y, one.z), axis=1) < _radius(one)
        for x, y, z in (centres if same.all() else centres[~same]).tolist():
            lump = Lump(x, y, z, radius, max(width, cell / 2))
            yield lump, lump.pattern(places)[None]


def _lattice(body: Body, places: FloatArray, spacing: float) -> FloatArray:
    """Return the points (n, 3) of a lattice in the box around a body that are no farther than a cell from a vertex."""
    from scipy.spatial import cKDTree

    steps = [np.linspace(low, high, 1 + int(np.ceil((high - low) / spacing))) for low, high in body.bounds]
    found = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(found[cKDTree(places).query(found)[0] <= body.longest_edge])


def _layers(body: Body, places: FloatArray) -> Iterator[tuple[str, FloatArray]]:
    depths = sorted({max(depth * _extent(body), body.longest_edge) for depth in DEPTHS})
    for name in body.boundaries:
        surface = Surface(fan(facets(body, name)))
        far = np.linalg.norm(surface.nearest(places)[0] - places, axis=1)
        for depth in depths:
            label = f"along {name}, {told(depth, 'm')} deep"
            yield label, STIFFNESS * (1 - np.tanh((far - depth) / (depth / 2)))[None] / 2


def _directions() -> FloatArray:
    """Return unit vectors (n, 3) that are spread evenly over half of the sphere, the axes first.

    Along a spiral (E. B. Saff, A. B. J. Kuijlaars, Math. Intelligencer 19 (1997) 5–11).
    """
    z = (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS
    angle, r = np.pi * (1 + np.sqrt(5)) * np.arange(DIRECTIONS), np.sqrt(1 - z**2)
    return np.concatenate([np.eye(3), np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)])


def _told(direction: FloatArray) -> str:
    return f"along ({', '.join(number(x, 2) for x in direction)})"


def _field(body: Body) -> FloatArray:
    """Return the modes (k, N) of a random field."""
    count = min(MODES, body.vertex_count)
    field = RandomField(of="stiffness", length=LENGTH * _extent(body), std=0.5, modes=count)
    modes = field.on(body).modes
    assert modes is not None
    return modes.T
