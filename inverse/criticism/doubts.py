"""What makes a posterior doubtful: its distance from the prior, ends of ranges, noise, outliers, a model's stand-in.

And what the error of a mesh makes doubtful: a posterior, or the comparison of models on meshes of their own, judging by
finer meshes that were solved on. Each function returns findings that have a few words for the verdict. None of them
needs a solve.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.findings import Finding
from forward.model import FloatArray
from forward.readable import place, told
from uq.inputs.distributions import Distribution

if TYPE_CHECKING:
    import xarray as xr

FAR, FARTHER = 3.0, 4.0  # prior deviations from the centre for a warning, an error
UNLIKELY, IMPOSSIBLE = 1e-3, 1e-6  # probabilities of a joint distance for a warning, an error
END, CROWDED = 0.02, 5.0  # share of the prior at an end of a range, and how many times that the posterior has there
MISSED = 0.01  # of the posterior, next to an end of a polynomial, where it may miss as much beyond
HEAVY = 0.25  # share of a variance that 1 % of the probability makes, above which deviations were off by a third
NOISE_FAR = 3.0  # factor between the inferred and the stated size of the errors
NOTHING_SEEN = 0.5  # size of the errors over that of the data above which the model explains nothing
STRANGE = 0.01  # probability that any of all data is as far out as an outlier
LISTED = 5
UNSEEN, SOME = 0.9, 0.05  # of the prior's deviation, above which data say little; share of vertices that is told
SAME, HALF = 0.9, 0.5  # what weights between posteriors are worth where these are alike, and where they are not
EXPANDED = 0.3  # error of an expansion over that of a datum that makes intervals wider by more than 4 %
LINEAR = 2.0  # posterior deviations up to which a first-order shift of ln Z is about right
MOVED = 1.0  # by which a finer mesh moves ln Z, "not worth more than a bare mention" (Kass and Raftery 1995)
# Shift by the mesh, in posterior deviations: intervals of 95 % still hold 92 %; they hold half.
BIASED, WRONG = 0.5, 2.0
EXTREME, DECIDES = 20.0, 0.8  # shift by a correction, and share of the deviations that it makes, that are doubted
UNSETTLED = 3.0  # error of the mesh over the noise from which on a correction that has not settled is not to be trusted
# Error of the mesh over the noise up to which intervals of corrected fields were counted; of other bodies than these.
OF_FIELD, OF_OTHERS = 4.0, 0.3
# The same of few parameters of bodies from files, whose cells are divided: 92 % of intervals hold at 1.6, 78 % at 2.9.
OF_FILES = 2.0
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
    """Doubt parameters whose mode or mean (d,) is far from the prior, each by name, and all of them together.

    The squared distance of the mode from the centre, in so many directions that the data determine, is χ² distributed
    if the truth is drawn from the prior. SI units are given by name, of those that have one.
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


def learnt(one: xr.Dataset) -> Finding:
    """Say what the errors of a model are that were learnt."""
    size, spread = (float(np.sqrt((one[name] ** 2).mean())) for name in ("model_error", "model_error_std"))
    same = "" if one["model_error_follows"] else ", and taken to be the same whatever the unknowns are"
    values = {"size": size, "spread": spread, "solves": int(one["model_error_solves"]), "same": same}
    return Finding("model-error-learnt", "note", values)


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


