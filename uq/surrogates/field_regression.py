"""Regression of whole states: the coefficients of a field from sums over the samples, and predictions of states.

The regression is linear in the data, so the coefficients of a field need only Σ_z A_zᵀ y_z, one row for each function
of the largest basis that may be chosen. These rows are summed when blocks are added, from the d + 1 fields of each
sample in the blocks.

The functions for the field are chosen from the field, since no output need depend on the same parameters: one on a
plane of symmetry does not depend on what moves the body across it. Leave-one-out errors need every sample, and whole
fields are too large to keep. So a few sketches of each are kept, integrals of its displacements with random weights:
functions are fitted to these as to outputs, and the errors of the sketches estimate those of the field.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from forward.findings import Finding
from forward.model import FloatArray, ForwardModel, Guess, ReferenceSolution, Solution, SolveError, scattered
from forward.phases import phase
from uq.estimators.doubts import of_field, of_reach
from uq.estimators.estimate import Variables
from uq.estimators.indices import coefficient_moments, partial_variances, shares
from uq.evaluation.request import Evaluate, Evaluations, FieldSum, Request, on_group
from uq.inputs.random_parameters import Inputs
from uq.surrogates.basis import Basis, candidates_of, rows_of
from uq.surrogates.gate import Trial, repeated
from uq.surrogates.least_squares import NOTHING, ROUNDING, Data, Fit, fit_best
from uq.surrogates.linearisation import Linearisation
from uq.surrogates.regression import TRUSTED, Regression

FIELD_DICTIONARY = 500  # functions to select from, at most; each needs a field in memory
SKETCHES = 8  # of each sample's field
AS_GOOD = 1.5  # times the smallest leave-one-out error, up to which the field uses the functions of the outputs


@dataclass(frozen=True)
class Projections(FieldSum):
    """Sum over the samples of A_zᵀ y_z for the state's deviation y from the one at the mean, and of |y_z|².

    A compact sum: blocks hold y_z, the deviation and its slopes.

    Attributes
    ----------
    basis
        The P functions.
    state
        State (U,) at the mean parameters.
    gradients
        Whether derivatives are rows too.
    points, weights
        Points (n, d) whose weights (n,) are not one.
    displacements
        Number of displacements at the start of the state, of which sketches are kept; 0 for no sketches.
    volumes
        Share (nodes,) of the body that each node represents; by default all count equally.
    """

    compact = True
    basis: Basis
    state: FloatArray
    gradients: bool
    points: FloatArray | None
    weights: FloatArray | None
    displacements: int = 0
    volumes: FloatArray | None = None

    def on(self, model: ForwardModel) -> Callable[[Solution, FloatArray], FloatArray]:
        """Return the function (solution, parameters) → y_z of one group's model."""
        state = scattered(model, self.state[None, :])[0]

        def rows(solution: Solution, parameters: FloatArray) -> FloatArray:
            deviation: FloatArray = (solution.state - state)[None, :]
            if not self.gradients:
                return deviation
            directions = self.basis.coordinates.directions(parameters)
            return np.vstack([deviation, solution.state_tangent(directions)])

        return rows

    def total(self, points: FloatArray, rows: FloatArray) -> FloatArray:
        """Return Σ A_zᵀ y_z and Σ |y_z|² (P + 1, U) from the rows y_z (n, 1 + d, U) or (n, 1, U)."""
        left = self.basis.rows(points, gradients=self.gradients)
        weighted = rows
        if self.points is not None and self.weights is not None:
            which = [int(np.flatnonzero((self.points == point).all(axis=1))[0]) for point in points]
            weighted = self.weights[which][:, None, None] * rows
        total = np.empty((left.shape[2] + 1, rows.shape[2]))
        np.matmul(left.reshape(-1, left.shape[2]).T, weighted.reshape(-1, rows.shape[2]), out=total[:-1])
        np.einsum("zru,zru->u", rows, weighted, out=total[-1])
        return total

    def sketch(self, rows: FloatArray) -> FloatArray | None:
        """Return the integrals (n, r, k) of the displacements of rows (n, r, U) with normal weights.

        Their mean square is that of the displacements over the body (M. F. Hutchinson, Commun. Stat. Simul. Comput. 18
        (1989) 1059–1076).
        """
        count = self.displacements
        if not count:
            return None
        random = np.random.default_rng(0).standard_normal((count, SKETCHES))
        if self.volumes is not None:
            random *= np.sqrt(np.repeat(self.volumes, 3))[:, None]
        return np.asarray(rows[:, :, :count] @ random)


