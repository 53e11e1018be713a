"""What samples and expansions say against their own estimates: findings by output, in words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from forward.model import Finding, FloatArray
from uq.estimators.tails import spread

if TYPE_CHECKING:
    import xarray as xr

    from uq.estimators.moments import Estimates

TAILS = 3.0  # mean square of influences over the square of their mean size, from which a finding is made: of n = 64
SPREAD = 0.7  # standard deviation of logarithms of 64 samples from which a log-normal is too heavy
HOPELESS = (1.1, 4.0)  # the same, and as `TAILS`, from which together nothing is known of what is beyond
WIDENS = 0.25  # it grows with n to this power
GROWTH = 0.4  # it grows with n to this power: among more samples more of a tail is seen
BEYOND = 4.0  # standard errors by which an index may pass its bound
MATTERS = 0.01  # error of a standard deviation from which its tails matter
LATER = 3.0
BEYOND_SAMPLES = 0.3  # share of the variance that may come from beyond the samples without a word
ROUNDING = 1e-9
LAST_DIGITS = 1e-13  # of an output
CENTRE = 6.0  # leave-one-out errors that an expansion may err by at the mean parameters
SEEN = 1e-3  # of the standard deviation: errors there that are not worth a word


def influences(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return by how much each sample (n, m) moves the variance, from samples of the first and the second moment."""
    moved = second - 2 * first.mean(axis=0) * first
    return np.asarray(moved - moved.mean(axis=0))


def of_tails(
    names: Sequence[str], values: FloatArray, relative: FloatArray, controlled: FloatArray | None = None
) -> Iterator[Finding]:
    """Find the outputs of which few samples decide the standard deviation.

    The interval of a variance is as good as the mean square of the influences of its samples, v = (ψ − μ)² − σ² for
    plain ones, which is known worst where it is largest. With κ = ⟨v²⟩/⟨|v|⟩², n/κ samples of equal influence would
    know as much. Of eleven distributions and 64 to 1 024 samples, 89 % or more of the intervals held the truth or had
    κ > 3 (n/64)^0.4, which 3 % of sets of 64 normal samples have and none of 128.

    Samples do not show a tail that they have not met. But where their logarithms are about symmetric, they are
    log-normal as far as they say, and these spread by s = std ln|ψ| have tails that are known: intervals from n samples
    that count what is beyond them (`uq.estimators.tails`) cover 90 % up to s = 0.7 (n/64)^0.25, and where all
    parameters have ends they cover so without. Beyond s = 1.1 (n/64)^0.25 they cover 75 % and less, an error where κ
    says so too (log-normals with s = 1.27 or 1/u with u from 0.001 to 1: in 70 to 80 % of sets of 64 samples;
    exponential ones: in 3 %).

    Parameters
    ----------
    names
        Outputs.
    values
        Values (n, m) of the samples.
    relative
        Standard errors (m,) that are claimed for the standard deviations, over these.
    controlled
        Influences (n, m) of the samples with their controls. What a good control leaves has tails too, but intervals
        fail three times later.
    """
    n = len(values)
    deviations = values - values.mean(axis=0)
    plain = influences(deviations, deviations**2)
    largest = TAILS * max(1.0, n / 64) ** GROWTH
    for i, name in enumerate(names):
        variance = deviations[:, i].var()
        kappa = _concentration(plain[:, i], variance) if relative[i] > MATTERS else 0.0
        if controlled is not None:
            kappa = max(kappa, _concentration(controlled[:, i], variance) / LATER)
        logarithmic = spread(values[:, i]) if relative[i] > SEEN else 0.0
        more = (n / 64) ** WIDENS
        if logarithmic > HOPELESS[0] * more and kappa > HOPELESS[1] / TAILS * largest:
            yield Finding(
                "error",
                f"The standard deviation of {name} cannot be trusted: its {n} samples look log-normal, with logarithms "
                f"that spread by {logarithmic:.2g}, and most sets of so few miss the larger values that decide it. "
                "Take many times more samples, or the logarithm as output.",
            )
        elif logarithmic > SPREAD * more and kappa <= largest:
            yield Finding(
                "warning",
                f"The {n} samples of {name} look log-normal, with logarithms that spread by {logarithmic:.2g}: few "
                "decide the standard deviation, whose 95 % interval may hold the truth less often. "
                "More samples tell.",
            )
        elif kappa > largest:
            kurtosis = (deviations[:, i] ** 4).mean() / variance**2
            yield Finding(
                "warning",
                f"The standard deviation of {name} rests on few of its {n} samples, which count as {n / kappa:.0f} "
                f"(their kurtosis is {kurtosis:.3g}): its 95 % interval may hold the truth less often, since larger "
                "values may be missing. More samples tell.",
            )


