"""Global sensitivity from derivatives: bounds on total Sobol' indices and the active subspace, from the same tangents.

With ν_i = E[(∂ψ/∂ω_i)²], the derivative-based measure of a parameter, and the Poincaré constant C_i of its
distribution, the smallest with Var g(ω_i) ≤ C_i E[g'(ω_i)²] for every g, the total index is at most

    S_Ti ≤ C_i ν_i / Var ψ

(I. M. Sobol', S. Kucherenko, Math. Comput. Simul. 79 (2009) 3009–3017; M. Lamboni, B. Iooss, A.-L. Popelin, F. Gamboa,
Math. Comput. Simul. 87 (2013) 45–54). C is σ² for a normal and (b − a)²/π² for a uniform distribution. For a gamma
distribution of shape k and scale θ it is θ²(k + 1)²/k where k > 1 (g = (1 − x/(k + 1)) exp(x/(k + 1)) with x = ω/θ
attains it) and 4θ² otherwise.

The same holds for ln ω with its own constant, S_Ti ≤ C_i' E[(ω_i ∂ψ/∂ω_i)²]/Var ψ: s² for a log-normal parameter
whose logarithm has the standard deviation s (it has no C itself); ln²(b/a)/π² for a log-uniform one; 1/(k − 1) for a
gamma distribution with k > 2 (g = 1/ω attains it). Where polynomials are in the logarithm (`uq.inputs.coordinates`),
both bounds are computed and the smaller one is taken.

The active subspace (P. G. Constantine, Active Subspaces, SIAM (2015)) are the leading eigenvectors of E[∇ψ∇ψᵀ] in
standardised coordinates (`uq.inputs.coordinates`): the directions along which ψ changes most.

Points are independent scrambles of Sobol' points, and errors come from resampling whole scrambles
(`uq.estimators.indices`).
"""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Annotated, Literal, assert_never

import numpy as np
from pydantic import Field

from forward.model import FloatArray, ModelError, SolveError
from uq.estimators.doubts import of_indices, of_tails
from uq.estimators.estimate import of_samples
from uq.estimators.indices import bootstrap, bootstrap_error, shares
from uq.estimators.moments import Estimates, estimate_from_replicates, running
from uq.estimators.quantiles import quantiles_from_replicates
from uq.estimators.tails import counted
from uq.evaluation.evaluate import Recorder
from uq.evaluation.request import Evaluate, Request
from uq.findings import add
from uq.inputs.distributions import Distribution, Gamma, LogNormal, LogUniform, Normal, Uniform
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import check_scrambles, in_order, power_of_two
from uq.inputs.univariate import Bounded, Chaospy
from uq.methods.method import Amount, Probability, refuse
from uq.methods.monte_carlo import FIRST_ROUND, UNLIMITED, failure_note
from uq.methods.scrambles import Sets
from uq.methods.sobol_rows import by_output
from uq.surrogates.basis import FULL, gauss, hyperbolic, orthonormal
from uq.surrogates.linearisation import Linearisation, linearise, local_dataset
from uq.surrogates.regression import Regression

if TYPE_CHECKING:
    import xarray as xr

SETTLED = 1e-5  # relative change of a Poincaré constant, when the degree is doubled, at which it counts as known
DEGREES = (8, 16, 32, 64)
GROWS = 1.01  # of min(F, 1 − F)/p from a probability of 1e-3 to one of 1e-8: it grows without limit
ORDER = 6  # largest order of the expansion for total indices
RANGE = (0.025, 0.975)


