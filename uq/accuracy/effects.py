"""What the error of the mesh does to means, standard deviations, quantiles, indices, derivatives and fields.

The error e(ω) of an output ψ is known between its estimates (`uq.accuracy.mesh_errors`), and ψ by what the study has:
an expansion, samples, or tangents. Mean, standard deviation, quantiles and indices are found, at many points of the
distribution, of ψ and of ψ + e; they differ by the error of the estimate, exact minus computed: added, it corrects.

How they add up with errors of sampling is said in `uq.estimators.estimate`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from forward.findings import Finding
from forward.model import FloatArray
from uq.accuracy.consequences import ENOUGH, Consequence, consequences, has
from uq.accuracy.doubts import FEWEST_ANSWERS, OF_FACETS, Told, doubts, of_facets
from uq.accuracy.mesh_errors import Between, MeshErrors, best, between, covariances
from uq.estimators.estimate import OF_MESH, PARTS, Variables, holds, part, parts_of, with_mesh
from uq.estimators.moments import ESTIMATES
from uq.findings import add
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import even_points
from uq.surrogates.expansion import Expansion
from uq.surrogates.least_squares import NOTHING
from uq.surrogates.linearisation import Linearisation

if TYPE_CHECKING:
    import xarray as xr

POINTS = 4096  # at which surrogates are drawn
FURTHEST = 10.0  # standard deviation over that of what is drawn, at most, for their ratio to be that of their errors
ELSEWHERE, CHANGED = 0.15, 0.5  # doubt of what calibrates at the mean, at other parameters, and where errors vary
UNCALIBRATED = 0.5  # of an estimate whose doubt nobody says, relative to it: richer elements err too
WITHOUT = {  # variables whose error of the mesh is not estimated
    "active_direction": "the active subspace",
    "field_sobol_first": "the Sobol' indices of the displacement field",
}
DIRECTIONS = 12  # of what the estimates leave open, at most, along which its consequences are looked at


class Sketch(NamedTuple):
    """How outputs (n, m) depend on the parameters (n, d), at points that stand for their distribution."""

    points: FloatArray
    outputs: FloatArray


def sketch(dataset: xr.Dataset, inputs: Inputs, centre: Linearisation) -> Sketch:
    """Draw the expansion of a study, or take its samples, or draw the tangents at the mean.

    The tangents are drawn too of outputs that an expansion does not explain.
    """
    expanded = "multi_index" in dataset
    if not expanded and has(dataset, "values", "sample", "output") and has(dataset, "points", "sample", "parameter"):
        ok = dataset["ok"].to_numpy()
        if ok.sum() >= ENOUGH:
            return Sketch(dataset["points"].to_numpy()[ok], dataset["values"].to_numpy()[ok])
    points = inputs.points(even_points(POINTS, len(inputs.names)))
    tangents = centre.middle + centre.predicted(points)
    if not expanded:
        return Sketch(points, tangents)
    known = Expansion.of(dataset)
    explained = dataset["loo_error"].to_numpy() <= NOTHING if has(dataset, "loo_error", "output") else True
    return Sketch(points, np.where(explained, known.basis.values(points) @ known.coefficients, tangents))


def with_mesh_errors(
    dataset: xr.Dataset, inputs: Inputs, centre: Linearisation, found: MeshErrors, told: Told
) -> xr.Dataset:
    """Add to the results of a method what the error of the mesh does to them, and what is to be said of it.

    Parameters
    ----------
    dataset
        Results of any method on one mesh.
    centre
        The outputs at the mean parameters with their derivatives.
    found
        Estimates at some points.
    told
        What is known of the model, for what is said.
    """
    drawn = sketch(dataset, inputs, centre)
    every = {i: _Effect.of(inputs, centre, found, drawn, i) for i in range(found.outputs.shape[1])}
    effects = {i: one for i, one in every.items() if one is not None}
    unknown = unknown_of(found)
    variables = _of_outputs(dataset, inputs, centre, drawn, effects, unknown)
    variables |= {
        "mesh_error_points": (("estimate", "parameter"), found.evaluations.points),
        "mesh_error_values": (("estimate", "output"), found.evaluations.mesh_errors),
        "mesh_error_saturation": (("output",), found.saturation),
        "mesh_error_shift": (("output",), found.shifts),
        "mesh_error_unknown": (("output",), unknown),
        "mesh_error_facets": (("output",), found.hidden),
    }
    if found.fields is not None and len(found.points) >= FEWEST_ANSWERS:
        variables |= _of_fields(dataset, inputs, centre, drawn, found)
    dataset = dataset.assign(variables)
    add(dataset, *doubts(dataset, found.evaluations, told), first=True)
    if len(found.points):
        add(dataset, *of_facets(dataset["output"].to_numpy(), found.outputs[0], found.hidden), first=True)
    if found.unstable:
        add(dataset, Finding("unstable-on-finer-mesh", "error"), first=True)
    left_out = [words for name, words in WITHOUT.items() if name in dataset]
    if holds(dataset, "mean", "mesh") and left_out:
        add(dataset, Finding("mesh-error-left-out", "note", {"what": " and of ".join(left_out)}))
    if len(found.points) and not found.measured and np.isfinite(found.saturation).any():
        add(dataset, Finding("mesh-error-uncalibrated", "note", {"factor": np.nanmax(found.saturation)}))
    return dataset


def unknown_of(found: MeshErrors) -> FloatArray:
    """What is not known of each calibrated error (m,), relative to it."""
    usual = np.full(len(found.doubts), UNCALIBRATED)
    if not len(found.points):
        return usual
    at_mean = np.abs(found.errors[0])
    known = np.isfinite(found.doubts) & (at_mean > 0)
    share = np.divide(found.doubts, at_mean, out=usual, where=known)
    return np.hypot(share, np.hypot(ELSEWHERE, CHANGED * _spread(found))) if found.measured else share


def _spread(found: MeshErrors) -> FloatArray:
    """How far errors (m,) as they are seen, or their ratios to the outputs, vary: logarithms, 1 at most.

    Where they vary much, so may what part of the errors is seen.
    """
    seen = found.seen
    with np.errstate(divide="ignore", invalid="ignore"):
        both = [np.abs(np.log(of / of[0])) for of in (seen, seen / found.outputs)]  # not a number for other signs
    least = np.minimum(*(np.minimum(np.nan_to_num(size, nan=1.0, posinf=1.0), 1.0) for size in both))
    return np.asarray(np.sqrt((least[1:] ** 2).mean(axis=0))) if len(least) > 1 else np.zeros(seen.shape[1])


# --- outputs ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Effect:
    """The error of an output over the distribution."""

    way: Between  # how it depends on the parameters
    coefficients: FloatArray  # of that (q,)
    covariance: FloatArray  # of these (q, q)
    unseen: float  # missed at a point by the estimates at the others (root mean square), over the root of their number
    functions: FloatArray  # what the coefficients multiply at the points of the sketch (n, q)
    outputs: FloatArray  # the output there (n,)
    hidden: float  # by flat facets of a curved surface at the mean, at most
    share: float  # the same over the size of the output

    @classmethod
    def of(cls, inputs: Inputs, centre: Linearisation, found: MeshErrors, drawn: Sketch, output: int) -> _Effect | None:
        """Find it; None without two estimates."""
        errors = found.errors[:, output]
        if len(errors) < FEWEST_ANSWERS or not np.isfinite(errors).all():
            return None
        slopes = centre.output_slopes[[output]]
        ways = [between(inputs, slopes, found.points, found.outputs, follows) for follows in (None, output)]
        way = best(ways, errors[:, None])
        functions = way.functions(drawn.points, drawn.outputs)
        unseen = float(np.linalg.norm(way.unseen @ errors)) / len(errors)
        covariance = way.scale(errors) * way.covariance
        outputs, hidden = drawn.outputs[:, output], OF_FACETS * abs(float(np.nan_to_num(found.hidden[output])))
        size = max(abs(float(found.outputs[0, output])), float(outputs.std()))
        share = hidden / size if size else 0.0
        return cls(way, way.weights @ errors, covariance, unseen, functions, outputs, hidden, share)

    @property
    def errors(self) -> FloatArray:
        """At the points of the sketch (n,)."""
        return np.asarray(self.functions @ self.coefficients)

    @property
    def mean(self) -> tuple[float, float, float]:
        """Error of the mean, what its estimates leave open of it, and what facets hide."""
        means = self.functions.mean(axis=0)
        return float(means @ self.coefficients), max(self.left(means), self.unseen), self.hidden

    def std(self, known: float) -> tuple[float, float, float]:
        """The same of the standard deviation, which is known."""
        exact = self.outputs + self.errors
        before, after = float(self.outputs.std()), float(exact.std())
        share = known / before if known < FURTHEST * before else 1.0  # beyond, the sketch says nothing of the spread
        along = covariances(self.functions, exact[:, None])[:, 0] / after if after else np.zeros(len(self.coefficients))
        return share * (after - before), share * max(self.left(along), self.unseen), self.share * known

    def along(self, of: Callable[[FloatArray, int], FloatArray], i: int) -> tuple[FloatArray, FloatArray]:
        """Error of what follows from values of output i, (n, c) and i → (c, …), and what its estimates leave open.

        Open is how it changes along the principal directions of what is open of the coefficients.
        """
        sizes, directions = np.linalg.eigh(self.covariance)
        leading = np.argsort(-sizes)[:DIRECTIONS]
        kept = np.maximum(sizes[leading], 0.0)
        scale = np.sqrt(max(float(np.trace(self.covariance)) / float(kept.sum()), 1.0)) if kept.sum() > 0 else 0.0
        exact = self.outputs + self.errors
        others = exact[:, None] + self.functions @ (directions[:, leading] * np.sqrt(kept) * scale)
        before, after, *moved = of(np.column_stack([self.outputs, exact, others]), i)
        return after - before, np.sqrt(((np.array(moved) - after) ** 2).sum(axis=0))

    def left(self, weights: FloatArray) -> float:
        """Standard deviation of a sum of the coefficients with weights (q,)."""
        return float(np.sqrt(max(float(weights @ self.covariance @ weights), 0.0)))


def _of_outputs(
    dataset: xr.Dataset,
    inputs: Inputs,
    centre: Linearisation,
    drawn: Sketch,
    effects: Mapping[int, _Effect],
    unknown: FloatArray,
) -> Variables:
    """Errors of estimates of the outputs, by their numbers, given what is unknown of each (m,), relative to it."""
    variables = _at_centre(dataset, centre, effects, unknown)
    if not all(has(dataset, name, "output") for name in ESTIMATES):
        return variables
    for estimated in ("mean", "std"):
        error, rest, hidden = np.full((3, unknown.size), np.nan)
        for i, one in effects.items():
            error[i], rest[i], hidden[i] = one.mean if estimated == "mean" else one.std(float(dataset["std"][i]))
        variables |= _corrected(dataset, estimated, error, np.hypot(unknown * error, rest) + hidden, "total")
    for consequence in consequences(dataset, inputs, drawn.points):
        variables |= _of_consequence(dataset, consequence, effects, unknown)
    return variables


def _at_centre(
    dataset: xr.Dataset, centre: Linearisation, effects: Mapping[int, _Effect], unknown: FloatArray
) -> Variables:
    """Errors of outputs and of their derivatives at the mean parameters."""
    nominal, doubt = np.full((2, unknown.size), np.nan)
    slopes, open_slopes = np.full((2, *centre.tangents.shape), np.nan)
    for i, one in effects.items():
        at = one.way.functions(centre.point[None, :], centre.outputs[None, :])[0]
        nominal[i] = at @ one.coefficients
        doubt[i] = np.hypot(unknown[i] * nominal[i], max(one.left(at), one.unseen)) + one.hidden
        along = one.way.slopes(centre.point, centre.outputs, centre.tangents)
        slopes[i] = along @ one.coefficients
        open_slopes[i] = np.hypot(unknown[i] * slopes[i], [one.left(row) for row in along])
        open_slopes[i] += one.share * np.abs(centre.tangents[i])
    at_mean = with_mesh(centre.outputs, 0.0, nominal, doubt)
    variables = parts_of(at_mean, "nominal", ("output",), ("mesh", "doubt", "corrected"))
    if has(dataset, "derivative", "output", "parameter"):
        variables |= _corrected(dataset, "derivative", slopes, open_slopes)
    return variables


def _of_consequence(
    dataset: xr.Dataset, of: Consequence, effects: Mapping[int, _Effect], unknown: FloatArray
) -> Variables:
    """Errors of a variable that follows from the outputs over the distribution."""
    axis = dataset[of.name].dims.index("output")
    stated = np.moveaxis(dataset[of.name].to_numpy(), axis, 0)
    error, doubt = np.full((2, *stated.shape), np.nan)
    for i, one in effects.items():
        error[i], rest = one.along(of.of, i)
        std = float(one.outputs.std())
        missed = of.missed(stated[i], one.unseen / std if std else 0.0, std)
        doubt[i] = np.hypot(unknown[i] * error[i], np.maximum(rest, missed))
        if of.in_units:  # shares of a variance stay what they are if all values are so many times as large
            doubt[i] += np.maximum(one.hidden, one.share * np.abs(stated[i]))
    known = np.isfinite(stated)  # an expansion that explains nothing has no indices
    error, doubt = (np.moveaxis(np.where(known, values, np.nan), 0, axis) for values in (error, doubt))
    return _corrected(dataset, of.name, error, doubt)


def _corrected(dataset: xr.Dataset, name: str, error: FloatArray, doubt: FloatArray, *more: str) -> Variables:
    """Name errors of a variable, and its corrected values."""
    sampling = dataset[part(name, "error")].to_numpy() if holds(dataset, name, "error") else 0.0
    found = with_mesh(dataset[name].to_numpy(), sampling, error, doubt)
    which = [one for one in PARTS if one in (*OF_MESH, *more)]
    return parts_of(found, name, tuple(map(str, dataset[name].dims)), which)


# --- fields ----------------------------------------------------------------------------------------------------------


def _of_fields(
    dataset: xr.Dataset, inputs: Inputs, centre: Linearisation, drawn: Sketch, found: MeshErrors
) -> Variables:
    """Errors of the displacement field: at the mean parameters, of its mean and of its standard deviation.

    At any parameters they are a combination of those that were estimated, the same at all nodes.
    """
    assert found.fields is not None
    by_node, fields = ("node", "component"), found.fields
    followed = (None, *range(found.outputs.shape[1]))
    way = best([between(inputs, centre.output_slopes, found.points, found.outputs, i) for i in followed], fields)
    at_centre = way.functions(centre.point[None, :], centre.outputs[None, :])[0] @ way.weights
    variables: Variables = {part("field_nominal", "mesh"): (by_node, (at_centre @ fields).reshape(-1, 3))}
    if has(dataset, "field_derivative", "parameter", *by_node):
        along = way.slopes(centre.point, centre.outputs, centre.tangents) @ way.weights
        slopes = (along @ fields).reshape(dataset["field_derivative"].shape)
        variables[part("field_derivative", "mesh")] = (("parameter", *by_node), slopes)
    if not has(dataset, "field_mean", *by_node):
        return variables
    shares = way.functions(drawn.points, drawn.outputs) @ way.weights
    variables[part("field_mean", "mesh")] = (by_node, (shares.mean(axis=0) @ fields).reshape(-1, 3))
    shared = _with_displacements(dataset, centre, drawn, shares)
    if has(dataset, "field_std", *by_node) and shared is not None:
        std = dataset["field_std"].to_numpy().ravel()
        more = (fields * (2 * shared + covariances(shares, shares) @ fields)).sum(axis=0)
        moved = np.sqrt(np.maximum(std**2 + more, 0.0)) - std
        variables[part("field_std", "mesh")] = (by_node, moved.reshape(-1, 3))
    return variables


def _with_displacements(
    dataset: xr.Dataset, centre: Linearisation, drawn: Sketch, values: FloatArray
) -> FloatArray | None:
    """Return covariances (q, U) of functions (n, q) with the displacements, by their expansion or their derivatives."""
    if "field_coefficients" in dataset:
        basis = Expansion.of(dataset).basis
        coefficients = dataset["field_coefficients"].to_numpy().reshape(len(basis.indices), -1)
        return np.asarray(covariances(values, basis.values(drawn.points)) @ coefficients)
    if len(centre.slopes) == 0:
        return None
    count = dataset.sizes["node"] * 3
    return np.asarray(covariances(values, centre.coordinates.of(drawn.points)) @ centre.state_slopes[:, :count])
