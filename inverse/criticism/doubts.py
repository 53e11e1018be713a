"""What makes a posterior doubtful: its distance from the prior, ends of ranges, noise, outliers, a model's stand-in.

Each function returns findings that have a few words for the verdict. None of them needs a solve. Those of meshes are
in `inverse.criticism.doubts_of_meshes`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from forward.findings import Finding
from forward.model import FloatArray
from forward.readable import place, told
from uq.inputs.distributions import Distribution

FAR, FARTHER = 3.0, 4.0  # prior deviations from the centre for a warning, an error
UNLIKELY, IMPOSSIBLE = 1e-3, 1e-6  # probabilities of a joint distance for a warning, an error
END, CROWDED = 0.02, 5.0  # share of the prior at an end of a range, and how many times that the posterior has there
NOISE_FAR = 3.0  # factor between the inferred and the stated size of the errors
NOTHING_SEEN = 0.5  # size of the errors over that of the data above which the model explains nothing
STRANGE = 0.01  # probability that any of all data is as far out as an outlier
LISTED = 5
UNSEEN, SOME = 0.9, 0.05  # of the prior's deviation, above which data say little; share of vertices that is told
SAME, HALF = 0.9, 0.5  # what weights between posteriors are worth where these are alike, and where they are not
EXPANDED = 0.3  # error of an expansion over that of a datum that makes intervals wider by more than 4 %
GRID = np.linspace(-40.0, 40.0, 8001)


def scores(distribution: Distribution, values: FloatArray) -> FloatArray:
    """Return how many prior deviations values (n,) are from the median, in the coordinate where the prior is normal."""
    return np.interp(values, distribution.from_normal(GRID)[0], GRID)


def far_from_prior(
    priors: Mapping[str, Distribution],
    mode: FloatArray,
    mean: FloatArray,
    square: float,
    degrees: float,
    units: Mapping[str, str] = MappingProxyType({}),
) -> list[Finding]:
    """Doubt parameters whose mode or mean is far from the prior, each by name, and all of them together.

    Parameters
    ----------
    priors
        By name, in the order of the values.
    mode, mean
        Of the posterior (d,).
    square, degrees
        Squared distance of the mode from the centre in the directions that the data determine, over its expectation,
        and their number: χ² distributed if the truth is drawn from the prior.
    units
        SI units by name, of those that have one.
    """
    from scipy.special import chdtrc

    found = []
    for k, (name, prior) in enumerate(priors.items()):
        if prior.support is not None:
            continue  # an end of a range is named as such
        distances = scores(prior, np.array([mode[k], mean[k]]))
        distance = float(distances[np.abs(distances).argmax()])
        if abs(distance) > FAR:
            centre = float(prior.from_normal(np.zeros(1))[0][0])
            value = float((mode, mean)[int(np.abs(distances).argmax())][k])
            values = {
                "name": name,
                "value": told(value, units.get(name, "1"), 4),
                "distance": abs(distance),
                "centre": told(centre, units.get(name, "1"), 4),
            }
            found.append(Finding("far-from-prior", "error" if abs(distance) > FARTHER else "warning", values))
    chance = float(chdtrc(degrees, square)) if degrees >= 1 and np.isfinite(square) else 1.0
    if chance < UNLIKELY and not found:
        values = {"square": square, "degrees": degrees, "chance": chance}
        found.append(Finding("far-from-prior-together", "error" if chance < IMPOSSIBLE else "warning", values))
    return found


def little_seen(std: FloatArray, prior_std: FloatArray, places: FloatArray) -> list[Finding]:
    """Say where a field is what its prior says: deviations (n,) of posterior and prior at places (n, 3)."""
    left = np.divide(std, prior_std, out=np.ones_like(std), where=prior_std > 0)
    share = float((left > UNSEEN).mean())
    if share < SOME:
        return []
    best, least = (f"{left[k]:.2g} of it at {_at(places[k])}" for k in (int(left.argmin()), int(left.argmax())))
    return [Finding("little-seen", "note", {"share": 100 * share, "unseen": UNSEEN, "best": best, "least": least})]


def _at(where: FloatArray) -> str:
    numbers, _, unit = place(where.tolist()).rpartition("\u00a0")
    return f"({numbers}) {unit}"


def at_an_end(
    priors: Mapping[str, Distribution],
    mode: FloatArray,
    draws: FloatArray,
    units: Mapping[str, str] = MappingProxyType({}),
) -> list[Finding]:
    """Doubt parameters at an end of a bounded range, by name, from the mode (d,) or draws (n, d) of the posterior.

    Their SI units are given by name too, for the words.
    """
    from scipy.special import ndtr

    found = []
    for k, (name, prior) in enumerate(priors.items()):
        if prior.support is None:
            continue
        shares = ndtr(scores(prior, np.append(draws[:, k], mode[k])))
        for end, share in zip(("lower", "upper"), (shares, 1 - shares), strict=True):
            if (share[:-1] < END).mean() > CROWDED * END or share[-1] < END / 4:
                value = prior.support[end == "upper"]
                values = {"name": name, "end": end, "value": told(value, units.get(name, "1"), 4)}
                found.append(Finding("at-an-end", "warning", values))
    return found


def noise_far(factor: float, expected: float, sigma: FloatArray, values: FloatArray) -> list[Finding]:
    """Doubt an inferred size of the errors.

    Parameters
    ----------
    factor
        On the stated standard deviations.
    expected
        The median of its prior.
    sigma, values
        Stated standard deviations (n,), and data (n,).
    """
    size = float(np.sqrt((sigma**2).mean()) * factor / np.sqrt((values**2).mean())) if (values != 0).any() else np.inf
    if size >= NOTHING_SEEN:
        return [Finding("model-explains-nothing", "error", {"size": 100 * size, "factor": factor})]
    if not any(1 / NOISE_FAR <= factor / known <= NOISE_FAR for known in (1.0, expected)):
        cause = "the model, or what is said of the errors, is wrong" if factor > 1 else "the stated ones are too large"
        return [Finding("noise-far", "warning", {"factor": factor, "cause": cause})]
    return []


def too_large_errors(square: float, degrees: float, probability: float) -> list[Finding]:
    """Doubt stated errors that are far larger than the residuals."""
    factor = float(np.sqrt(square / degrees)) if degrees > 0 else 1.0
    if factor < 1 / NOISE_FAR and probability > 1 - STRANGE:
        return [Finding("errors-too-large", "warning", {"factor": factor})]
    return []


REMEDY = 'or allow for them: data.errors = { kind = "student-t" }'


def strangers(
    residual: FloatArray, resolution: FloatArray, labels: Sequence[str], *, heavy: bool, remedy: str = REMEDY
) -> list[Finding]:
    """Doubt outliers among the data.

    Parameters
    ----------
    residual
        Over the errors (n,).
    resolution
        Share (n,) of each datum in its own prediction.
    labels
        What each datum is.
    heavy
        Whether heavy tails of the errors are allowed for already: then it is a note.
    remedy
        What can be done besides looking at them.
    """
    from scipy.special import log_ndtr

    if len(residual) < LISTED:
        return []
    z = residual / np.sqrt(np.maximum(1 - resolution, 1e-3))
    usual = max(1.0, float(np.median(np.abs(z))) / 0.6745)
    strange = np.log(2 * len(z)) + log_ndtr(-np.abs(z) / usual) < np.log(STRANGE)
    which = np.flatnonzero(strange)
    if not len(which):
        return []
    first = which[np.argsort(-np.abs(z[which]), kind="stable")][:LISTED]
    listed = "; ".join(f"{labels[i]}: {z[i]:+.1f}".replace("-", "−") for i in first)
    more = f"; and {len(which) - len(first)} more" if len(which) > len(first) else ""
    data = "1 datum does" if len(which) == 1 else f"{len(which)} data do"
    them = "it" if len(which) == 1 else "them"
    values = {
        "data": data,
        "others": len(z) - len(which),
        "listed": listed,
        "more": more,
        "advice": "" if heavy else f". Look at {them}{', ' if remedy else ''}{remedy}",
    }
    return [Finding("strangers", "note" if heavy else "warning", values)]


def expansion_off(error: float, solves: int) -> list[Finding]:
    """Doubt an expansion that misses left-out samples by a large part of the errors of the data.

    Parameters
    ----------
    error
        Root mean square error of the datum that it misses most, over the standard deviation of its error.
    solves
        Number of solves that it was fitted to.
    """
    if not error > EXPANDED:
        return []
    return [Finding("shared-expansion-off", "error" if error > 1 else "warning", {"solves": solves, "off": error})]


def reduced_off(share: float, shift: Mapping[str, float], solves: int) -> list[Finding]:
    """Say how alike the posteriors by a reduced model and by the body are.

    Parameters
    ----------
    share
        Of the draws, that their weights are worth.
    shift
        By name, how far the mean moves by the weights, in standard deviations.
    solves
        Full solves so far.
    """
    name = max(shift, key=lambda one: abs(shift[one]))
    values = {"solves": solves, "share": 100 * share, "name": name, "shift": abs(shift[name])}
    if share >= SAME:
        return [Finding("reduced-alike", "note", values)]
    return [Finding("reduced-off", "error" if share < HALF else "warning", values)]