class DerivativeBased(Amount):
    """Derivative-based sensitivity: bounds on total Sobol' indices and the active subspace, from tangents.

    Parameters
    ----------
    samples
        Number of solves, `scrambles` times a power of two; with a tolerance or a budget, the largest number.
    tolerance
        Stop when the standard error of every bound is below it.
    budget_seconds
        As in `Amount`.
    scrambles
        Number of independent scrambles, whose scatter gives the error. Means over scrambles of squared derivatives are
        skewed: of 256 solves of a function of a normal and a uniform parameter, 95 % intervals covered 90 to 91 % with
        16 scrambles, 92 to 94 % with 32 and 94 % with 64, while the standard error was right.
    seed
        Point z of scramble r of a seed is the same in every study with as many parameters.
    quantiles
        Probabilities of the quantiles of the outputs.
    fields
        Whether the derivatives of the displacement field at the mean parameters are kept.
    indices
        Whether total indices are estimated too, from an expansion of the same samples; by default, with up to 8
        parameters.
    """

    kind: Literal["derivative-based"] = "derivative-based"
    scrambles: Annotated[int, Field(ge=4)] = 32
    seed: Annotated[int, Field(ge=0)] = 0
    quantiles: tuple[Probability, ...] = (0.05, 0.5, 0.95)
    fields: bool = True
    indices: bool | None = None

    def check_amount(self) -> None:
        """Raise a ValueError if no amount is given, or not one of whole scrambles."""
        super().check_amount()
        check_scrambles(self.samples, self.scrambles)

    def planned(self, dimension: int) -> int:
        return 1 + (self.samples or self.scrambles * power_of_two(UNLIMITED // self.scrambles))

    def with_tangents(self, samples: int) -> int:
        return samples

    def objection(self, inputs: Inputs) -> str | None:
        if inputs.draws is not None:
            return "draws have no densities, which bounds on Sobol' indices need, expected method.kind = 'chaos'"
        if not inputs.independent:
            return (
                "bounds on Sobol' indices need independent parameters, expected no correlations for "
                "method.kind = 'derivative-based'"
            )
        return None

    def run(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        """Solve at Sobol' points with tangents, and estimate.

        Returns
        -------
        xarray.Dataset
            Measures, bounds, and the active subspace by output with standard errors; total indices from an expansion
            fitted to the same samples; moments; see docs/results.md.
        """
        refuse(self.objection(inputs))
        if not evaluate.differentiable:
            raise ModelError("the model has no derivatives, expected one that has for method.kind = 'derivative-based'")
        evaluate = Recorder(evaluate)
        centre = linearise(inputs, evaluate)
        R = self.scrambles
        last = (self.planned(len(inputs.names)) - 1) // R
        samples = _Samples(self, inputs, evaluate, centre)
        samples.extend(min(last, power_of_two(FIRST_ROUND // R)) if self.open_ended else last)
        while True:
            found = samples.measures()
            reached = float(found["total_bound_error"].max())
            more = R * samples.each
            if self.met(reached) or samples.each >= last or more > self.affordable(evaluate.solves, evaluate.seconds):
                break
            samples.extend(2 * samples.each)
        dataset = samples.dataset(found)
        amount = f"{R * samples.each} samples ({R} scrambles of {samples.each} Sobol' points)"
        error = f"errors of the bounds up to {reached:.2g}"
        dataset.attrs["stopped"] = self.why_stopped(reached, error, samples.each, last, amount)
        return dataset


# --- Poincaré constants --------------------------------------------------------------------------------------------


def poincare(marginal: Distribution, *, logarithm: bool) -> float:
    """Return the Poincaré constant of a distribution in the square of its unit, or of its logarithm; inf for none.

    Where there is no closed form it is 1/λ with the smallest positive eigenvalue of −(p f')' = λ p f with f' = 0 at the
    ends (O. Roustant, F. Barthe, B. Iooss, Electron. J. Stat. 11 (2017) 3081–3119), by Galerkin's method in the
    orthonormal polynomials of the distribution, whose mass matrix is the identity. If that does not converge, Cheeger's
    upper bound 4 sup (min(F, 1 − F)/p)² is taken (S. Bobkov, C. Houdré, Ann. Probab. 25 (1997) 184–205).
    """
    if logarithm and not marginal.logarithmic:
        return np.inf
    match marginal:
        case Normal():
            return float(marginal.std**2)
        case LogNormal():
            return float(marginal.of_coordinate[1] ** 2) if logarithm else np.inf
        case Uniform() if not logarithm:
            return float(((marginal.upper - marginal.lower) / np.pi) ** 2)
        case LogUniform() if logarithm:
            return float((np.log(marginal.upper / marginal.lower) / np.pi) ** 2)
        case Gamma():
            k, theta = marginal.shape, marginal.scale
            if logarithm:
                return 1 / (k - 1)  # k > 2
            return float(theta**2 * ((k + 1) ** 2 / k if k > 1 else 4))
        case Bounded():
            return _by_galerkin(marginal, logarithm=logarithm)
        case Chaospy():
            return _by_galerkin(marginal, logarithm=logarithm) if logarithm or not _heavy(marginal) else np.inf
        case _:
            assert_never(marginal)


def _heavy(marginal: Distribution) -> bool:
    """Whether a tail falls more slowly than an exponential function: then min(F, 1 − F)/p grows without limit in it."""
    p: FloatArray = np.array([1e-3, 1e-8])
    ends = (p / marginal.density(marginal.quantile(far)) for far in (p, np.asarray(1 - p)))
    return any(beyond > GROWS * near for near, beyond in ends)


def _by_galerkin(marginal: Distribution, *, logarithm: bool) -> float:
    before = np.inf
    for degree in DEGREES:
        constant = _by_polynomials(marginal, degree, logarithm=logarithm)
        if abs(constant - before) <= SETTLED * constant:
            return constant
        before = constant
    p = np.concatenate([np.geomspace(1e-12, 0.5, 2000), 1 - np.geomspace(0.5, 1e-12, 2000)])
    values = marginal.quantile(p)
    density = marginal.density(values) * (values if logarithm else 1.0)
    return float(4 * (np.minimum(p, 1 - p)[density > 0] / density[density > 0]).max() ** 2)


def _by_polynomials(marginal: Distribution, degree: int, *, logarithm: bool) -> float:
    """Largest ratio of Var f and E[f'²] over polynomials f of a degree in the coordinate, by ω or by ln ω."""
    alone = Inputs({"": marginal})
    if marginal.closed:
        points, weights = gauss(alone, degree + 1)
    else:
        origin, offsets, weights = marginal.rule
        points = (origin + offsets)[:, None]
    basis = orthonormal(alone, hyperbolic(1, degree, 1.0))
    slopes = basis.derivatives(points)[:, 0, 1:] / basis.coordinates.steps(points)
    if logarithm:
        slopes = slopes * points
    stiffness = slopes.T @ (weights[:, None] * slopes)
    return float(1 / np.linalg.eigvalsh(stiffness)[0])


# --- estimates -----------------------------------------------------------------------------------------------------


class _Samples(Sets):
    """Scrambles with values and tangents."""

    def __init__(self, method: DerivativeBased, inputs: Inputs, evaluate: Evaluate, centre: Linearisation) -> None:
        asked = Request(np.empty((0, len(inputs.names))), tangents=True, start=centre.prediction)
        super().__init__(inputs, evaluate, asked, method.seed, method.scrambles)
        self._method, self._centre = method, centre
        # By ω and by ln ω (2, d).
        self._constants = np.array(
            [[poincare(m, logarithm=logarithm) for m in inputs.marginals.values()] for logarithm in (False, True)]
        )

    def _sums(self, each: int) -> tuple[FloatArray, FloatArray]:
        """Sums (R', J, m) of what is averaged, over the scrambles that have answers, and their numbers (R',)."""
        self.check(each)
        ok = self.ok[:, :each]
        some = ok.any(axis=1)
        ok, points = ok[some], self.points[some, :each]
        tangents = np.where(ok[..., None, None], self.tangents[some, :each], 0.0)
        scaled = tangents * self._centre.coordinates.steps(points)[:, :, None, :]
        d = scaled.shape[-1]
        first, second = (np.where(ok[..., None], one[some], 0.0) for one in self._controlled(each))
        parts = [
            first[..., None],
            second[..., None],
            tangents**2,
            (tangents * points[:, :, None, :]) ** 2,
            (scaled[..., :, None] * scaled[..., None, :]).reshape(*first.shape, d * d),
        ]
        return np.swapaxes(np.concatenate(parts, axis=-1).sum(axis=1), 1, 2), ok.sum(axis=1).astype(float)

    def _controlled(self, each: int) -> tuple[FloatArray, FloatArray]:
        """Samples (R, n, m) of the first two moments of deviations; of those without an answer anything.

        The tangent at the mean parameters is a control variate of both, as in `uq.estimators.moments`.
        """
        centre = self._centre
        deviation = self.outputs[:, :each] - centre.middle
        if not self.ok[:, :each].all():
            return deviation, deviation**2
        prediction = centre.predicted(self.points[:, :each])
        return deviation - prediction, deviation**2 - prediction**2 + (centre.output_slopes**2).sum(axis=1)

    def _from_means(self, means: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Measures and bounds (…, m, d) and matrices (…, m, d, d) from means (J, …, m)."""
        d = self._constants.shape[1]
        rows = np.moveaxis(means, 0, -1)
        variance = rows[..., 1] - rows[..., 0] ** 2
        measures, known = rows[..., 2 : 2 + 2 * d].reshape(*variance.shape, 2, d), np.isfinite(self._constants)
        bounds = np.where(known, np.where(known, self._constants, 0.0) * measures, np.inf).min(axis=-2)
        matrices = rows[..., 2 + 2 * d :].reshape(*variance.shape, d, d)
        return measures[..., 0, :], shares(bounds, variance[..., None]), matrices

    def measures(self) -> dict[str, FloatArray]:
        """Measures, bounds and the active subspace by output, with errors."""
        sums, counts = self._sums(self.each)
        R = len(counts)
        dgsm, bounds, matrix = self._from_means(sums.sum(axis=0) / counts.sum())
        drawn = self._from_means(bootstrap(sums, counts, self._method.seed))
        values, directions = _descending(matrix)
        leading = directions[..., 0]
        largest = np.take_along_axis(leading, np.abs(leading).argmax(axis=-1)[..., None], axis=-1)
        leading = leading * np.where(largest < 0, -1.0, 1.0)  # so that the largest component is positive
        drawn_values, drawn_directions = _descending(drawn[2])
        turned = drawn_directions[..., 0]
        turned = turned * np.where((turned * leading).sum(axis=-1, keepdims=True) < 0, -1.0, 1.0)
        lower, upper = np.quantile(drawn_values, RANGE, axis=0)
        return {
            "dgsm": dgsm,
            "dgsm_error": bootstrap_error(drawn[0], R, axis=0),
            "total_bound": bounds,
            "total_bound_error": bootstrap_error(drawn[1], R, axis=0),
            "active_direction": leading,
            "active_direction_error": bootstrap_error(turned, R, axis=0),
            "active_eigenvalue": values,
            "active_eigenvalue_lower": lower,
            "active_eigenvalue_upper": upper,
        }

    def _moments(self, each: int) -> Estimates:
        sums, counts = self._sums(each)
        means = sums / counts[:, None, None]
        found = estimate_from_replicates(np.array([means[:, 0], means[:, 1]]), self._centre.middle)
        ok = self.ok[:, :each]
        first, second = (one[ok] for one in self._controlled(each))
        return counted(found, self._inputs, self.outputs[:, :each][ok], (first, second))

    def dataset(self, found: dict[str, FloatArray]) -> xr.Dataset:
        """Return all estimates as labelled arrays."""
        method, inputs = self._method, self._inputs
        points, values, ok = (in_order(a) for a in (self.points, self.outputs, self.ok))
        scramble = self.scramble
        of_quantiles = quantiles_from_replicates(values[ok], scramble[ok], method.quantiles)
        moments = {method.scrambles * each: self._moments(each) for each in self.rounds}
        last = moments[method.scrambles * self.each]
        local = self._centre.output_slopes**2
        logarithmic = inputs.coordinates.logarithmic
        dataset = local_dataset(inputs, self._evaluate, self._centre, fields=method.fields)
        dataset = of_quantiles.on(dataset.assign_coords(round=list(moments)), method.quantiles).assign(
            {
                **last.variables(),
                **of_samples(points, values, ok, scramble),
                **running(moments.values()),
                "poincare": (("parameter",), np.where(logarithmic, self._constants[1], self._constants[0])),
                "local_share": (("output", "parameter"), shares(local, local.sum(axis=1, keepdims=True))),
                **{
                    name: (("output", "direction" if "eigenvalue" in name else "parameter"), value)
                    for name, value in found.items()
                },
            }
        )
        wanted = len(inputs.names) <= FULL if method.indices is None else method.indices
        if wanted:
            with suppress(SolveError):  # of too few samples for an expansion: the bounds stand alone
                regression = Regression.of(inputs, points[ok], values[ok], in_order(self.tangents)[ok], ORDER)
                dataset = dataset.assign(by_output(regression.estimates()))
                dataset["loo_error"] = (("output",), regression.fit.relative)
                add(dataset, *of_indices(dataset))
        add(dataset, *of_tails(self._evaluate.outputs, values[ok], last.relative_std_error))
        if not ok.all():
            dataset.attrs["note"] = failure_note(ok, "all estimates", None)
        return dataset


def _descending(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues (…, d) of symmetric matrices (…, d, d), the largest first, and eigenvectors in columns."""
    values, vectors = np.linalg.eigh(matrix)
    return np.maximum(values[..., ::-1], 0.0), vectors[..., ::-1]