def heavy_tails(names: Sequence[str], outermost: FloatArray) -> list[Finding]:
    """Doubt standard deviations that rest on the outermost 1 % of the probability, by its shares (c,) of variances."""
    return [
        Finding("heavy-tail", "warning" if share > HALF else "note", {"name": name, "share": 100 * share})
        for name, share in zip(names, outermost.tolist(), strict=True)
        if share > HEAVY
    ]


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
    """Doubt an inferred factor on the stated deviations sigma (n,) of data (n,), where so much is expected."""
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
    """Doubt outliers, by residuals over the errors (n,) and the share (n,) of each datum in its own prediction.

    Where heavy tails of the errors are allowed for already, it is a note. A remedy is what can be done besides looking.
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


def tails_cut(share: float) -> list[Finding]:
    """Doubt intervals of a polynomial whose range cuts off tails, by the share of the posterior that is missing."""
    return [Finding("tails-cut", "warning", {"share": 100 * share})] if share > MISSED else []


def expansion_off(error: float, solves: int) -> list[Finding]:
    """Doubt an expansion, of so many solves, that misses left-out samples by a large part of the errors of the data.

    The error is that of the datum that it misses most (root mean square), over the standard deviation of its error.
    """
    if not error > EXPANDED:
        return []
    return [Finding("shared-expansion-off", "error" if error > 1 else "warning", {"solves": solves, "off": error})]


def reduced_off(share: float, shift: Mapping[str, float], solves: int) -> list[Finding]:
    """Say how alike the posteriors by a reduced model and by the body are, after so many full solves.

    The share is what weights of draws are worth; by them the mean of a parameter, by name, shifts by so many
    deviations.
    """
    name = max(shift, key=lambda one: abs(shift[one]))
    values = {"solves": solves, "share": 100 * share, "name": name, "shift": abs(shift[name])}
    if share >= SAME:
        return [Finding("reduced-alike", "note", values)]
    return [Finding("reduced-off", "error" if share < HALF else "warning", values)]


# --- meshes -----------------------------------------------------------------------------------------------------------


def of_mesh(
    one: xr.Dataset, error: FloatArray, *, settled: bool, counted: bool = True, from_file: bool = False
) -> list[Finding]:
    """Say what the mesh does to a data set or group of data, and doubt it where that, or its correction, decides.

    Parameters
    ----------
    one
        Results: whether finer meshes were looked at, whether the mesh is corrected, and what that does to unknowns.
    error
        What finer meshes add to the measured data (n,), over the noise.
    settled
        Whether the error at the mode is the one that was corrected.
    counted, from_file
        Whether it was counted how often intervals of fields of such bodies hold; whether the mesh is that of a file.
    """
    corrected = bool(one["mesh_corrected"])
    if not corrected and not bool(one["mesh_checked"]):
        return [Finding("mesh-not-checked", "warning", {"why": str(one["mesh_why"].item())})]
    nodes = one["stiffness_mesh_shift"].to_numpy() if "stiffness_mesh_shift" in one else np.zeros(0)
    size, most = float(np.sqrt((error**2).mean())), float(np.abs(error).max())
    listed, worst = _moves(dict(zip(map(str, one.parameter.values), one["mesh_shift"].to_numpy(), strict=True)), nodes)
    values: dict[str, Any] = {"size": size, "most": most, "listed": listed}
    if not corrected:
        values["worst"] = worst
        if worst <= BIASED:
            return [Finding("mesh-moves-little", "note", values)]
        return [Finding("mesh-too-coarse", "error" if worst > WRONG else "warning", values)]
    left = one["mesh_left"].to_numpy()
    values["uncertain"] = uncertain = float(left[np.isfinite(left)].max(initial=0.0))
    if not settled:
        bad = worst > WRONG and size > UNSETTLED
        return [Finding("mesh-correction-unsettled", "error" if bad else "warning", values)]
    if decides(worst, uncertain):
        return [Finding("mesh-correction-decides", "warning", values)]
    if len(nodes) and size > (OF_FIELD if counted else OF_OTHERS):
        return [Finding("mesh-correction-of-field", "warning", values)]
    if from_file and not len(nodes) and beyond_files(size):
        return [Finding("mesh-correction-of-file", "warning", values)]
    return [Finding("mesh-corrected", "note", values)]


def not_estimable(names: Sequence[str]) -> list[Finding]:
    """Doubt data of outputs, by name, whose error of the mesh nothing tells."""
    return [Finding("mesh-not-estimable", "warning", {"names": ", ".join(names)})] if names else []


def decides(shift: Any, left: Any) -> Any:
    """Whether a correction of the mesh decides on a result, by its largest shift and what is uncertain of it."""
    return (shift > EXTREME) | (left > DECIDES)


def beyond_files(size: Any) -> Any:
    """Whether errors of this size, over the noise, are more than corrections on meshes of files hold for."""
    return size > OF_FILES


def _moves(shifts: Mapping[str, float], nodes: FloatArray) -> tuple[str, float]:
    """Shifts of unknowns in words, the largest first, and its size."""
    moved = {name: float(shift) for name, shift in shifts.items() if np.isfinite(shift)}
    everywhere = float(np.sqrt((nodes**2).mean())) if len(nodes) else 0.0
    worst = max([abs(shift) for shift in moved.values()] + [everywhere], default=0.0)
    ordered = sorted(moved.items(), key=lambda item: -abs(item[1]))
    listed = [f"{name} {shift:+.2g}".replace(" -", " −") for name, shift in ordered]
    listed += [f"values at the vertices {everywhere:.2g} (root mean square)"] if len(nodes) else []
    return ", ".join(listed), worst


def meshes_too_coarse(
    log_evidence: Mapping[str, float], added: Mapping[str, float], shifts: Mapping[str, float]
) -> list[Finding]:
    """Doubt the meshes of candidates, by what finer ones add to their ln Z (with the prior odds), all by name.

    That is to first order, and counts as zero where it is NaN; an unknown shifts by so many posterior deviations at
    most.
    """
    known = {name: change for name, change in added.items() if np.isfinite(change)}
    if not known:
        return []
    there = {name: value + known.get(name, 0.0) for name, value in log_evidence.items()}
    best, other = max(log_evidence, key=log_evidence.__getitem__), max(there, key=there.__getitem__)
    listed = ", ".join(f"{name} {change_in_words(change, shifts[name])}" for name, change in known.items())
    settled = all(certain(change, shifts[name]) for name, change in known.items())
    values = {"listed": listed, "best": best, "other": other, "limit": MOVED}
    if best != other:
        return [Finding("evidence-decided-by-meshes", "error", values)]
    return [Finding("evidence-settled", "note", values) if settled else Finding("evidence-moves", "warning", values)]


def meshes_of_files(which: Sequence[str]) -> list[Finding]:
    """Doubt evidences of candidates, by name, on meshes of files which err by more than corrections hold for."""
    return [Finding("meshes-of-files", "warning", {"models": ", ".join(which), "limit": OF_FILES})] if which else []


def meshes_not_alike(corrected: Sequence[str], unknown: Sequence[str]) -> list[Finding]:
    """Doubt evidences of candidates, by name, of which some are corrected for their meshes and some not looked at."""
    if not corrected or not unknown:
        return []
    values = {"corrected": ", ".join(corrected), "unknown": ", ".join(unknown)}
    return [Finding("meshes-not-alike", "warning", values)]


def certain(change: Any, shift: Any) -> Any:
    """Whether a change of ln Z is small, and known: to first order, at shifts of 3 deviations, it was off by 1.6."""
    return (np.abs(change) <= MOVED) & (np.abs(shift) <= LINEAR)


def change_in_words(change: float, shift: float) -> str:
    """Write a first-order change of ln Z, given the largest shift of an unknown (posterior deviations)."""
    if abs(shift) <= LINEAR:
        return f"about {change:+.2g}"
    return (
        f"a lot ({change:+.2g} to first order, which does not hold where unknowns move by {abs(shift):.2g} deviations)"
    )
