"""Reasons to doubt estimates, found in the samples and expansions themselves: findings by output."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from forward.findings import Finding, Severity, entries
from forward.model import FloatArray
from uq.estimators.tails import concentration, influences, missed, shown, spread

if TYPE_CHECKING:
    import xarray as xr

    from uq.estimators.moments import Estimates

TAILS = 3.0  # mean square of influences over the square of their mean size from which there is a finding, for n = 64
SPREAD = 0.7  # standard deviation of logarithms of 64 samples from which a log-normal is too heavy-tailed
HOPELESS = (1.1, 4.0)  # the same, and as `TAILS`: from both on, nothing is known about what is beyond the samples
MISSED = 0.1  # share of the variance beyond 64 samples, by how steeply the outermost ones rise
WIDENS = 0.25  # `SPREAD` grows with n to this power
KURTOSIS = 4.4  # of 64 samples, from which there is a finding about a field
SMALL = 1e-3  # of the largest standard deviation of a field, below which it is not looked at
PART = 0.05  # of the body, from which there is a finding
BEYOND = 4.0  # standard errors by which an index may exceed its bound
MATTERS = 0.01  # relative error of a standard deviation from which its tails matter
LATER = 3.0
CONCENTRATED = 3.0, 0.1  # `TAILS` of an expansion of 16 samples, and the power of n with which it grows
MOSTLY = 0.5  # of the variance
BEYOND_SAMPLES = 0.3  # share of the variance that may come from beyond the samples without a finding
ROUNDING = 1e-9
LAST_DIGITS = 1e-13  # of an output
CENTRE = 6.0  # leave-one-out errors by which an expansion may be wrong at the mean parameters
ROUGH = 0.02  # relative leave-one-out error from which the shape of an expansion matters
SEEN = 1e-3  # of the standard deviation: smaller errors there are not reported


def _of_output(code: str, severity: Severity, name: str, **values: Any) -> Finding:
    """A finding about one output."""
    return Finding(code, severity, values, about=entries([name]))


def of_tails(
    names: Sequence[str],
    values: FloatArray,
    relative: FloatArray,
    controlled: FloatArray | None = None,
    *,
    expanded: bool = False,
) -> Iterator[Finding]:
    """Find the outputs whose standard deviation is determined by few samples.

    The interval of a variance is as good as the mean square of the influences of its samples, v = (ψ − μ)² − σ² for
    plain ones, which is least accurate where it is largest. With κ = ⟨v²⟩/⟨|v|⟩², n/κ samples of equal influence would
    be as informative. For eleven distributions and 64 to 1 024 samples, 89 % or more of the intervals contained the
    truth or had κ > 3 (n/64)^0.4, as do 3 % of sets of 64 normal samples and none of 128.

    Samples do not show a tail that they have not reached, but the outermost ones show how it begins: a tenth of the
    variance beyond them (`uq.estimators.tails.missed`), for 64 samples, is a finding too. On 60 functions no other
    limits of κ, of this share and of the skewness of the influences miss less in silence with fewer false alarms: at
    most 11 % and 27 % for 64 samples, where u^-0.3 without its largest values looks like a hinge, 8 % and 1 % for 256.

    If their logarithms are about symmetric, they look
    log-normal, with tails that follow from s = std ln|ψ|: intervals from n samples that count what is beyond them
    (`uq.estimators.tails`) cover 90 % up to s = 0.7 (n/64)^0.25, and if all parameters are bounded they do so without.
    Beyond s = 1.1 (n/64)^0.25 they cover 75 % or less, which is an error if κ is large too (log-normals with s = 1.27
    or 1/u with u from 0.001 to 1: in 70 to 80 % of sets of 64 samples; exponential ones: in 3 %).

    Parameters
    ----------
    names
        Outputs.
    values
        Values (n, m) of the samples.
    relative
        Relative standard errors (m,) claimed for the standard deviations.
    controlled
        Influences (n, m) of the samples with their controls. The residuals of a good control have tails too, but
        intervals fail only at three times the κ.
    expanded
        Whether these controls are expansions, which continue beyond the samples.
    """
    n = len(values)
    yield from of_constants(names, values)
    deviations = values - values.mean(axis=0)
    plain = influences(deviations, deviations**2)
    beyond = np.where((relative > MATTERS) & (not expanded), missed(plain), 0.0)
    if controlled is not None:
        beyond = np.maximum(beyond, missed(controlled))
    largest, most = TAILS * shown(n), MISSED * shown(n)
    for i, name in enumerate(names):
        variance = deviations[:, i].var()
        kappa = concentration(plain[:, i], variance) if relative[i] > MATTERS else 0.0
        if controlled is not None:
            kappa = max(kappa, concentration(controlled[:, i], variance) / LATER)
        logarithmic = spread(values[:, i]) if relative[i] > SEEN else 0.0
        wider = (n / 64) ** WIDENS
        if logarithmic > HOPELESS[0] * wider and kappa > HOPELESS[1] / TAILS * largest:
            yield _of_output("tails-hopeless", "error", name, n=n, spread=logarithmic)
        elif logarithmic > SPREAD * wider and kappa <= largest:
            yield _of_output("tails-log-normal", "warning", name, n=n, spread=logarithmic)
        elif kappa > largest or beyond[i] > most * variance:
            kurtosis = (deviations[:, i] ** 4).mean() / variance**2
            kappa = max(kappa, concentration(plain[:, i], variance))
            yield _of_output("tails", "warning", name, n=n, worth=n / kappa, kurtosis=kurtosis)


def of_differences(
    names: Sequence[str], moved: Sequence[FloatArray], std: FloatArray, relative: FloatArray
) -> Iterator[Finding]:
    """Find the outputs whose standard deviation is determined by few samples of a difference between two meshes.

    Parameters
    ----------
    names
        Outputs.
    moved
        Influences (n, m) of the samples of every mesh, the coarsest first, which `of_tails` looks at.
    std, relative
        Standard deviations (m,) and their claimed relative errors.
    """
    errors = np.array([one.std(axis=0) / len(one) ** 0.5 for one in moved])
    for level, one in enumerate(moved[1:], 1):
        n, tails = len(one), missed(one)
        largest, most = TAILS * shown(n), MISSED * shown(n)
        matters = (relative > MATTERS) & (errors[level] > errors.max(axis=0) / 2)
        for i in np.flatnonzero(matters):
            kappa = concentration(one[:, i], std[i] ** 2)
            if kappa > largest or tails[i] > most * std[i] ** 2:
                values = {"n": n, "coarser": level - 1, "level": level, "worth": n / max(kappa, 1.0)}
                yield _of_output("tails-of-difference", "warning", names[i], **values)


def of_constants(names: Sequence[str], values: FloatArray) -> Iterator[Finding]:
    """Find the outputs whose samples (n, m) are all equal: what none of n has met has a share below 1 − 0.05^(1/n)."""
    n = len(values)
    for name, value, alike in zip(names, values[0].tolist(), equal(values).tolist(), strict=True):
        if alike:
            yield _of_output("constant", "warning", name, n=n, value=value, unmet=unmet(n))


def equal(values: FloatArray) -> NDArray[np.bool_]:
    """Of which outputs (m,) all samples (n, m) are the same, two at least: what they have not met is in no error."""
    low, high = values.min(axis=0), values.max(axis=0)
    return np.asarray((len(values) > 1) & (high - low <= LAST_DIGITS * np.maximum(np.abs(low), np.abs(high))))


def unmet(n: int) -> float:
    """Share of all cases that none of n independent samples may have met, at 95 %."""
    return float(1 - 0.05 ** (1 / n))


def of_field_tails(
    sums: FloatArray, n: int, relative: FloatArray, volumes: FloatArray | None = None
) -> Iterator[Finding]:
    """Find that few samples decide the standard deviation of the displacements in a part of the body.

    As `of_tails` by the kurtosis alone, which sums over samples tell: of sets of 64 normal samples 3 % pass its limit.

    Parameters
    ----------
    sums
        Sums (4, 3 nodes) of the powers 1 to 4 of the deviation from a reference over the samples.
    n
        Number of samples.
    relative
        Standard errors (3 nodes,) that are claimed for the standard deviations, over these.
    volumes
        Share (nodes,) of the body that each node stands for; by default all count alike.
    """
    m1, m2, m3, m4 = sums / n
    variance = np.maximum(m2 - m1**2, 0.0)
    fourth = m4 - 4 * m1 * m3 + 6 * m1**2 * m2 - 3 * m1**4
    # Rounding aside, and what moves little beside the rest, or is claimed well all the same.
    counts = (variance > ROUNDING * m2) & (variance > SMALL**2 * variance.max(initial=0.0)) & (relative > MATTERS)
    kurtosis = np.where(counts, fourth / np.where(counts, variance, 1.0) ** 2, 0.0).reshape(-1, 3).max(axis=1)
    heavy = kurtosis > KURTOSIS * shown(n)
    share = float(np.average(heavy, weights=volumes))
    if share > PART:
        yield Finding("tails-of-field", "warning", {"n": n, "share": share, "kurtosis": kurtosis.max()})


def of_control(names: Sequence[str], control: str, found: Estimates) -> Iterator[Finding]:
    """Find the outputs whose control has been dropped."""
    for i, name in enumerate(names):
        dropped = [
            moment
            for moment, beta in (("mean", found.coefficient), ("standard deviation", found.second_coefficient))
            if beta[i] == 0
        ]
        if dropped and found.relative_std_error[i] > MATTERS:
            be = "are" if len(dropped) > 1 else "is"
            yield _of_output("control-dropped", "note", name, control=control, dropped=" and ".join(dropped), be=be)


def of_expansion(
    names: Sequence[str], relative: FloatArray, trusted: float, nothing: float, samples: int
) -> Iterator[Finding]:
    """Find the outputs that an expansion does not explain, from its relative leave-one-out errors (m,)."""
    for name, error in zip(names, relative.tolist(), strict=True):
        if error > nothing:
            yield _of_output("expansion-explains-nothing", "error", name, error=error, samples=samples)
        elif error > trusted:
            yield _of_output("expansion-rough", "warning", name, error=error, samples=samples)


def of_gradients(names: Sequence[str], off: FloatArray) -> Iterator[Finding]:
    """Find the outputs whose gradients say other values, off by these shares (m,) of their standard deviations."""
    for name, share in zip(names, off.tolist(), strict=True):
        if share > SEEN:
            yield _of_output("gradients-contradict", "warning", name, share=share)


def of_shape(names: Sequence[str], drawn: FloatArray, relative: FloatArray, samples: int) -> Iterator[Finding]:
    """Find rough expansions, of relative leave-one-out errors (m,), whose variance comes from little of the range.

    By κ of their values (n, m) at many points, as in `of_tails`: near the end of a range an expansion rises less than a
    pole does, and few samples are where the two part. Of eight functions with such ends and 16 solves κ is 3 to 6, of
    kinks, oscillations and steps 1.3 to 4.
    """
    deviations = drawn - drawn.mean(axis=0)
    moved = influences(deviations, deviations**2)
    largest = CONCENTRATED[0] * max(1.0, samples / 16) ** CONCENTRATED[1]
    for i, (name, error) in enumerate(zip(names, relative.tolist(), strict=True)):
        kappa = concentration(moved[:, i], float(deviations[:, i].var())) if error > ROUGH else 0.0
        if kappa > largest:
            yield _of_output("expansion-shape", "warning", name, kappa=kappa, error=error)


def of_reach(
    names: Sequence[str], outside: FloatArray, relative: FloatArray, rest: FloatArray, samples: int
) -> Iterator[Finding]:
    """Find outputs with a large share (m,) of the variance from beyond the samples.

    And errors (m,) at samples left out of the fit; where most is from beyond, errors of the `rest` (m,) that it leaves.
    """
    for name, share, left, whole in zip(names, outside.tolist(), relative.tolist(), rest.tolist(), strict=True):
        error = max(left, whole) if share > MOSTLY else left
        if share > BEYOND_SAMPLES and error > SEEN:
            yield _of_output("expansion-reach", "warning", name, share=share, samples=samples, error=error)


def of_centre(
    names: Sequence[str], values: FloatArray, errors: FloatArray, loo: FloatArray, std: FloatArray
) -> Iterator[Finding]:
    """Find the outputs with a large error (m,) of the expansion at the mean parameters, where the model was solved."""
    rounding = LAST_DIGITS * np.abs(values)
    limits = np.maximum(np.maximum(CENTRE * loo, SEEN * std), rounding)
    for name, error, left, limit in zip(names, np.abs(errors).tolist(), loo.tolist(), limits.tolist(), strict=True):
        if error > limit:
            yield _of_output("expansion-at-mean", "warning", name, error=error, left=left)


def of_field(rest: float, trusted: float, nothing: float) -> Iterator[Finding]:
    """Find whether the error of the expansion of the displacement field is too large, over the standard deviation."""
    if rest > nothing:
        yield Finding("field-expansion-explains-nothing", "error", {"rest": rest})
    elif rest > trusted:
        yield Finding("field-expansion-rough", "warning", {"rest": rest})


def of_indices(dataset: xr.Dataset) -> Iterator[Finding]:
    """Find indices that exceed their bounds by more than `BEYOND` standard errors: none may, whatever the model."""
    names = dataset["parameter"].to_numpy().tolist()
    outputs = dataset["output"].to_numpy().tolist() if "sobol_first" in dataset else []
    everywhere = ["the displacement field"] if "field_sobol_first" in dataset else []
    for of in outputs + everywhere:
        by, prefix = (dataset.sel(output=of), "") if of in outputs else (dataset, "field_")

        def known(name: str, otherwise: float, by: xr.Dataset = by, prefix: str = prefix) -> FloatArray:
            here = by.get(prefix + name)
            return np.full(len(names), otherwise) if here is None else here.to_numpy()

        S, S_error = known("sobol_first", np.nan), known("sobol_first_error", np.nan)
        T, T_error = known("sobol_total", np.nan), known("sobol_total_error", np.nan)
        bound, bound_error = known("total_bound", np.inf), known("total_bound_error", 0.0)
        none, one = np.zeros_like(S), np.ones_like(S)
        checks = (
            ("The first-order index", S, S_error, -1, "less than", none),
            ("The first-order index", S, np.hypot(S_error, T_error), 1, "more than the total one,", T),
            ("The total index", T, T_error, 1, "more than", one),
            ("The total index", T, np.hypot(T_error, bound_error), 1, "more than its bound by derivatives,", bound),
        )
        for what, value, error, sign, excess, limit in checks:
            for i in np.flatnonzero(sign * (value - limit) > BEYOND * error + ROUNDING):
                times = min(abs(value[i] - limit[i]) / max(error[i], 1e-300), 999)
                values = {"what": what, "parameter": names[i], "value": value[i], "excess": excess, "limit": limit[i]}
                yield _of_output("index-out-of-bounds", "error", of, **values, times=times)
        together = float(np.sqrt((S_error**2).sum()))
        if S.sum() > 1 + BEYOND * together + ROUNDING:
            yield _of_output("indices-add-up", "error", of, total=S.sum(), together=together)
