"""Inversion as a method: what displacements of a specimen say of what is inside, for one data set or many.

Few parameters have the posterior of `inverse.low_dimensional.posterior`: modes from several starts, Laplace's Gaussian,
weighted points that correct it. A field has that of `inverse.fields.field_posterior`: mode by conjugate gradients,
low-rank Gaussian. In both the rows of A, the derivative of the normalised data by the whitened unknowns at the mode,
also tell what one load case alone would say: λ of A_kᵀA_k of its rows, without another solve. For fields these are the
Ritz values in the directions that all cases together constrain, exact to the first λ that was left out.

What an inversion leaves is a record of arrays whose sizes do not depend on the data set. As one vector it is the output
of a model whose only parameter is the number of the data set: groups of ranks, files of finished blocks and failures
are then those of any other evaluation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Literal, assert_never

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from forward.model import (
    FloatArray,
    ForwardModel,
    FunctionModel,
    FunctionSolution,
    Reference,
    SolveError,
)
from forward.settings import Settings
from inverse.criticism.chains import (
    FEW,
    FIELD,
    Chains,
    FieldWeights,
    Verdict,
    chains_of_few,
    chains_of_field,
    ensemble,
    verdict_on_few,
    verdict_on_field,
    walkers,
    weigh_field,
)
from inverse.criticism.comparison import quantiles
from inverse.criticism.finer import NOT_LOOKED, Finer, parameters_moved
from inverse.criticism.predictive import ResidualTest, examine, spectrum_of
from inverse.criticism.weights import FEWEST, resampled
from inverse.data.errors import NORMAL, NormalErrors, StudentErrors
from inverse.data.neighbours import neighbours
from inverse.data.observations import Components
from inverse.fields.field_posterior import FieldPosterior
from inverse.fields.low_rank import CUTOFF, LowRankPosterior, Spectrum
from inverse.fields.newton_cg import Mode, find_mode
from inverse.fields.noise import infer_noise
from inverse.low_dimensional.evidence import LEAST, Evidence, evidence
from inverse.low_dimensional.laplace import Laplace, laplace
from inverse.low_dimensional.posterior import NOISE, Posterior
from uq.evaluation.evaluate import Evaluate, Recorder, Request, SerialEvaluate, Start
from uq.inputs.distributions import Distribution
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.surrogates.linearisation import linearise

if TYPE_CHECKING:
    import xarray as xr

ENDS = (0.025, 0.975)  # of credible intervals
SHOWN = 4  # directions of a field that are kept from each end of the spectrum
STEPS = 256  # rows of the table of iterations
LETTERS = 400  # of a sentence
DRAWS = 4096  # of Laplace's Gaussian, for what it says of physical parameters
TRUST = ("laplace", "corrected", "neither")
COLUMNS = {
    "parameters": ("start", "log_posterior", "decrement", "damping"),
    "field": ("misfit", "penalty", "gradient", "pairs", "products", "length", "solves"),
}
Record = dict[str, FloatArray]
Look = Callable[[FloatArray], FloatArray]  # parameters (n, d) → ln of the stiffness factor (n, N) at the vertices


class Invert(Settings):
    """Inversion of measured displacements: the most probable interior, its uncertainty, and what the data do not say.

    Parameters
    ----------
    samples
        Solves that correct Laplace's Gaussian: by default 256 for few parameters, none for a field. With 64, intervals
        of 90 % held the truth in 82 % of the specimens where posteriors are thin and bent (docs/design.md).
    noise
        Prior of the factor on all standard deviations of the errors; without it they are what they are said to be.
    chains
        Run Markov chains too: "pcn", of proposals that a Gaussian of the posterior makes (5 204 solves; of a field
        4 804), or, for few parameters, "emcee" (35 208 solves, or more). Where they have mixed, moments and draws of
        few parameters are theirs; of a field, where Laplace's are not to be trusted.
    starts
        Starts of the search for the mode of few parameters.
    cutoff, rank
        Directions of a field with λ below `cutoff` are left out; and largest number of directions.
    draws
        Draws of the posterior that are kept, of few parameters; of a field a tenth.
    seed
        Of all draws.
    mesh_check
        Solve once more, at the mode on a finer mesh with thinner cells at the faces that are held: what the error of
        the mesh does to the data, in deviations of their noise, and to the unknowns, in deviations of the posterior.
        Without it no posterior is said to be trusted.
    """

    kind: Literal["invert"] = "invert"
    samples: Annotated[int, Field(ge=0)] | None = None
    noise: Distribution | None = None
    chains: Literal["pcn", "emcee"] | None = None
    starts: Annotated[int, Field(ge=1)] = 4
    cutoff: Annotated[float, Field(gt=0)] = CUTOFF
    rank: Annotated[int, Field(ge=1)] = 256
    draws: Annotated[int, Field(ge=10)] = 400
    seed: Annotated[int, Field(ge=0)] = 0
    mesh_check: bool = True

    @model_validator(mode="after")
    def _check(self) -> Invert:
        if self.samples is not None and 0 < self.samples < LEAST:
            message = f"samples = {self.samples}, expected at least {LEAST}"
            raise ValueError(message)
        return self

    def solves(self, *, field: bool) -> int:
        """Number of solves of a data set that correct the Gaussian."""
        return (0 if field else 256) if self.samples is None else self.samples

    def chain_solves(self, size: int, *, field: bool) -> int:
        """Number of solves of the chains of a data set with so many unknown parameters."""
        if self.chains is None:
            return 0
        if field:
            return 2 * FIELD.evaluations  # the map of fields takes two
        return (FEW if self.chains == "pcn" else walkers(size)).evaluations


class SyntheticNoise(Settings):
    """Independent normal errors of all components.

    Parameters
    ----------
    relative
        Standard deviation over the root mean square of the displacements of the load case.
    absolute
        Standard deviation (m).
    """

    relative: Annotated[float, Field(gt=0)] | None = None
    absolute: Annotated[float, Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _check(self) -> SyntheticNoise:
        if (self.relative is None) == (self.absolute is None):
            message = "expected either relative or absolute"
            raise ValueError(message)
        return self


class Synthesize(Settings):
    """Synthetic data: displacements of a specimen that is known, with errors.

    Parameters
    ----------
    noise
        The errors.
    fraction
        Share of the points that each data set has: there are as many data sets as numbers.
    missing
        Share of the components that are lost beside that.
    seed
        Of the errors, of the points, and of parameters that have distributions.
    """

    kind: Literal["synthesize"] = "synthesize"
    noise: SyntheticNoise
    fraction: tuple[Annotated[float, Field(gt=0, le=1)], ...] = Field(default=(1.0,), min_length=1)
    missing: Annotated[float, Field(ge=0, lt=1)] = 0.0
    seed: Annotated[int, Field(ge=0)] = 0

    def truths(self, inputs: Inputs) -> FloatArray:
        """Draw parameters (n, d) for every data set."""
        count, d = len(self.fraction), len(inputs.names)
        normals = np.random.default_rng(self.seed).standard_normal((count, d))
        return inputs.from_normals(normals)[0] if d else np.zeros((count, 0))

    def run(
        self, inputs: Inputs, evaluate: Evaluate, cases: NDArray[np.int64], points: NDArray[np.int64]
    ) -> xr.Dataset:
        """Solve for every data set, and measure.

        Parameters
        ----------
        inputs
            What is drawn afresh for every data set; may be nothing.
        evaluate
            The specimen.
        cases, points
            Number of the load case, and of the point, of each output (m,).

        Raises
        ------
        SolveError
            If the specimen has no equilibrium.
        """
        import xarray as xr

        count, m = len(self.fraction), len(evaluate.outputs)
        rng = np.random.default_rng([self.seed, 1])
        truths = self.truths(inputs)
        found = evaluate(Request(truths))
        for failure in found.failures:
            message = f"data set {failure.index}: {failure.reason}"
            raise SolveError(message, failure.history)
        sigma = np.empty((count, m))
        for case in np.unique(cases):
            of_case = cases == case
            size = np.sqrt((found.outputs[:, of_case] ** 2).mean(axis=1, keepdims=True))
            relative, absolute = self.noise.relative, self.noise.absolute
            sigma[:, of_case] = size * relative if relative is not None else absolute
        values = found.outputs + sigma * rng.standard_normal((count, m))
        for k, share in enumerate(self.fraction):
            kept = np.zeros(points.max() + 1, dtype=bool)
            number = max(round(share * len(kept)), 1)
            kept[np.sort(rng.permutation(len(kept))[:number])] = True
            values[k, ~kept[points] | (rng.uniform(size=m) < self.missing)] = np.nan
        return xr.Dataset(
            {
                "clean": (("data_set", "output"), found.outputs),
                "values": (("data_set", "output"), values),
                "sigma": (("data_set", "output"), sigma),
                "truth": (("data_set", "parameter"), truths),
            },
            {"output": list(evaluate.outputs), "parameter": list(inputs.names)},
        )


# --- records ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Variables:
    """What an inversion leaves: arrays of fixed sizes, which are one vector of S numbers too.

    Attributes
    ----------
    dims
        Names of the dimensions of each array.
    sizes
        Of the dimensions.
    """

    dims: Mapping[str, tuple[str, ...]]
    sizes: Mapping[str, int]

    def _shape(self, name: str) -> tuple[int, ...]:
        return tuple(self.sizes[dim] for dim in self.dims[name])

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the S numbers."""
        return tuple(f"{name}.{i}" for name in self.dims for i in range(int(np.prod(self._shape(name)))))

    def pack(self, record: Record) -> FloatArray:
        """Return a record as a vector (S,); what is shorter than its dimensions is filled up with NaN."""
        parts = []
        for name in self.dims:
            whole = np.full(self._shape(name), np.nan)
            value = np.asarray(record[name], dtype=float)
            within = tuple(slice(0, min(have, room)) for have, room in zip(value.shape, whole.shape, strict=True))
            whole[within] = value[within]
            parts.append(whole.ravel())
        return np.concatenate(parts)

    def unpack(self, rows: FloatArray) -> Record:
        """Return the arrays (n, …) of vectors (n, S)."""
        found, first = {}, 0
        for name in self.dims:
            shape = self._shape(name)
            last = first + int(np.prod(shape))
            found[name] = rows[:, first:last].reshape(len(rows), *shape)
            first = last
        return found