def _concentration(moved: FloatArray, variance: float) -> float:
    """Mean square of influences (n,) over the square of their mean size, 0 where all are rounding."""
    size = float(np.abs(moved).mean())
    return float((moved**2).mean()) / size**2 if size > ROUNDING * variance else 0.0


def of_control(names: Sequence[str], control: str, found: Estimates) -> Iterator[Finding]:
    """Find the outputs of which a control has been dropped."""
    for i, name in enumerate(names):
        dropped = [
            moment
            for moment, beta in (("mean", found.coefficient), ("standard deviation", found.second_coefficient))
            if beta[i] == 0
        ]
        if dropped and found.relative_std_error[i] > MATTERS:
            yield Finding(
                "note",
                f"The {control} control of {name} leaves more scatter than there is: its {' and '.join(dropped)} "
                f"{'are' if len(dropped) > 1 else 'is'} estimated without.",
            )


def of_expansion(
    names: Sequence[str], relative: FloatArray, trusted: float, nothing: float, samples: int
) -> Iterator[Finding]:
    """Find the outputs that an expansion does not explain, from its relative leave-one-out errors (m,)."""
    for name, error in zip(names, relative.tolist(), strict=True):
        if error > nothing:
            yield Finding(
                "error",
                f"The expansion of {name} explains nothing: at samples that it has not seen it errs by {error:.3g} of "
                f"the standard deviation. Mean, standard deviation and quantiles are those of the {samples} samples; "
                "there are no Sobol' indices, and the expansion must not be used. Take more samples, or a method "
                "without an expansion.",
            )
        elif error > trusted:
            yield Finding(
                "warning",
                f"The expansion of {name} errs by {error:.3g} of the standard deviation at samples that it has not "
                f"seen. Mean, standard deviation and quantiles are those of the {samples} samples, with the expansion "
                "as control; Sobol' indices and the expansion itself are rough.",
            )


def of_reach(names: Sequence[str], outside: FloatArray, relative: FloatArray, samples: int) -> Iterator[Finding]:
    """Find the outputs of which much of the variance (m,) comes from beyond the samples, and errs (m,) among them."""
    for name, share, error in zip(names, outside.tolist(), relative.tolist(), strict=True):
        if share > BEYOND_SAMPLES and error > SEEN:
            yield Finding(
                "warning",
                f"{share:.0%} of the variance of {name}, as the expansion has it, comes from where parameters are "
                f"beyond all {samples} samples; among them it errs by {error:.2g} of the standard deviation, which may "
                "be further off than its interval says. More samples tell.",
            )


def of_centre(
    names: Sequence[str], values: FloatArray, errors: FloatArray, loo: FloatArray, std: FloatArray
) -> Iterator[Finding]:
    """Find the outputs that an expansion misses (m,) at the mean parameters, where there was a solve of its own."""
    rounding = LAST_DIGITS * np.abs(values)
    limits = np.maximum(np.maximum(CENTRE * loo, SEEN * std), rounding)
    for name, error, left, limit in zip(names, np.abs(errors).tolist(), loo.tolist(), limits.tolist(), strict=True):
        if error > limit:
            yield Finding(
                "warning",
                f"At the mean parameters, a solve that the fit has not seen, the expansion of {name} errs by "
                f"{error:.2g}; its leave-one-out error is {left:.2g}. There may be more between the samples than "
                "they show: take more.",
            )


def of_field(rest: float, trusted: float, nothing: float) -> Iterator[Finding]:
    """Find that an expansion leaves more than a share of the standard deviation of the displacement field."""
    if rest > nothing:
        yield Finding(
            "error",
            f"The expansion of the displacement field explains nothing: at samples that it has not seen it errs by "
            f"{rest:.2g} of the standard deviation. There are no Sobol' indices of the field, and its moments must not "
            "be used. Take more samples, or a method without an expansion.",
        )
    elif rest > trusted:
        yield Finding(
            "warning",
            f"The expansion of the displacement field errs by {rest:.2g} of its standard deviation: its moments, its "
            "Sobol' indices and fields that are predicted by it are rough. Take more samples.",
        )


def of_indices(dataset: xr.Dataset) -> Iterator[Finding]:
    """Find indices that pass their own bounds by more than `BEYOND` standard errors: none may, whatever the model."""
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
                here = f"{what} of {names[i]} for {of}, {value[i]:.3g}, is {excess} {limit[i]:.3g}"
                yield Finding("error", f"{here}, by {times:.0f} standard errors: wrong. Do not use it; report it.")
        together = float(np.sqrt((S_error**2).sum()))
        if S.sum() > 1 + BEYOND * together + ROUNDING:
            yield Finding(
                "error",
                f"The first-order indices for {of} add up to {S.sum():.3g} ± {together:.2g}, more than 1: wrong. "
                "Do not use them; report it.",
            )
