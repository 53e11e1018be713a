"""What the error of the mesh does to means, standard deviations, quantiles, indices, derivatives and fields.

The error e(ω) of an output ψ is known between its estimates (`uq.accuracy.mesh_errors`), and ψ by what the study has:
an expansion, samples, or tangents. Mean, standard deviation, quantiles and indices are found, at many points of the
distribution, of ψ and of ψ + e; they differ by the error of the estimate, exact minus computed: added, it corrects.

How an error of an estimate adds up: with σ the standard error of sampling, e the error of the mesh and δ what is not
known of e, √(σ² + (|e| + δ)²) is the total error of the estimate as it stands, and √(σ² + δ²) that of the corrected
one. Like σ itself they are to be doubled for 95 %.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from forward.model import FloatArray
from uq.accuracy.doubts import doubts
from uq.accuracy.mesh_errors import Between, MeshErrors, best, between, covariances
from uq.estimators.indices import coefficient_moments
from uq.estimators.moments import ESTIMATES
from uq.findings import add
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.surrogates.basis import Basis, hyperbolic, orthonormal
from uq.surrogates.expansion import Expansion
from uq.surrogates.linearisation import Linearisation
from uq.surrogates.regression import NOTHING

if TYPE_CHECKING:
    import xarray as xr

Variables = dict[str, tuple[tuple[str, ...], Any]]
POINTS = 4096  # at which surrogates are drawn
FURTHEST = 10.0  # standard deviation over that of what is drawn, at most, for their ratio to be that of their errors
ENOUGH = 64  # samples that say by themselves how an output depends on the parameters
FEWEST_ANSWERS = 2  # of estimates: one alone does not say how far it is from others
DOUBT = 0.25  # of an estimate that is calibrated, relative to it
UNCALIBRATED = 0.5  # of one that is not, or by a typical factor: elements of one degree more err too
TERMS = 500  # of an expansion, at most, whose indices are looked at with and without the error
INDICES = ("sobol_first", "sobol_total")


class Sketch(NamedTuple):
    """How outputs (n, m) depend on the parameters (n, d), at points that stand for their distribution."""

    points: FloatArray
    outputs: FloatArray


def _has(dataset: xr.Dataset, name: str, *dims: str) -> bool:
    """Whether there is such a variable: methods from outside may give others, or none."""
    return name in dataset and dataset[name].dims == dims


def sketch(dataset: xr.Dataset, inputs: Inputs, centre: Linearisation) -> Sketch:
    """Draw the expansion of a study, or take its samples, or draw the tangents at the mean.

    The tangents are drawn too of outputs that an expansion does not explain.
    """
    expanded = "multi_index" in dataset
    if not expanded and _has(dataset, "values", "sample", "output") and _has(dataset, "points", "sample", "parameter"):
        ok = dataset["ok"].to_numpy()
        if ok.sum() >= ENOUGH:
            return Sketch(dataset["points"].to_numpy()[ok], dataset["values"].to_numpy()[ok])
    points = inputs.points(sobol_points(0, 0, 0, POINTS, len(inputs.names)))
    tangents = centre.middle + inputs.coordinates.of(points) @ centre.output_slopes.T
    if not expanded:
        return Sketch(points, tangents)
    known = Expansion.of(dataset)
    explained = dataset["loo_error"].to_numpy() <= NOTHING if _has(dataset, "loo_error", "output") else True
    return Sketch(points, np.where(explained, known.basis.values(points) @ known.coefficients, tangents))


def with_mesh_errors(
    dataset: xr.Dataset, inputs: Inputs, centre: Linearisation, found: MeshErrors, units: Mapping[str, str]
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
    units
        Of the outputs, for what is said.
    """
    drawn = sketch(dataset, inputs, centre)
    effects = [_Effect.of(inputs, centre, found, drawn, i) for i in range(found.outputs.shape[1])]
    unknown = np.where(np.isfinite(found.saturation) & found.measured, DOUBT, UNCALIBRATED)
    variables = _of_outputs(dataset, inputs, centre, drawn, effects, unknown)
    variables |= {
        "mesh_error_points": (("estimate", "parameter"), found.evaluations.points),
        "mesh_error_values": (("estimate", "output"), found.evaluations.mesh_errors),
        "mesh_error_saturation": (("output",), found.saturation),
    }
    if found.fields is not None and len(found.points) >= FEWEST_ANSWERS:
        variables |= _of_fields(dataset, inputs, centre, drawn, found)
    dataset = dataset.assign(variables)
    add(dataset, *doubts(dataset, found.evaluations, units))
    return dataset


# --- outputs ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Effect:
    """The error of an output over the distribution.

    Attributes
    ----------
    way
        How it depends on the parameters.
    coefficients, covariance
        Of that (q,), (q, q).
    unseen
        What is missed at a point by the estimates at the others (root mean square), over the root of their number.
    functions
        What these multiply at the points of the sketch (n, q).
    outputs
        The output there (n,).
    """

    way: Between
    coefficients: FloatArray
    covariance: FloatArray
    unseen: float
    functions: FloatArray
    outputs: FloatArray

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
        return cls(way, way.weights @ errors, covariance, unseen, functions, drawn.outputs[:, output])

    @property
    def errors(self) -> FloatArray:
        """At the points of the sketch (n,)."""
        return np.asarray(self.functions @ self.coefficients)

    @property
    def mean(self) -> tuple[float, float]:
        """Error of the mean, and what its estimates leave open of it."""
        means = self.functions.mean(axis=0)
        return float(means @ self.coefficients), max(self._left(means), self.unseen)

    def std(self, known: float) -> tuple[float, float]:
        """Error of the standard deviation, which is known, and what its estimates leave open of it."""
        exact = self.outputs + self.errors
        before, after = float(self.outputs.std()), float(exact.std())
        share = known / before if known < FURTHEST * before else 1.0  # beyond, the sketch says nothing of the spread
        along = covariances(self.functions, exact[:, None])[:, 0] / after if after else np.zeros(len(self.coefficients))
        return share * (after - before), share * max(self._left(along), self.unseen)

    def _left(self, weights: FloatArray) -> float:
        """Standard deviation of a sum of the coefficients with weights (q,)."""
        return float(np.sqrt(max(float(weights @ self.covariance @ weights), 0.0)))