@dataclass(frozen=True)
class Deviations:
    """Expansion of the deviations of outputs and state from those at the mean parameters.

    Attributes
    ----------
    basis
        The P functions.
    outputs, state
        Coefficients (P, m) and (P, U); (P, 0) if the state was not requested.
    relative
        Leave-one-out errors (m,) of the outputs over their standard deviation.
    ok
        Which samples (n,) had an answer and were fitted.
    prediction
        Of the state, from which the solver may start; None if the state was not requested.
    rest
        Norms (m,) of what the functions miss in the outputs, see `Regression.missing`; None if no parameter has a tail.
    trial
        Fits to parts of the samples.
    repeats
        These in place of this one, of the outputs alone.
    """

    basis: Basis
    outputs: FloatArray
    state: FloatArray
    relative: FloatArray
    ok: NDArray[np.bool_]
    prediction: StateExpansion | None
    rest: FloatArray | None
    trial: Trial
    repeats: tuple[Deviations, ...] = ()

    def of(self, basis: Basis, coefficients: FloatArray, outputs: FloatArray) -> Deviations:
        """Return another fit (P, m) to some of the samples in place of this one, without a state."""
        coefficients = _deviating(basis, coefficients, outputs)
        return replace(self, basis=basis, outputs=coefficients, state=np.zeros((len(coefficients), 0)), prediction=None)


def fit_deviations(
    inputs: Inputs, evaluate: Evaluate, centre: Linearisation, points: FloatArray, max_order: int, *, fields: bool
) -> Deviations:
    """Fit an expansion to values and gradients at points (n, d), for the outputs and the whole state.

    Raises `SolveError` if the model has no answer at too many of the points for an expansion of order 1.
    """
    candidates = candidates_of(inputs, max_order, len(points) * rows_of(inputs, gradients=True), FIELD_DICTIONARY)
    wanted = Projections(candidates.basis, centre.state, True, None, None) if fields and centre.state.size else None
    evaluations = evaluate(Request(points, tangents=True, fields=wanted, start=centre.prediction))
    data = Data.of(evaluations, inputs, None)
    regression = Regression.fitted(inputs, candidates, data)
    return deviations(regression.higher() if wanted is None else regression, evaluations, centre)


def _deviating(basis: Basis, coefficients: FloatArray, outputs: FloatArray) -> FloatArray:
    """Coefficients (P, m) of deviations from outputs (m,)."""
    return coefficients - np.outer((basis.indices == 0).all(axis=1), outputs)


def deviations(regression: Regression, evaluations: Evaluations, centre: Linearisation) -> Deviations:
    """Return an expansion as one of deviations, with the state where `Projections` of it were summed."""
    fit, basis = regression.fit, regression.basis
    outputs = _deviating(basis, fit.coefficients, centre.outputs)
    state, prediction = np.zeros((len(outputs), 0)), None
    if evaluations.fields.size:
        state = solved(fit, evaluations.fields[fit.chosen.which])
        prediction = StateExpansion.fitted(basis, fit, evaluations.fields, centre)
    rest, trial = regression.missing(), repeated(regression)
    found = Deviations(basis, outputs, state, fit.relative, evaluations.ok, prediction, rest, trial)
    return replace(found, repeats=tuple(found.of(*one, centre.outputs) for one in trial.fits))


@dataclass(frozen=True)
class StateExpansion:
    """A prediction of the whole state by its expansion, with the factor at a point near all samples.

    Attributes
    ----------
    basis
        The P functions.
    coefficients
        (P, U), in canonical order.
    reference
        Where the factor is.
    """

    basis: Basis
    coefficients: FloatArray
    reference: ReferenceSolution

    @classmethod
    def fitted(cls, basis: Basis, fit: Fit, fields: FloatArray, centre: Linearisation) -> StateExpansion:
        """Solve the regression `fit` on the functions of `basis` for the state too, from the sums of `Projections`."""
        coefficients = solved(fit, fields[fit.chosen.which])
        coefficients[(basis.indices == 0).all(axis=1)] += centre.state
        return cls(basis, coefficients, centre.reference)

    def on(self, model: ForwardModel) -> Callable[[FloatArray], Guess]:
        """Return the function parameters (d,) → predicted state (U_local,) and its reference, for one group's model."""
        coefficients, reference = scattered(model, self.coefficients), on_group(model, self.reference)
        return lambda parameters: Guess(self.basis.at(parameters) @ coefficients, reference)


def solved(fit: Fit, projections: FloatArray) -> FloatArray:
    """Coefficients (P, U) of the regression from projections (P, U)."""
    from scipy.linalg import cho_solve

    return np.asarray(cho_solve((fit.triangle, False), projections))


# --- regression of the sketches of a field --------------------------------------------------------------------------


def regression_of_field(outputs: Regression, sketches: FloatArray) -> Regression:
    """Fit the sketches (n, r, k) of the samples of a regression of outputs, with its functions or better ones."""
    slopes = sketches[:, 1:] if sketches.shape[1] > 1 else None
    data = Data(outputs.data.points, sketches[:, 0], slopes, outputs.data.weights)
    fits: list[Regression] = []
    same = replace(outputs.fit.chosen, sparse=False)
    for sets in ((same,), outputs.candidates.sets):
        try:
            fit = fit_best(replace(outputs.candidates, sets=sets), data)
        except SolveError:
            continue  # not determined without some of the samples
        fits.append(replace(outputs, data=data, fit=fit))
    errors = [relative_of_field(fit) for fit in fits]
    return next(fit for fit, error in zip(fits, errors, strict=True) if error <= AS_GOOD * min(errors) + ROUNDING)