_COMMON: dict[str, tuple[str, ...]] = {
    "mode": ("parameter",),
    "mean": ("parameter",),
    "std": ("parameter",),
    "lower": ("parameter",),
    "upper": ("parameter",),
    "covariance": ("parameter", "partner"),
    "log_evidence": (),
    "log_evidence_error": (),
    "laplace_log_evidence": (),
    "effective": (),
    "tail": (),
    "chains": (),
    "chain_rhat": (),
    "chain_effective": (),
    "converged": (),
    "trust": (),
    "why": ("letter",),
    "solves": (),
    "eigenvalue": ("direction",),
    "determined": (),
    "alone_eigenvalue": ("case", "direction"),
    "alone_determined": ("case",),
    "misfit": ("case",),
    "misfit_degrees": ("case",),
    "misfit_count": ("case",),
    "residual_square": (),
    "residual_degrees": (),
    "residual_probability": (),
    "agreement_probability": (),
    "prior_square": (),
    "prior_degrees": (),
    "mesh_checked": (),
    "mesh_why": ("letter",),
    "mesh_error": ("datum",),
    "mesh_shift": ("parameter",),
    "step": ("iteration", "column"),
    "place": ("datum", "axis"),
    "datum_axis": ("datum",),
    "datum_case": ("datum",),
    "measured": ("datum",),
    "sigma": ("datum",),
    "predicted": ("datum",),
    "predicted_std": ("datum",),
    "residual": ("datum",),
    "resolution": ("datum",),
    "stiffness_mode": ("node",),
    "stiffness_mean": ("node",),
    "stiffness_std": ("node",),
}
_OF_PARAMETERS: dict[str, tuple[str, ...]] = {
    "laplace_std": ("parameter",),
    "direction_parameter": ("direction", "parameter"),
    "together_std": ("parameter",),
    "alone_std": ("case", "parameter"),
    "start_mode": ("start", "parameter"),
    "start_log_posterior": ("start",),
    "zero_likelihood": (),
    "draw": ("sample", "parameter"),
    "draw_log_likelihood": ("sample", "datum"),
}
_OF_FIELD: dict[str, tuple[str, ...]] = {
    "direction_stiffness": ("shown", "node"),
    "shown_number": ("shown",),
    "alone_stiffness_std": ("case", "node"),
    "stiffness_mesh_shift": ("node",),
    "stiffness_draw": ("sample", "node"),
    "neglected": (),
    "information": (),
    "products": (),
}