def _of_outputs(
    dataset: xr.Dataset,
    inputs: Inputs,
    centre: Linearisation,
    drawn: Sketch,
    effects: Sequence[_Effect | None],
    unknown: FloatArray,
) -> Variables:
    """Errors of estimates of the outputs, given what is unknown of each estimate (m,), relative to it."""
    nothing = np.full(len(effects), np.nan)
    nominal, derivatives = nothing.copy(), np.full(centre.tangents.shape, np.nan)
    for i, one in enumerate(effects):
        if one is not None:
            nominal[i] = (one.way.functions(centre.point[None, :], centre.outputs[None, :]) @ one.coefficients)[0]
            derivatives[i] = one.way.slopes(centre.point, centre.outputs, centre.tangents) @ one.coefficients
    variables: Variables = {"nominal_mesh_error": (("output",), nominal)}
    if _has(dataset, "derivative", "output", "parameter"):
        variables["derivative_mesh_error"] = (("output", "parameter"), derivatives)
    if not all(_has(dataset, name, "output") for name in ESTIMATES):
        return variables
    for estimated, first in (("mean", ""), ("std", "std_")):
        error, rest = nothing.copy(), nothing.copy()
        for i, one in enumerate(effects):
            if one is not None:
                error[i], rest[i] = one.mean if estimated == "mean" else one.std(float(dataset["std"][i]))
        doubt, sampling = np.hypot(unknown * error, rest), dataset[f"{estimated}_error"].to_numpy()
        variables |= {
            f"{first}mesh_error": (("output",), error),
            f"{first}mesh_error_doubt": (("output",), doubt),
            f"{first}total_error": (("output",), np.hypot(sampling, np.abs(error) + doubt)),
            f"{estimated}_corrected": (("output",), dataset[estimated].to_numpy() + error),
            f"{estimated}_corrected_error": (("output",), np.hypot(sampling, doubt)),
        }
    if _has(dataset, "quantiles", "quantile", "output"):
        probabilities = dataset["quantile"].to_numpy()
        moved = np.full((len(probabilities), len(effects)), np.nan)
        for i, one in enumerate(effects):
            if one is not None:
                exact = one.outputs + one.errors
                moved[:, i] = np.quantile(exact, probabilities) - np.quantile(one.outputs, probabilities)
        variables["quantiles_mesh_error"] = (("quantile", "output"), moved)
    if all(_has(dataset, name, "output", "parameter") for name in INDICES) and inputs.independent:
        variables |= _indices(dataset, inputs, drawn, effects)
    return variables


def _indices(dataset: xr.Dataset, inputs: Inputs, drawn: Sketch, effects: Sequence[_Effect | None]) -> Variables:
    """Errors of Sobol' indices: of outputs with and without the error, in the polynomials that the study has."""
    basis = _polynomials(dataset, inputs)
    rows = basis.values(drawn.points)
    found = {name: np.full(dataset[name].shape, np.nan) for name in INDICES}
    for i, one in enumerate(effects):
        if one is None:
            continue
        both = np.column_stack([one.outputs, one.outputs + one.errors])
        of = coefficient_moments(np.linalg.lstsq(rows, both, rcond=None)[0].T, basis.indices)
        for name in INDICES:
            found[name][i] = of[name][1] - of[name][0]
    return {f"{name}_mesh_error": (("output", "parameter"), values) for name, values in found.items()}


def _polynomials(dataset: xr.Dataset, inputs: Inputs) -> Basis:
    """Those of an expansion, or as many of a low order as the points can tell."""
    if "multi_index" in dataset and dataset.sizes["term"] <= TERMS:
        return Expansion.of(dataset).basis
    d = len(inputs.names)
    order = next((order for order in (3, 2) if len(hyperbolic(d, order, 1.0)) <= ENOUGH // 2), 1) if d <= ENOUGH else 1
    return orthonormal(inputs, hyperbolic(d, order, 1.0))


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
    variables: Variables = {"field_nominal_mesh_error": (by_node, (at_centre @ fields).reshape(-1, 3))}
    if not _has(dataset, "field_mean", *by_node):
        return variables
    shares = way.functions(drawn.points, drawn.outputs) @ way.weights
    variables["field_mean_mesh_error"] = (by_node, (shares.mean(axis=0) @ fields).reshape(-1, 3))
    shared = _with_displacements(dataset, centre, drawn, shares)
    if _has(dataset, "field_std", *by_node) and shared is not None:
        std = dataset["field_std"].to_numpy().ravel()
        more = (fields * (2 * shared + covariances(shares, shares) @ fields)).sum(axis=0)
        moved = np.sqrt(np.maximum(std**2 + more, 0.0)) - std
        variables["field_std_mesh_error"] = (by_node, moved.reshape(-1, 3))
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