def errors_of_indices(regression: Regression) -> dict[str, FloatArray]:
    """Return standard errors (d,) of the generalised indices, from the jackknife and the residual variance.

    NaN if the fit explains nothing.
    """
    fit, largest = regression.fit, regression.candidates.basis.indices
    alone = np.eye(largest.shape[1], dtype=bool)

    def of(coefficients: FloatArray, indices: NDArray[np.int64]) -> FloatArray:
        variance, first, total = partial_variances((coefficients**2).sum(axis=-1), indices, alone)
        return np.stack([shares(part, variance[..., None]) for part in (first, total)])

    central = of(fit.coefficients, largest[fit.chosen.which])
    left_out = of(fit.without, largest)
    groups = len(fit.without)
    spread = np.sqrt((groups - 1) / groups * ((left_out - central[:, None]) ** 2).sum(axis=1))
    left = relative_of_field(regression)
    errors = np.hypot(spread, left**2) if left <= NOTHING else np.full_like(spread, np.nan)
    return dict(zip(("sobol_first", "sobol_total"), errors, strict=True))


def relative_of_field(regression: Regression) -> float:
    """Return the leave-one-out error of the field over its standard deviation, from all sketches together."""
    return float(np.sqrt(shares((regression.fit.loo**2).sum(), _variances(regression.fit).sum())))


def doubts_of_field(regression: Regression) -> Iterator[Finding]:
    """Find reasons to doubt the estimates of a field: what the fit leaves, and what it has where no samples are."""
    left, variances = relative_of_field(regression), _variances(regression.fit)
    yield from of_field(left, TRUSTED, NOTHING)
    reach = shares(variances @ regression.beyond().share, variances.sum())[None]
    within = np.array([left])
    yield from of_reach(["the displacement field"], reach, within, within, len(regression.data.points))


def _variances(fit: Fit) -> FloatArray:
    """Variances (k,) of the sketches."""
    return shares(fit.loo**2, fit.relative**2)


def among(terms: NDArray[np.int64], which: NDArray[np.int64], coefficients: FloatArray) -> FloatArray:
    """Return coefficients (P, m) of the functions `which` (P,) as those of `terms` (T,), with zeros for the others."""
    found = np.zeros((len(terms), coefficients.shape[1]))
    found[[int(np.flatnonzero(terms == term)[0]) for term in which]] = coefficients
    return found


@phase("evaluating polynomials of fields")
def estimates_of_field(
    evaluations: Evaluations,
    centre: Linearisation,
    count: int,
    regression: Regression,
    terms: NDArray[np.int64],
    outputs: Regression,
    estimates: dict[str, FloatArray],
) -> Variables:
    """Coefficients of the functions `terms` (T,), mean and standard deviation of the displacements, and their errors.

    Errors are those of the sketches and of the outputs, scaled by the residuals, which come from the same rows. The
    part of a variance s² that the fit misses (its residuals, increased by the ratio of unseen to seen residuals of the
    sketches) is an error of the standard deviation too, √(s² + missed) − s.
    """
    basis, fit = regression.basis, regression.fit
    projections = evaluations.fields[fit.chosen.which][:, :count]
    coefficients = solved(fit, projections)
    squares = np.maximum(evaluations.fields[-1, :count] - (coefficients * projections).sum(axis=0), 0.0)
    coefficients[(basis.indices == 0).all(axis=1)] += centre.state[:count]
    moments = coefficient_moments(coefficients.T, basis.indices)
    of_sketches = regression.estimates()
    fields = {name: moments[name].reshape(-1, 3) for name in ("mean", "std")}
    rows = regression.data.rows
    seen = float(shares((fit.loo**2).sum(), fit.squares.sum() / rows))
    left = max(1.0, seen) * squares / rows
    for name in ("mean", "std"):
        known = [(estimates, outputs.fit), (of_sketches, fit)]
        share = max(float(shares(of[f"{name}_error"] ** 2, by.squares).max()) for of, by in known)
        error = np.sqrt(share * squares)
        if name == "std":
            error = np.hypot(error, shares(left, moments["std"] + np.sqrt(moments["std"] ** 2 + left)))
        fields[f"{name}_error"] = error.reshape(-1, 3)
    by_node = [part.reshape(-1, 3).sum(axis=1) for part in (left, left + moments["std"] ** 2)]
    kept = among(terms, fit.chosen.which, coefficients).reshape(len(terms), -1, 3)
    of_indices = errors_of_indices(regression) if regression.inputs.independent else {}
    return {
        **{f"field_{name}": (("node", "component"), values) for name, values in fields.items()},
        "field_coefficients": (("term", "node", "component"), kept),
        "field_loo_error": ((), relative_of_field(regression)),
        "node_loo_error": (("node",), np.sqrt(shares(*by_node))),
        **{f"field_{name}_error": (("parameter",), errors) for name, errors in of_indices.items()},
    }
