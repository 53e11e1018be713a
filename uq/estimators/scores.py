"""True errors of estimates over independent repeats, and whether the errors that they claim are honest."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from forward.model import FloatArray
from uq.estimators.indices import jackknife_error
from uq.estimators.moments import ratio

if TYPE_CHECKING:
    import xarray as xr

RESOLVED = 2.0  # an error counts as measured if it is this many times the reference's own
UNLIKELY = 1e-3  # probability below which so few intervals would hold the reference if they were honest


class Score(NamedTuple):
    """Errors of repeats, by row and output (n, m).

    Attributes
    ----------
    rmse, rmse_error
        Root mean square error, and its standard error.
    claimed
        Root mean square of the standard errors that were claimed.
    resolved
        Whether the reference is good enough to measure this error.
    coverage
        Share of the claimed 95 % intervals that hold the reference, NaN where the error is not resolved.
    understated
        Whether so few would hold it once in a thousand times if the claims were honest.
    """

    rmse: FloatArray
    rmse_error: FloatArray
    claimed: FloatArray
    resolved: FloatArray
    coverage: FloatArray
    understated: FloatArray


def score(errors: FloatArray, claims: FloatArray, halves: FloatArray, floor: FloatArray) -> Score:
    """Compare errors with claims (n, R, m).

    Parameters
    ----------
    errors, claims
        Estimates minus reference, and claimed standard errors; NaN where a repeat gave none.
    halves
        Claimed standard errors on either side of a 95 % interval (n, R).
    floor
        Standard error of the reference (m,).
    """
    from scipy.stats import binom

    there = np.isfinite(errors)
    R = np.maximum(there.sum(axis=1), 1)
    squares = np.where(there, errors, 0.0) ** 2
    mean = np.where(there.any(axis=1), squares.sum(axis=1) / R, np.nan)
    spread = np.where(there, squares - mean[:, None], 0.0)
    scatter = np.sqrt((spread**2).sum(axis=1) / np.maximum(R - 1, 1) / R)
    rmse = np.sqrt(mean)
    resolved = rmse > RESOLVED * floor
    # The reference has an error too: intervals are widened by it.
    within = there & (np.abs(errors) <= np.hypot(halves[..., None] * claims, 1.96 * floor))
    hits = within.sum(axis=1)
    return Score(
        rmse,
        ratio(scatter, 2 * rmse),
        np.sqrt((np.where(there, claims, 0.0) ** 2).sum(axis=1) / R),
        resolved,
        np.where(resolved, hits / R, np.nan),
        resolved & (binom.cdf(hits, R, 0.95) < UNLIKELY),
    )


def rate(solves: FloatArray, errors: FloatArray) -> tuple[float, float]:
    """Slope of ln RMSE over ln solves (n,) of errors (n, R), with its error by the jackknife over the repeats.

    Budgets of one repeat share points, so that their errors are not independent; the repeats are.
    """
    squares = errors[:, np.isfinite(errors).all(axis=0)] ** 2
    n, R = squares.shape
    if n < 2 or R < 3:
        return np.nan, np.nan
    total = squares.sum(axis=1)
    without = (total[:, None] - squares) / (R - 1)
    mean_squares = np.column_stack([total / R, without])
    if not (mean_squares > 0).all():
        return np.nan, np.nan
    centred = np.log(solves) - np.log(solves).mean()
    slopes = centred @ np.log(mean_squares) / 2 / (centred @ centred)
    return float(slopes[0]), float(jackknife_error(slopes[1:]))


def plain_samples(dataset: xr.Dataset, estimated: str) -> xr.DataArray:
    """Return how many plain Monte Carlo samples give the same error, by row and output, for the mean or the std.

    This is a lower bound if the error is not resolved.
    """
    return (dataset[f"{estimated}_rmse"] / dataset[f"{estimated}_single"]) ** -2


def gains(dataset: xr.Dataset, estimated: str) -> dict[str, xr.DataArray]:
    """Return the cost of plain Monte Carlo at equal error over that of a method, by row and output.

    By number of "solves", by processor time ("cpu"), and by processor time with the textbook solver for plain Monte
    Carlo ("textbook"); the last two are NaN if nothing was solved by the textbook.
    """
    plain, seconds = plain_samples(dataset, estimated), dataset["cpu_seconds"]
    return {
        "solves": plain / dataset["solves"],
        "cpu": plain * dataset["plain_seconds"] / seconds,
        "textbook": plain * dataset["textbook_seconds"] / seconds,
    }
