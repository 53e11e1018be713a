"""What is shown of a body: its surface, quantities on it, what is inside and beside it, as data for viewer.js."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from forward.bodies.inclusions import INDICATORS, OPS
from forward.model import FloatArray
from forward.readable import spoken
from uq.estimators.estimate import estimate_of, holds
from workflows.report.scene.sliders import Packer, Sliders, sliders
from workflows.results.points import measured_points
from workflows.results.surfaces import IntArray, Skin, level, skin, split, surface, tetrahedra, tools_of

if TYPE_CHECKING:
    import xarray as xr


DERIVATIVES_SHOWN = 6  # parameters whose effect on the body is shown
MAPS_SHOWN = 6  # parameters whose indices are
CASES_SHOWN = 6  # load cases that have quantities of their own
FEWEST = 6  # measured points that make a map
NEAREST = 4  # of them that tell what is between
REACH = 1.5  # of the largest distance between neighbours: farther points have no value
SMALL = 20_000  # nodes of bodies that are sent whole, so that they can be cut
DRAWS_SHOWN = 6  # posterior draws of an inclusion
FINE, COARSE = 1e-6, 2e-5  # of an array's largest number: rounding, of small and large bodies
COLOURS = {"inside": "#d1622b", "truth": "#2f8f4e", "draw": "#8e5bb5", "tool": "#6b7480"}


class Quantity(NamedTuple):
    """Numbers (n,) at the nodes, by which a body is coloured; between `low` and `high`, if these are given."""

    name: str
    values: FloatArray
    unit: str = "1"
    colours: str = "viridis"
    low: float | None = None
    high: float | None = None
    still: bool = False
    names: Sequence[str] = ()
    std: bool = False


class Inside(NamedTuple):
    """A surface inside or beside the body: of nodes of its mesh, or at its own points (n, 3)."""

    name: str
    triangles: IntArray
    points: FloatArray | None
    kind: str
    opacity: float = 1.0
    shown: bool = True


@dataclass(frozen=True)
class Scene:
    """A body and what is to be seen of it.

    It has a mesh, points (n, 3) and cells (c, k) of a kind of VTK, a direction `up` (3,), and a motion: displacements
    (n, 3) of the nodes (m), zero if it is shown where it was, with a name in words. The first of the quantities is
    shown first, with surfaces `insides` and beside the body, arrows of residuals by name (places (p, 3), vectors (p, 3)
    in m, sizes (p,)), and sliders that move parameters. What is seen inside at first is a `cut`: "x", "y" or "z" for a
    plane, "v" where the first quantity is half of its range.
    """

    points: FloatArray
    cells: IntArray
    kind: int
    up: FloatArray
    motion: FloatArray
    quantities: Sequence[Quantity]
    insides: Sequence[Inside] = ()
    arrows: Mapping[str, tuple[FloatArray, FloatArray, FloatArray]] = field(default_factory=dict)
    sliders: Sliders | None = None
    motion_name: str = ""
    cut: str = ""

    @cached_property
    def skin(self) -> Skin:
        """Its surface."""
        return skin(self.points, self.cells, self.kind)


def forward_scene(dataset: xr.Dataset, study: Any = None, *, every: bool = False) -> Scene:
    """Return the scene of a body that was deformed by its loads; with `every` parameter, not only the strongest."""
    points, cells, kind = _mesh(dataset)
    mean = "field_mean" if "field_mean" in dataset else "field_nominal"
    insides = list(_regions(dataset, points, cells, kind))
    if study is not None and "parameter" in dataset.coords:  # inclusions where they were before the body moved
        names, means = [str(name) for name in dataset["parameter"].values], dataset["parameter_mean"].to_numpy()
        inclusions = [one for body in study.model.bodies for one in body.inclusions]
        insides += [Inside(one.label, *_ball(one, names, points, means), "inside") for one in inclusions]
    for tool in tools_of(dataset):
        at, triangles = surface(tool, points)
        insides.append(Inside(f"tool {tool.label}", triangles, at, "tool", 0.5))
    moving = None if study is None else sliders(dataset, study)
    name = "its mean displacement" if mean == "field_mean" else "the displacement at the mean parameters"
    body = points, cells, kind, up_of(dataset), dataset[mean].to_numpy(), list(_quantities(dataset, mean, every=every))
    return Scene(*body, insides, sliders=moving, motion_name=name)


def posterior_scene(one: xr.Dataset, study: Any) -> Scene:
    """Return the scene of a specimen that was inverted: its stiffness, inclusions, and measured points."""
    points, cells, kind = _mesh(one)
    inclusions = study.model.inclusions
    names = [str(name) for name in one["parameter"].values]
    insides = list(_regions(one, points, cells, kind))
    for inclusion in inclusions:
        ball = partial(_ball, inclusion, names, points)
        insides.append(Inside(f"{inclusion.label}, posterior mean", *ball(one["mean"].to_numpy()), "inside"))
        if np.isfinite(one["true"]).any():
            truth = one["true"].fillna(one["mean"]).to_numpy().astype(float)
            insides.append(Inside(f"{inclusion.label}, truth", *ball(truth), "truth", 0.45, shown=False))
        if "draw" in one:
            draws = one["draw"].to_numpy()
            each = [ball(draw) for draw in draws[:: max(1, len(draws) // DRAWS_SHOWN)][:DRAWS_SHOWN]]
            first = np.cumsum([0, *(len(at) for _, at in each[:-1])])
            triangles = np.concatenate([of + k for (of, _), k in zip(each, first, strict=True)])
            label, at = f"{inclusion.label}, {len(each)} posterior draws", np.concatenate([at for _, at in each])
            insides.append(Inside(label, triangles, at, "draw", 0.2, shown=False))
    shown = [*_stiffness(one), *_by_case(one, points, cells, kind)]
    arrows = {case.case: (case.places, case.residuals, case.over) for case in measured_points(one)}
    body = points, cells, kind, up_of(one), np.zeros_like(points)
    return Scene(*body, shown, insides, arrows, cut="" if inclusions or "stiffness_mean" not in one else "v")


def up_of(dataset: xr.Dataset) -> FloatArray:
    """Return the axis (3,) that points up: against gravity, otherwise z (y if the body is a sheet across z)."""
    points = dataset["node_position" if "node_position" in dataset else "mesh_vertex_position"].to_numpy()
    extents = np.ptp(points, axis=0)
    up: FloatArray = np.eye(3)[1 if extents[2] < extents[:2].min() / 4 else 2]
    model = tomllib.loads(dataset.attrs.get("config", "")).get("model", {})
    for down in (np.array(load["direction"]) for load in model.get("loads", ()) if load["kind"] == "gravity"):
        axis = int(np.argmax(np.abs(down)))
        up = -np.sign(down[axis]) * np.eye(3)[axis]
    return up


def _mesh(dataset: xr.Dataset) -> tuple[FloatArray, IntArray, int]:
    cells = dataset["cell_nodes"]
    return dataset["node_position"].to_numpy(), cells.to_numpy().astype(np.int64), int(cells.attrs["vtk_cell_type"])


def _size(values: Any) -> FloatArray:
    return np.asarray(np.linalg.norm(np.asarray(values), axis=-1))


def _quantities(of: xr.Dataset, mean: str, *, every: bool) -> Iterator[Quantity]:
    name = "Mean displacement" if mean == "field_mean" else "Displacement at the mean parameters"
    yield Quantity(name, _size(of[mean]), "m")
    if "field_std" in of:
        yield Quantity("Standard deviation of the displacement", _size(of["field_std"]), "m", "plasma", std=True)
    if "von_mises" in of:
        yield Quantity("Von Mises stress at the mean parameters", of["von_mises"].to_numpy(), "Pa", "plasma")
    found = estimate_of(of, mean)
    if holds(of, mean, "mesh"):
        yield Quantity("Error of the mesh in the displacement", _size(found.mesh), "m", "plasma")
    if holds(of, mean, "error"):
        yield Quantity("Sampling error of the mean displacement", _size(found.error), "m", "plasma")
    names = of["parameter"].to_numpy() if "parameter" in of.coords else np.zeros(0, dtype=str)
    if "field_derivative_rms" in of:
        effects = of["field_derivative_rms"] * of["parameter_std"]
        for parameter in names[np.argsort(-effects.to_numpy())][: None if every else DERIVATIVES_SHOWN]:
            std = float(of["parameter_std"].sel(parameter=parameter))
            values = of["field_derivative"].sel(parameter=parameter) * std
            yield Quantity(f"Displacement by one standard deviation of {parameter}, to first order", _size(values), "m")
    if "dominating" in of:
        for parameter in names[np.argsort(-of["field_sobol_total"].to_numpy())][: None if every else MAPS_SHOWN]:
            for which, word in (("total", "Total"), ("first", "First-order")):
                shares = of[f"node_sobol_{which}"].sel(parameter=parameter).to_numpy()
                label = f"{word} index of the displacement for {parameter}"
                yield Quantity(label, shares, colours="cividis", low=0.0, high=1.0)
        label = "The parameter with the largest total index"
        yield Quantity(label, of["dominating"].to_numpy().astype(float), names=[spoken(str(n)) for n in names])
    if "factor" in of:
        for which in of["random_field"].to_numpy():
            factors = of["factor"].sel(random_field=which).to_numpy()
            low, high = float(factors.min()), float(factors.max())
            for i, realisation in enumerate(factors):
                label = f"Realisation {i + 1} of the random factor '{which}'"
                yield Quantity(label, realisation, colours="cividis", low=low, high=high, still=True)


def _stiffness(one: xr.Dataset) -> Iterator[Quantity]:
    if "stiffness_mean" not in one:
        yield Quantity("The body", np.zeros(one.sizes["node"]))
        return
    mean, std, before, true = (one[f"stiffness_{which}"].to_numpy() for which in ("mean", "std", "prior_std", "true"))
    known = bool(np.isfinite(true).all())
    factors, truth = np.exp(mean), np.exp(true if known else mean)
    low, high = float(min(factors.min(), truth.min())), float(max(factors.max(), truth.max()))
    yield Quantity("Stiffness factor, posterior mean", factors, low=low, high=high)
    yield Quantity("± of ln stiffness, one posterior standard deviation", std, colours="plasma", low=0.0)
    share = std / np.maximum(before, 1e-300)
    yield Quantity("± after the data over ± before", share, colours="plasma", low=0.0, high=1.0)
    if known:
        yield Quantity("Stiffness factor, truth", truth, low=low, high=high)
        off = np.where(std > 0, (mean - true) / np.maximum(std, 1e-300), 0.0)
        label = "Mean minus truth over the posterior standard deviation"
        yield Quantity(label, off, colours="coolwarm", low=-3.0, high=3.0)


def _by_case(one: xr.Dataset, points: FloatArray, cells: IntArray, kind: int) -> Iterator[Quantity]:
    """What each load case says of a field, what was measured on the surface, and what the model misses of it."""
    cases = [str(case) for case in one.case.values][:CASES_SHOWN]
    if "alone_stiffness_std" in one:
        widest = float(one["alone_stiffness_std"].max())
        for case in cases:
            alone = one["alone_stiffness_std"].sel(case=case).to_numpy()
            yield Quantity(f"± of ln stiffness by {case} alone", alone, colours="plasma", low=0.0, high=widest)
    outer = np.unique(skin(points, cells, kind).nodes)
    for of_case in measured_points(one):
        if of_case.case in cases and len(of_case.places) >= FEWEST:
            values = np.full((2, len(points)), np.nan)
            values[:, outer] = spread_over(of_case.places, points[outer], _size(of_case.measured), of_case.over)
            yield Quantity(f"Measured displacement, {of_case.case}", values[0], "m")
            high = max(3.0, float(of_case.over.max()))
            label = f"Residuals over their errors, {of_case.case}"
            yield Quantity(label, values[1], colours="plasma", low=0.0, high=high)


def spread_over(places: FloatArray, at: FloatArray, *values: FloatArray) -> list[FloatArray]:
    """Return what values (p,) at places (p, 3) are at others (n, 3): the means of the nearest, by their distances.

    NaN farther from all places than these are from each other.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(places)
    apart = tree.query(places, k=2)[0][:, 1].max()
    distances, nearest = tree.query(at, k=min(NEAREST, len(places)))
    weights = 1 / np.maximum(distances, 1e-9 * max(apart, 1e-300)) ** 2
    weights /= weights.sum(axis=1, keepdims=True)
    far = distances[:, 0] > REACH * apart
    return [np.where(far, np.nan, (weights * of[nearest]).sum(axis=1)) for of in values]


