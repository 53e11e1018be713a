"""The results of an inversion: its dataset, and the parts that few parameters and fields have in common.

The rows of A, the derivative of the normalised data by the whitened unknowns at the mode, also show what one load case
alone determines: λ of A_kᵀA_k with its rows, without another solve. For fields these are the Ritz values in the
directions that all cases together constrain, exact to the first λ that was neglected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from inverse.criticism.assessment import with_nans
from inverse.criticism.chains import Chains
from inverse.criticism.finer import MeshFound
from inverse.criticism.verdict import ResidualTest, Verdict
from inverse.data.measurements import Measurements
from inverse.data.noise import Noise
from inverse.data.shared_motion import determined
from inverse.fields.low_rank import Spectrum
from inverse.low_dimensional.residual_process import Process
from inverse.methods.infer import Problem
from inverse.methods.invert import Invert
from inverse.methods.model_error import Truth
from uq.estimators.estimate import BAND, part

if TYPE_CHECKING:
    import xarray as xr

ENDS = (0.025, 0.975)  # of credible intervals
SHOWN = 4  # directions of a field that are stored from each end of the spectrum
STEPS = 256  # rows of the table of iterations, or more if there are more
TRUST = ("laplace", "corrected", "neither")
SOURCES = ("laplace", "points", "chains")  # of moments, intervals and draws of few parameters
COLUMNS = {
    "parameters": ("start", "log_posterior", "decrement", "damping"),
    "field": ("misfit", "penalty", "gradient", "pairs", "products", "length", "solves"),
}
Record = dict[str, FloatArray | str]

# What is found of a data set, by its dimensions: of both, of few parameters, of a field, of what is predicted.
_NUMBERS = """
    log_evidence log_evidence_error laplace_log_evidence effective tail chains chain_rhat chain_effective converged
    trust source cut why solves determined residual_square residual_degrees residual_probability agreement_probability
    prior_square prior_degrees mesh_checked mesh_why mesh_corrected mesh_settled mesh_solves mesh_before
    zero_likelihood expansion_error expansion_solves reduced_share reduced_rounds reduced_solves
    neglected information products
    prediction_solves prediction_why question_forms process_size process_length model_error_solves
    model_error_follows