def variables(names: tuple[str, ...], *, field: bool, cases: int, data: int, nodes: int, method: Invert) -> Variables:
    """Return what inversions leave.

    Parameters
    ----------
    names
        Of the parameters, with the noise where it is inferred.
    field
        Whether a field is inverted.
    cases, data, nodes
        Numbers of load cases, of data (the largest of all data sets) and of vertices.
    method
        What is asked.
    """
    c = len(names)
    sizes = {
        "parameter": c,
        "partner": c,
        "letter": LETTERS,
        "direction": method.rank if field else c - (method.noise is not None),
        "case": cases,
        "iteration": STEPS,
        "column": len(COLUMNS["field" if field else "parameters"]),
        "datum": data,
        "axis": 3,
        "node": nodes,
        "start": method.starts,
        "sample": -(-method.draws // 10) if field else method.draws,
        "shown": 2 * SHOWN,
    }
    return Variables(_COMMON | (_OF_FIELD if field else _OF_PARAMETERS), sizes)


@dataclass(frozen=True)
class Inversions(FunctionModel):
    """Inversions of data sets as a model whose parameter is the number of the data set."""

    def solve(
        self,
        parameters: FloatArray,
        start: FloatArray | None = None,
        reference: Reference | None = None,
        iterations: int | None = None,
    ) -> FunctionSolution:
        """Invert a data set; NaN in the outputs are places that it does not fill."""
        outputs = np.asarray(self.function(parameters), dtype=float)
        return FunctionSolution(self, np.array(parameters, dtype=float), outputs)


# --- what both have --------------------------------------------------------------------------------------------------


def _of_data(
    data: Components, predicted: FloatArray, residual: FloatArray, scale: FloatArray, spectrum: Spectrum, cases: int
) -> Record:
    """Data, residuals over the errors `scale`, and resolution, and what each load case has of them."""
    values = spectrum.values
    resolution = (spectrum.images**2 / (1 + values[:, None])).sum(axis=0)
    per_case = [data.cases == k for k in range(cases)]
    alone = [_ritz(spectrum, rows)[0] for rows in per_case]
    return {
        "place": data.places,
        "datum_axis": data.axes,
        "datum_case": data.cases,
        "measured": data.values,
        "sigma": data.sigma,
        "predicted": predicted,
        "predicted_std": scale * np.sqrt(resolution),  # S is the covariance of what the model predicts, over the errors
        "residual": residual,
        "resolution": resolution,
        "misfit": np.array([(residual[rows] ** 2).sum() for rows in per_case]),
        "misfit_degrees": np.array([(1 - resolution[rows]).sum() for rows in per_case]),
        "misfit_count": np.array([rows.sum() for rows in per_case]),
        "eigenvalue": values,
        "determined": (values / (1 + values)).sum(),
        "alone_eigenvalue": np.array(alone).reshape(cases, -1),
        "alone_determined": np.array([(found / (1 + found)).sum() for found in alone]),
    }


def _ritz(spectrum: Spectrum, rows: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """Return λ (r,) of A_kᵀA_k in the span of the pairs, falling, and the coordinates (r, r) of the directions."""
    images = spectrum.images[:, rows]
    values, vectors = np.linalg.eigh(images @ images.T)
    return np.maximum(values[::-1], 0), vectors[:, ::-1].T


def _of_test(test: ResidualTest) -> Record:
    return {
        "residual_square": np.array(test.square),
        "residual_degrees": np.array(test.degrees),
        "residual_probability": np.array(test.probability),
        "agreement_probability": np.array(test.agreement_probability),
    }


def _of_prior(x: FloatArray, spectrum: Spectrum) -> Record:
    """How far the mode x (N,) is from the centre of the prior, in the directions that the data say more of than it.

    There x has the variance λ/(1+λ) where the truth is drawn from the prior: the squares are of χ².
    """
    seen = spectrum.values > 1
    values = spectrum.values[seen]
    squares = (spectrum.vectors[seen] @ x) ** 2 * (1 + values) / values
    return {"prior_square": np.array(squares.sum()), "prior_degrees": np.array(float(seen.sum()))}


def _of_mesh(gap: FloatArray | None, why: str, scale: FloatArray, shift: FloatArray) -> Record:
    return {
        "mesh_checked": np.array(float(gap is not None)),
        "mesh_why": _letters(why),
        "mesh_error": np.full(len(scale), np.nan) if gap is None else gap / scale,
        "mesh_shift": shift,
    }


def _of_chains(chains: Chains | None) -> Record:
    """What chains are worth, and how many have mixed: none where there are none."""
    if chains is None:
        return {"chains": np.array(0.0), "chain_rhat": np.array(np.nan), "chain_effective": np.array(np.nan)}
    return {
        "chains": np.array(float(len(chains.draws) if chains.mixed else 0)),
        "chain_rhat": np.array(chains.rhat.max()),
        "chain_effective": np.array(chains.worth),
    }


def _thinned(chains: Chains, count: int) -> FloatArray:
    """At most `count` draws (n, k), chain after chain and as many of each."""
    each = max(count // len(chains.draws), 1)
    steps = np.linspace(0, chains.draws.shape[1] - 1, each).round().astype(int)
    return chains.draws[:, steps].reshape(-1, chains.draws.shape[2])[:count]


def _letters(text: str) -> FloatArray:
    """A sentence as the numbers of its letters: records have nothing else."""
    return np.array([ord(letter) for letter in text[:LETTERS]], dtype=float)


def sentence(letters: FloatArray) -> str:
    """Return the sentence of a record."""
    return "".join(chr(int(number)) for number in letters if np.isfinite(number))


def _pairs(data: Components) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    return neighbours(data.places, 3 * data.cases + data.axes)


# --- few parameters --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Nearby:
    """A linear prediction of the state from a solution that this group of ranks has; a `Start`."""

    point: FloatArray
    state: FloatArray
    slopes: FloatArray

    @classmethod
    def at(cls, model: ForwardModel, point: FloatArray) -> Nearby:
        """Solve at parameters (d,); collective."""
        solution = model.solve(point)
        return cls(point, np.array(solution.state), solution.state_tangent(np.eye(len(point))))

    def on(self, model: ForwardModel) -> tuple[Callable[[FloatArray], FloatArray], Reference]:
        """Return the function parameters (d,) → predicted state (U_local,), and its reference."""
        return lambda point: self.state + (point - self.point) @ self.slopes, Reference(self.point, self.state)


def invert_by_group(
    inputs: Inputs,
    model: ForwardModel,
    data: Components,
    method: Invert,
    look: Look,
    errors: NormalErrors | StudentErrors = NORMAL,
    finer: Finer = NOT_LOOKED,
    evaluate: Evaluate | None = None,
) -> Record:
    """Invert a data set on the model of one group of ranks, or by an evaluation of it; collective over the group.

    Raises
    ------
    SolveError
        If the model has no answer where the search needs one.
    """
    solve = evaluate or SerialEvaluate(model)
    return _invert(inputs, solve, data, method, look, errors, finer, lambda point: Nearby.at(model, point))


def invert_by_all(
    inputs: Inputs,
    evaluate: Evaluate,
    data: Components,
    method: Invert,
    look: Look,
    errors: NormalErrors | StudentErrors = NORMAL,
    finer: Finer = NOT_LOOKED,
) -> Record:
    """Invert a data set with all groups of ranks, each of which solves at other points; raises as the other."""
    return _invert(
        inputs,
        evaluate,
        data,
        method,
        look,
        errors,
        finer,
        lambda point: linearise(inputs, evaluate, point).prediction,
    )


def _invert(
    inputs: Inputs,
    evaluate: Evaluate,
    data: Components,
    method: Invert,
    look: Look,
    errors: NormalErrors | StudentErrors,
    finer: Finer,
    start: Callable[[FloatArray], Start | None],
) -> Record:
    counted = Recorder(evaluate)
    posterior = Posterior(inputs, counted, data.values, data.sigma, method.noise, errors=errors)
    d = len(inputs.names)
    with suppress(SolveError):  # or else every solve begins at zero
        posterior = replace(posterior, start=start(inputs.mean))
    gaussian = laplace(posterior, starts=method.starts, seed=method.seed)
    best = posterior.physical(gaussian.mode[None])[0]
    posterior = replace(posterior, start=start(best[:d]))
    found = evidence(posterior, gaussian, method.solves(field=False) or LEAST, seed=method.seed)
    at = posterior.at(gaussian.mode[None], derivatives=True)
    spectrum = spectrum_of(posterior, at)
    scale = data.sigma * (best[-1] if method.noise is not None else 1.0)
    raw = (at.outputs[0] - data.values) / scale
    residual, root = errors.normal_scores(raw), np.sqrt(errors.information(raw))
    test = examine(residual, spectrum, np.ones_like(residual), _pairs(data))
    chains = _chains(posterior, gaussian, found, method)
    verdict = verdict_on_few(gaussian, found, test, chains)
    cases = int(data.cases.max()) + 1
    if chains is not None and chains.mixed:
        points = chains.flat
        weights = np.full(len(points), 1 / len(points))
        draws = _thinned(chains, method.draws)
        outputs = counted(Request(draws[:, :d], start=posterior.start)).outputs
    else:
        weights, points = found.weights, posterior.physical(found.density.x)
        chosen = resampled(weights, method.draws, method.seed)
        draws, outputs = points[chosen], found.density.outputs[chosen]
    moments = _moments(posterior, gaussian, weights, points, look)
    gap, why = finer.gap(best[:d], at.outputs[0])
    shift = np.full(len(best), np.nan)
    if gap is not None:
        A = spectrum.images.T @ spectrum.vectors
        shift[:d] = parameters_moved(posterior, gaussian, A, root * gap / scale) / moments["std"][:d]
    return {
        **_of_data(data, at.outputs[0], residual, scale / root, spectrum, cases),
        **_of_test(test),
        **_of_prior(gaussian.mode[:d], spectrum),
        **_of_mesh(gap, why, scale, shift),
        **moments,
        **_alone(posterior, gaussian, spectrum, data),
        **_draws(draws, outputs, data, method, errors),
        **_of_chains(chains),
        "mode": best,
        "log_evidence": np.array(found.log_evidence),
        "log_evidence_error": np.array(found.error),
        "laplace_log_evidence": np.array(gaussian.log_evidence),
        "effective": np.array(found.effective),
        "tail": np.array(found.tail),
        "converged": np.array(gaussian.converged),
        "trust": np.array(TRUST.index(verdict.trust)),
        "why": _letters(str(verdict)),
        "solves": np.array(counted.solves),
        "zero_likelihood": np.array(float(sum(one.inadmissible for part in counted.log for one in part.failures))),
        "step": np.array([[s.start, s.log_posterior, s.decrement, s.damping] for s in gaussian.steps]),
        "start_mode": posterior.physical(gaussian.modes),
        "start_log_posterior": gaussian.ends,
        "direction_parameter": np.pad(spectrum.vectors, ((0, 0), (0, len(posterior.names) - d))),
    }


def _chains(posterior: Posterior, gaussian: Laplace, found: Evidence, method: Invert) -> Chains | None:
    match method.chains:
        case None:
            return None
        case "emcee":
            return ensemble(posterior, gaussian, seed=method.seed)
        case "pcn":
            # Fewer points than that say little of a covariance.
            enough = found.effective >= max(FEWEST, 4 * len(gaussian.mode))
            return chains_of_few(posterior, found if enough else gaussian, seed=method.seed)
        case _:
            assert_never(method.chains)


def _moments(posterior: Posterior, gaussian: Laplace, weights: FloatArray, points: FloatArray, look: Look) -> Record:
    """Moments and quantiles of the parameters and of the stiffness, by weighted points; widths of the Gaussian."""
    used = weights > 0
    w, points = weights[used], points[used]
    mean = w @ points
    gaps = points - mean
    ends = np.array([quantiles(column, w, ENDS) for column in points.T])
    z = _normals(0, DRAWS, len(gaussian.mode))
    drawn = posterior.physical(gaussian.mode + z @ gaussian.root.T)
    d = len(posterior.inputs.names)
    stiffness = look(points[:, :d])
    average = w @ stiffness
    return {
        "mean": mean,
        "std": np.sqrt(w @ gaps**2),
        "lower": ends[:, 0],
        "upper": ends[:, 1],
        "covariance": (w[:, None] * gaps).T @ gaps,
        "laplace_std": drawn.std(axis=0),
        "stiffness_mode": look(posterior.physical(gaussian.mode[None])[:, :d])[0],
        "stiffness_mean": average,
        "stiffness_std": np.sqrt(np.maximum(w @ (stiffness - average) ** 2, 0)),
    }


def _normals(seed: int, count: int, dimension: int) -> FloatArray:
    from scipy.special import ndtri

    return np.asarray(ndtri(sobol_points(seed, 0, 0, count, dimension)))


def _alone(posterior: Posterior, gaussian: Laplace, spectrum: Spectrum, data: Components) -> Record:
    """Standard deviations (c,) by the model linearised at the mode, of all load cases and of each alone."""
    d, c = len(posterior.inputs.names), len(posterior.names)
    slopes = posterior.inputs.from_normals(gaussian.mode[None, :d])[1][0]
    A = spectrum.images.T @ spectrum.vectors

    def widths(rows: FloatArray) -> FloatArray:
        covariance = slopes @ np.linalg.inv(np.eye(d) + rows.T @ rows) @ slopes.T
        return np.concatenate([np.sqrt(np.diag(covariance)), np.full(c - d, np.nan)])

    cases = range(int(data.cases.max()) + 1)
    return {"together_std": widths(A), "alone_std": np.array([widths(A[data.cases == k]) for k in cases])}


def _draws(
    draws: FloatArray, outputs: FloatArray, data: Components, method: Invert, errors: NormalErrors | StudentErrors
) -> Record:
    """Draws of equal weight with what the data say of each."""
    scale = data.sigma * (draws[:, -1:] if method.noise is not None else 1.0)
    gaps = (outputs - data.values) / scale
    return {"draw": draws, "draw_log_likelihood": -errors.minus_log(gaps) - np.log(scale)}


# --- fields ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Vertices:
    """What makes values at the vertices a stiffness.

    Attributes
    ----------
    offset
        ln of the factor (N,) where the values are zero.
    volumes
        Of the vertices (N,), in m³.
    """

    offset: FloatArray
    volumes: FloatArray


def invert_field(
    posterior: FieldPosterior, data: Components, method: Invert, vertices: Vertices, finer: Finer = NOT_LOOKED
) -> Record:
    """Invert a data set for a field; collective over the group of ranks that has the model.

    Raises
    ------
    SolveError
        If the model has no answer at the centre of the prior.
    """
    settings = {"cutoff": method.cutoff, "rank": method.rank}
    factor, log_std, log_evidence = 1.0, 0.0, None
    if method.noise is None:
        mode = find_mode(posterior)
        found = LowRankPosterior.at(mode.point, cutoff=method.cutoff, rank=method.rank, seed=method.seed)
        converged = mode.converged
    else:
        inferred = infer_noise(posterior, method.noise, **settings)  # type: ignore[arg-type]
        mode, found, converged = inferred.mode, inferred.found, inferred.converged
        factor, log_std, log_evidence = inferred.factor, inferred.log_std, inferred.log_evidence
    spectrum = found.spectrum
    errors, root = posterior.errors, mode.point.root
    residual = errors.normal_scores(mode.point.gaps)
    test = examine(residual, spectrum, np.ones_like(residual), _pairs(data))
    samples = method.solves(field=True)
    weighed = weigh_field(mode.point, found, samples, seed=method.seed) if samples else None
    g = vertices.volumes / vertices.volumes.sum()
    chains = whole = None
    if method.chains is not None:
        # Chains are judged by the mean over the body: that all vertices have mixed would ask for far more draws.
        whole = chains_of_field(mode.point, found, keep=lambda m: np.column_stack([m @ g, m]), seed=method.seed)
        chains = replace(whole, names=("mean",), draws=whole.draws[:, :, :1])
    drawn = None if whole is None else whole.flat[:, 1:]
    verdict = verdict_on_field(replace(mode, converged=converged), found, weighed, test, chains, drawn)
    error = np.nan
    if log_evidence is None and weighed is not None and weighed.trusted:
        log_evidence, error = weighed.log_evidence, weighed.error
    scale = data.sigma * factor
    cases = int(data.cases.max()) + 1
    inferred_noise = (factor, log_std) if method.noise is not None else None
    values, weights = _corrected(verdict, weighed, chains, drawn)
    predicted = np.asarray(mode.point.solution.outputs)
    mean, stiffness = (
        _of_mean(found, vertices, inferred_noise, values, weights),
        _of_stiffness(found, vertices, method, values, weights),
    )
    gap, why = finer.gap(mode.point.values, predicted)
    moved, shift = np.full(len(found.mean), np.nan), np.full(len(mean["mode"]), np.nan)
    if gap is not None:
        moved = -(spectrum.images @ (root * gap / scale) / (1 + spectrum.values)) @ found.directions
        shift[0] = g @ moved / mean["std"][0]
    return {
        **_of_data(data, predicted, residual, scale / root, spectrum, cases),
        **_of_test(test),
        **_of_prior(mode.point.noise, spectrum),
        **_of_mesh(gap, why, scale, shift),
        **mean,
        **stiffness,
        "stiffness_mesh_shift": moved / np.maximum(stiffness["stiffness_std"], 1e-300),
        **_directions(found),
        **_of_chains(chains),
        "log_evidence": np.array(found.log_evidence if log_evidence is None else log_evidence),
        "log_evidence_error": np.array(error),
        "laplace_log_evidence": np.array(found.log_evidence),
        "effective": np.array(np.nan if weighed is None else weighed.effective),
        "tail": np.array(np.nan if weighed is None else weighed.tail),
        "converged": np.array(converged),
        "trust": np.array(TRUST.index(verdict.trust)),
        "why": _letters(str(verdict)),
        "solves": np.array(posterior.counts.solves),
        "products": np.array(mode.products + spectrum.products),
        "step": _steps(mode),
        "stiffness_mode": vertices.offset + found.mean,
        "alone_stiffness_std": np.array([_alone_std(found, data.cases == k) for k in range(cases)]),
        "neglected": np.array(spectrum.neglected),
        "information": np.array(found.information),
    }


def _corrected(
    verdict: Verdict, weighed: FieldWeights | None, chains: Chains | None, drawn: FloatArray | None
) -> tuple[FloatArray | None, FloatArray]:
    """Values (n, N) of the field with weights (n,) that correct the Gaussian where it is not to be trusted."""
    if verdict.trust != "corrected":
        return None, np.zeros(0)
    if chains is not None and drawn is not None and chains.mixed:
        return drawn, np.full(len(drawn), 1 / len(drawn))
    assert weighed is not None
    return weighed.values, weighed.weights


def _of_stiffness(
    found: LowRankPosterior, vertices: Vertices, method: Invert, values: FloatArray | None, weights: FloatArray
) -> Record:
    """Mean, standard deviation and draws of ln stiffness."""
    count = -(-method.draws // 10)
    if values is None:
        noise = np.random.default_rng(method.seed).standard_normal((count, len(found.mean)))
        mean, std, draws = found.mean, found.std, found.samples(noise)
    else:
        mean = weights @ values
        std = np.sqrt(weights @ (values - mean) ** 2)
        draws = values[resampled(weights, count, method.seed)]
    return {
        "stiffness_mean": vertices.offset + mean,
        "stiffness_std": std,
        "stiffness_draw": vertices.offset + draws,
    }


def _steps(mode: Mode) -> FloatArray:
    return np.array(
        [[r.misfit, r.penalty, r.gradient, r.pairs, r.products, r.length, r.solves] for r in mode.iterations]
    )


def _of_mean(
    found: LowRankPosterior,
    vertices: Vertices,
    noise: tuple[float, float] | None,
    values: FloatArray | None,
    weights: FloatArray,
) -> Record:
    """Posterior of the mean of the logarithm over the body, and of the noise."""
    g = vertices.volumes / vertices.volumes.sum()
    offset = float(g @ vertices.offset)
    at, std = found.marginal(g)
    mode, mean = np.array([at + offset]), np.array([at + offset])
    lower, upper = mode - 1.96 * std, mode + 1.96 * std
    if values is not None:
        means = values @ g + offset
        mean = np.array([weights @ means])
        std = float(np.sqrt(weights @ (means - mean) ** 2))
        lower, upper = quantiles(means, weights, ENDS)[:, None]
    widths = np.array([std])
    if noise is not None:
        factor, log_std = noise
        mode, mean, widths = np.append(mode, factor), np.append(mean, factor), np.append(widths, factor * log_std)
        lower = np.append(lower, factor * np.exp(-1.96 * log_std))
        upper = np.append(upper, factor * np.exp(1.96 * log_std))
    covariance = np.diag(widths**2)
    return {"mode": mode, "mean": mean, "std": widths, "lower": lower, "upper": upper, "covariance": covariance}


def _directions(found: LowRankPosterior) -> Record:
    """The directions that the data constrain most, and the last that were found."""
    count = len(found.spectrum.values)
    first = np.arange(min(SHOWN, count))
    last = np.arange(max(count - SHOWN, len(first)), count)
    shown = np.concatenate([first, np.full(SHOWN - len(first), -1), last, np.full(SHOWN - len(last), -1)])
    vectors = np.full((len(shown), len(found.mean)), np.nan)
    for row, number in enumerate(shown):
        if number >= 0:
            vectors[row] = found.directions[number]
    return {"direction_stiffness": vectors, "shown_number": shown}


def _alone_std(found: LowRankPosterior, rows: NDArray[np.bool_]) -> FloatArray:
    """Standard deviations (N,) by one load case alone."""
    values, turn = _ritz(found.spectrum, rows)
    share = values / (1 + values)
    return np.asarray(np.sqrt(np.maximum(found.prior.variance - share @ (turn @ found.directions) ** 2, 0)))


def names_of(inputs: Inputs, method: Invert) -> tuple[str, ...]:
    """Return the names of the parameters, and of the noise where it is inferred."""
    return (*inputs.names, *((NOISE,) if method.noise is not None else ()))