def _regions(of: xr.Dataset, points: FloatArray, cells: IntArray, kind: int) -> Iterator[Inside]:
    """Regions that are not the whole body; the largest is what the others are in."""
    if "cell_region" not in of:
        return
    numbers = of["cell_region"].to_numpy()
    regions, counts = np.unique(numbers, return_counts=True)
    for k in np.delete(regions, counts.argmax()):
        name = str(of["region"].values[k]) if k >= 0 else "the rest"
        own = skin(points, cells[numbers == k], kind)
        yield Inside(f"region {name}", own.nodes[own.triangles], None, "inside")


def _ball(inclusion: Any, names: Sequence[str], body: FloatArray, values: FloatArray) -> tuple[IntArray, FloatArray]:
    """Triangles and points of where an indicator is ½, in a body with nodes (n, 3), by values of what is not known."""
    of = dict(zip(names, values.tolist(), strict=True))
    own = inclusion.model_dump(exclude={"kind", "name", "contrast"})
    numbers = {key: of.get(f"inclusions.{inclusion.label}.{key}", value) for key, value in own.items()}
    radii = [numbers[r] for r in ("radius",) if r in numbers] or [numbers[r] for r in "abc"]
    centre, reach = np.array([numbers[axis] for axis in "xyz"]), 1.15 * max(radii)
    low = np.maximum(centre - reach, body.min(axis=0) - 0.1 * reach)
    high = np.minimum(centre + reach, body.max(axis=0) + 0.1 * reach)
    if (low >= high).any():
        return np.zeros((0, 3), dtype=np.int64), np.zeros((0, 3))
    indicator = INDICATORS[inclusion.kind]
    at, triangles = level(lambda x: 0.5 - indicator(OPS, x.T, **numbers), low, high, 20)
    return triangles, at