"""
WORDS = ("why", "mesh_why", "prediction_why", "question_forms")
_ARRAYS = {
    "parameter": "mode mean std lower upper outermost mesh_shift mesh_left laplace_std together_std reduced_shift",
    "parameter partner": "covariance",
    "direction": "eigenvalue",
    "case": "alone_determined misfit misfit_degrees misfit_count",
    "case direction": "alone_eigenvalue",
    "motion": "motion_eigenvalue",
    "assumption parameter": "assumption_shift",
    "assumption": "assumption_stiffness",
    "uncertain parameter": "assumption_bend",
    "question": "question_probability question_log_evidence",
    "question parameter": "question_move question_left",
    "uncertain": "uncertain_mean uncertain_std uncertain_sampled",
    "uncertain uncertain_partner": "uncertain_covariance",
    "point uncertain": "uncertain_point",
    "point goal": "unexplained_point",
    "goal goal_partner": "unexplained_covariance",
    "goal uncertain": "unexplained_uncertain",
    "iteration column": "step",
    "datum": "mesh_error datum_axis datum_case measured sigma predicted predicted_std residual resolution model_error "
    "model_error_std",
    "datum axis": "place datum_direction",
    "node": "stiffness_mode stiffness_mean stiffness_std stiffness_mesh_shift",
    "direction parameter": "direction_parameter",
    "case parameter": "alone_std",
    "start parameter": "start_mode",
    "start": "start_log_posterior",
    "point parameter": "point",
    "point": "point_weight",
    "sample parameter": "draw",
    "sample datum": "draw_log_likelihood",
    "shown node": "direction_stiffness",
    "shown": "shown_number",
    "case node": "alone_stiffness_std",
    "sample node": "stiffness_draw",
    "goal": " ".join(
        [
            "prediction_share",
            part("prediction_mean", "mesh"),
            *(f"prediction_{one}{end}" for one in ("", "prior_", "process_") for end in BAND),
        ]
    ),
}
DIMS = {name: tuple(dims.split()) for dims, names in {"": _NUMBERS, **_ARRAYS}.items() for name in names.split()}


def noise_of(problem: Problem[Invert]) -> Noise:
    """Return the errors of the data, as they are stated."""
    return Noise(problem.data.sigma, problem.errors.dof, problem.method.noise)


def as_dataset(record: Record) -> xr.Dataset:
    """Return the results of an inversion, numbers and sentences, as a dataset."""
    import xarray as xr

    kinds = {name: str if name in WORDS else float for name in DIMS if name in record}
    return xr.Dataset({name: (DIMS[name], np.asarray(record[name], kind)) for name, kind in kinds.items()})


def of_some(record: Record, parameters: Sequence[int]) -> Record:
    """Return arrays of a record with some of their parameters (p,) only."""
    found = dict(record)
    for name in record:
        for axis in (axis for axis, dim in enumerate(DIMS[name]) if dim in {"parameter", "partner"}):
            found[name] = np.take(np.asarray(found[name]), parameters, axis=axis)
    return found


def stacked(
    found: Sequence[xr.Dataset | None], least: Mapping[str, int]
) -> dict[str, tuple[tuple[str, ...], FloatArray]]:
    """Stack the numbers of several data sets, of which some may be missing, along the dimension `data_set`.

    Dimensions are at least as long as is said by name; shorter ones are filled with NaN.
    """
    there = [one for one in found if one is not None]
    sizes = dict(least)
    for dataset in there:
        sizes |= {str(dim): max(size, sizes.get(str(dim), 0)) for dim, size in dataset.sizes.items()}
    rows: dict[str, tuple[tuple[str, ...], FloatArray]] = {}
    for name in (name for name in DIMS if any(name in one and one[name].dtype.kind == "f" for one in there)):
        whole = np.full((len(found), *(sizes[dim] for dim in DIMS[name])), np.nan)
        for k, one in enumerate(found):
            if one is not None:
                values = one[name].to_numpy()
                whole[(k, *map(slice, values.shape))] = values
        rows[name] = (("data_set", *DIMS[name]), whole)
    return rows


def usual_sizes(method: Invert, *, field: bool) -> dict[str, int]:
    """Return sizes of dimensions that are the same for all data sets of a method, unless one needs more."""
    of_field = {"direction": method.rank, "sample": -(-method.draws // 10)}
    return {"iteration": STEPS} | (of_field if field else {"sample": method.draws})


def of_data(
    data: Measurements, predicted: FloatArray, residual: FloatArray, scale: FloatArray, spectrum: Spectrum
) -> Record:
    """Data, residuals over the errors `scale`, and resolution, also by load case."""
    values, cases = spectrum.values, int(data.cases.max()) + 1
    resolution = spectrum.resolution
    per_case = [data.cases == k for k in range(cases)]
    alone = [ritz(spectrum, rows)[0] for rows in per_case]
    return {
        **data.described,
        "datum_case": data.cases,
        "measured": data.values,
        "sigma": data.sigma,
        "predicted": predicted,
        "predicted_std": scale * np.sqrt(resolution),  # S is the covariance of predictions, over the errors
        "residual": residual,
        "resolution": resolution,
        "misfit": np.array([(residual[rows] ** 2).sum() for rows in per_case]),
        "misfit_degrees": np.array([(1 - resolution[rows]).sum() for rows in per_case]),
        "misfit_count": np.array([rows.sum() for rows in per_case]),
        "eigenvalue": values,
        "determined": np.array(spectrum.determined),
        "alone_eigenvalue": np.array(alone).reshape(cases, -1),
        "alone_determined": np.array([(found / (1 + found)).sum() for found in alone]),
    }


def ritz(spectrum: Spectrum, rows: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """Return λ (r,) of A_kᵀA_k in the span of the pairs, descending, and the coordinates (r, r) of the directions."""
    images = spectrum.images[:, rows]
    values, vectors = np.linalg.eigh(images @ images.T)
    return np.maximum(values[::-1], 0), vectors[:, ::-1].T


def of_verdict(verdict: Verdict, test: ResidualTest) -> Record:
    """How far a posterior can be trusted, and tests of the model by its residuals."""
    return {
        "trust": np.array(TRUST.index(verdict.trust)),
        "why": str(verdict),
        "residual_square": np.array(test.square),
        "residual_degrees": np.array(test.degrees),
        "residual_probability": np.array(test.probability),
        "agreement_probability": np.array(test.agreement_probability),
    }


def of_prior(x: FloatArray, spectrum: Spectrum) -> Record:
    """Distance of the mode x (N,) from the centre of the prior, in directions better known from data than from it.

    There x has the variance λ/(1+λ) if the truth is drawn from the prior: the sum of squares is χ².
    """
    seen = spectrum.values > 1
    values = spectrum.values[seen]
    squares = (spectrum.vectors[seen] @ x) ** 2 * (1 + values) / values
    return {"prior_square": np.array(squares.sum()), "prior_degrees": np.array(float(seen.sum()))}


def of_motions(spectrum: Spectrum, noise: Noise, root: FloatArray) -> Record:
    """What the data say about rigid motions that are uncertain; none if none is."""
    return {} if noise.shared is None else {"motion_eigenvalue": determined(spectrum, noise, root)}


def of_process(process: Process) -> Record:
    """Size and length (m) of what the model does not explain."""
    return {"process_size": np.array(process.size), "process_length": np.array(process.length)}


def of_mesh(found: MeshFound, before: float | None, count: int) -> Record:
    """What finer meshes said, of data and unknowns, so many; of the last one (the noise) they say nothing."""
    return {
        "mesh_checked": np.array(float(not found.why)),
        "mesh_why": found.why,
        "mesh_error": found.error,
        "mesh_shift": with_nans(found.shift, count),
        "mesh_left": with_nans(found.left, count),
        "mesh_corrected": np.array(float(found.corrected)),
        "mesh_settled": np.array(float(found.settled)),
        "mesh_solves": np.array(float(found.solves + (before is not None))),
        "mesh_before": np.array(np.nan if before is None else before),
    }


def of_learnt(noise: Noise, truth: Truth) -> Record:
    """Mean and standard deviation of the learnt errors of a model, over those of the data; if they follow unknowns."""
    assert noise.model is not None
    return {
        "model_error": noise.model.error / noise.sigma,
        "model_error_std": noise.model.std / noise.sigma,
        "model_error_solves": np.array(2.0 * truth.solves),
        "model_error_follows": np.array(float(noise.model.trend is not None)),
    }


def diagnosed(chains: Chains | None, *, used: bool = True) -> Record:
    """The diagnostics of chains, and how many have mixed and are used; zero if there are none."""
    if chains is None:
        return {"chains": np.array(0.0), "chain_rhat": np.array(np.nan), "chain_effective": np.array(np.nan)}
    return {
        "chains": np.array(float(len(chains.draws) if chains.mixed and used else 0)),
        "chain_rhat": np.array(chains.rhat.max()),
        "chain_effective": np.array(chains.ess),
    }