def ends(quantity: Quantity) -> tuple[float, float]:
    """Return the numbers at both ends of the colours of a quantity; lengths begin with zero."""
    finite = quantity.values[np.isfinite(quantity.values)]
    low, high = quantity.low, quantity.high
    if low is None:
        low = 0.0 if quantity.unit == "m" else float(finite.min(initial=np.inf))
    high = float(finite.max(initial=-np.inf)) if high is None else high
    return low, high if high > low else low + 1.0


def packed(scene: Scene) -> tuple[str, str]:
    """Return what viewer.js reads: a description as JSON, and the arrays as one text."""
    pack, whole, surface = Packer(), len(scene.points) <= SMALL, scene.skin
    kept = np.arange(len(scene.points))
    if not whole:
        inner = (inside.triangles.ravel() for inside in scene.insides if inside.points is None)
        kept = np.unique(np.concatenate([surface.nodes, *inner]))
    number = np.full(len(scene.points), -1)
    number[kept] = np.arange(len(kept))
    fine = FINE if len(kept) <= SMALL else COARSE
    extent = float(np.ptp(scene.points, axis=0).max())
    near = 1e-5 * extent  # places are rounded to this (m)
    told: dict[str, Any] = {
        "up": scene.up.tolist(),
        "extent": extent,
        "cut": scene.cut if whole else "",
        "points": pack.add(scene.points[kept], fine * extent),
        "skin": {"triangles": pack.add(surface.triangles), "nodes": pack.add(number[surface.nodes])},
        "edges": pack.add(number[surface.edges]) if len(surface.edges) else None,
        "cells": pack.add(number[tetrahedra(scene.cells, scene.kind)]) if whole else None,
        "motion": pack.field(scene.motion[kept], fine) if scene.motion.any() else None,
        "quantities": [],
        "insides": [],
        "arrows": [],
    }
    for q in (one for one in scene.quantities if np.isfinite(one.values).any()):
        low, high = ends(q)
        values = pack.add(q.values[kept]) if q.names else pack.field(q.values[kept], max(fine, 1e-5))
        told["quantities"].append(q._asdict() | {"low": low, "high": high, "names": list(q.names), "values": values})
    for inside in (one for one in scene.insides if len(one.triangles)):
        mine = split(scene.points if inside.points is None else inside.points, inside.triangles)
        entry = {"name": inside.name, "colour": COLOURS[inside.kind], "opacity": inside.opacity, "shown": inside.shown}
        entry |= {"outside": inside.kind == "tool", "triangles": pack.add(mine.triangles)}
        own = inside.points
        entry |= {"nodes": pack.add(number[mine.nodes])} if own is None else {"points": pack.add(own[mine.nodes], near)}
        told["insides"].append(entry)
    for name, (places, vectors, sizes) in scene.arrows.items():
        numbers = {"places": pack.add(places, near), "vectors": pack.field(vectors, 1e-5)}
        told["arrows"].append({"name": name, **numbers, "sizes": pack.field(sizes, 1e-4)})
    if scene.sliders is not None:
        told["sliders"] = scene.sliders.packed(pack, kept)
    told["arrays"] = pack.told
    # A "<" could end the script that holds it.
    return json.dumps(told, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"), pack.text()
