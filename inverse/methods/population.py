"""The distribution of parameters over specimens as a method: from the posteriors of a batch, or of groups of data."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field

from forward.findings import Finding
from forward.model import FloatArray
from forward.readable import percent
from forward.settings import Settings, nearest
from inverse.low_dimensional.population import Fit, Hyperprior, Specimen, fitted
from uq.evaluation.evaluate import ALL_AGAIN, Steps
from uq.findings import add
from uq.inputs.distributions import Distribution, LogNormal, Normal, TruncatedNormal
from uq.inputs.draws import Draws
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points

if TYPE_CHECKING:
    import xarray as xr

LEAST = 20.0  # effective size of a specimen's draws under the population, below which its estimates are rough
ROUNDS = 6  # of fits to draws that are made again
WIDER = 1.5  # priors with which specimens are drawn again, over the distribution of a new specimen
MIXED = 100.0  # independent draws of the population, below which its quantiles are rough
FEW = 4  # specimens, below which the prior decides how wide a population is
PRIOR = 4096  # points that stand for the prior
TELLS = 0.01  # of a specimen's deviation, by which an error that all share has to move it to be told
BEYOND = 0.01  # of new specimens, that lie where none can be found, from which on it is told
QUANTILES = (0.025, 0.5, 0.975)

# Name of a specimen, prior → its draws, or None and why.
Again = Callable[[str, Inputs], "tuple[Draws | None, str]"]


class Population(Settings):
    """Distribution of parameters over specimens.

    Parameters
    ----------
    source
        Results of ``invert`` with several data sets, or of ``select`` with several groups of data: the specimens.
    model
        The candidate of ``select``: its name, or "best".
    study
        The file of the study that the source is of, if its data stand in files beside it: where few draws of a specimen
        lie in the population, it is inverted again, from these data.
    distribution
        "log-normal" (parameters of one sign; of negative ones their size) or "normal", with covariance.
    covariates
        What specimens differ in that may move their means, linearly: for each, the numbers of all specimens, or words,
        by their names: ``grade = { one = 1, two = 3 }``, ``region = { one = "cortex", two = "thalamus" }``.
    own
        What the source states as uncertain (names under ``uncertain``, or groups) and errs in each specimen by itself,
        as its thickness may; all else errs alike in all, as a device does.
    new
        Covariates of the new specimen; those that are not given are as on average.
    draws
        Draws of the population, of each specimen and of new ones that are kept.
    seed
        Of all draws.
    digest
        Hash of the source, filled in when it is read.
    """

    kind: Literal["population"] = "population"
    source: str = Field(min_length=1)
    model: str | None = None
    study: str | None = None
    distribution: Literal["normal", "log-normal"] = "log-normal"
    covariates: dict[str, dict[str, float | str]] = Field(default={})
    own: tuple[str, ...] = ()
    new: dict[str, float | str] = Field(default={})
    draws: Annotated[int, Field(ge=100, le=100_000)] = 1000
    seed: Annotated[int, Field(ge=0)] = 0
    digest: str = ""

    def run(
        self,
        posteriors: Mapping[str, Draws],
        prior: Inputs,
        again: Again | None = None,
        steps: Steps = ALL_AGAIN,
        shared: Mapping[str, FloatArray] = MappingProxyType({}),
    ) -> xr.Dataset:
        """Fit the population, without solving anything but for specimens whose draws do not reach it.

        All draws are of the same parameters, with the same prior. Specimens are drawn again under another prior; None
        if that cannot be done. Fits may be kept as `steps`. What is `shared` moves all by deviations (d,) of their
        posteriors, of its own. The variables are those of docs/results.md. Raises `ValueError` if there is only one
        specimen, or a parameter of a log-normal distribution has both signs.
        """
        import xarray as xr

        scale = Scale.of(self.distribution, posteriors)
        columns = Columns.of(self.covariates, list(posteriors))
        x, at = (columns.values, columns.row(self.new)) if self.covariates else (None, None)
        reached = self._reached(posteriors, prior, scale, x, again, steps)
        fit, estimates = reached.fit, reached.estimates
        alike = {name: one for name, one in shared.items() if name not in self.own}
        if alike:
            widths = [np.sqrt(np.diag(scale.specimen(one, prior).covariance)) for one in posteriors.values()]
            moves = np.array(list(alike.values())) * scale.signs * np.median(widths, axis=0)
            errors = np.random.default_rng([self.seed, 3]).standard_normal((len(fit.mean), len(alike)))
            fit = replace(fit, mean=fit.mean + errors @ moves)
        new = scale.back(fit.predictive(self.seed, at))
        own = np.array([_moments(one) for one in posteriors.values()])
        together = np.array([scale.back(z) for z, _ in estimates])
        by, each = ("parameter",), ("specimen", "parameter")
        pair = ("parameter", "partner")
        correlations = fit.covariance / (fit.std[:, :, None] * fit.std[:, None, :])
        found = xr.Dataset(
            {
                "location": (("draw_number", *by), fit.mean),
                "scale": (("draw_number", *by), fit.std),
                "covariance": (("draw_number", *pair), fit.covariance),
                "location_mean": (by, fit.mean.mean(axis=0)),
                "location_std": (by, fit.mean.std(axis=0)),
                "scale_quantiles": (("quantile", *by), np.quantile(fit.std, QUANTILES, axis=0)),
                "correlation_quantiles": (("quantile", *pair), np.quantile(correlations, QUANTILES, axis=0)),
                "typical_quantiles": (("quantile", *by), np.quantile(scale.back(fit.at(at)), QUANTILES, axis=0)),
                "new_quantiles": (("quantile", *by), np.quantile(new, QUANTILES, axis=0)),
                "population_draw": (("draw_number", *by), new),
                "population_effective": ((), fit.effective),
                "specimen_draw": (("specimen", "draw_number", "parameter"), together),
                "own_mean": (each, own[:, 0]),
                "own_std": (each, own[:, 1]),
                "specimen_mean": (each, together.mean(axis=1)),
                "specimen_std": (each, together.std(axis=1)),
                "specimen_lower": (each, np.quantile(together, QUANTILES[0], axis=1)),
                "specimen_upper": (each, np.quantile(together, QUANTILES[2], axis=1)),
                "specimen_effective": (("specimen",), np.array([size for _, size in estimates])),
                "specimen_redrawn": (("specimen",), np.array([reached.times.get(name, 0) for name in posteriors])),
                "logarithmic": ((), int(scale.logarithmic)),
            },
            {
                "parameter": list(prior_names(posteriors)),
                "partner": list(prior_names(posteriors)),
                "specimen": list(posteriors),
                "quantile": list(QUANTILES),
            },
        )
        if alike:
            found = found.assign(shared_shift=(("shared", "parameter"), moves)).assign_coords(shared=list(alike))
            largest = {name: (np.abs(by).max(), int(np.abs(by).argmax())) for name, by in alike.items()}
            told = largest.items()
            listed = [f"{name} moves {prior.names[k]} by {by:.2g}" for name, (by, k) in told if by >= TELLS]
            add(found, *([Finding("population-shared", "warning", {"listed": "; ".join(listed)})] if listed else ()))
        if fit.slopes is not None:
            by_covariate = ("covariate", "parameter")
            slopes = np.swapaxes(fit.slopes, 1, 2)
            found = found.assign(
                slope=(("draw_number", *by_covariate), slopes),
                slope_quantiles=(("quantile", *by_covariate), np.quantile(slopes, QUANTILES, axis=0)),
                covariate_value=(("specimen", "covariate"), columns.values + columns.means),
            ).assign_coords(covariate=list(columns.names))
        add(found, *_findings(reached, list(posteriors)), *_beyond(fit, prior_names(posteriors)))
        return found

    def _reached(
        self,
        posteriors: Mapping[str, Draws],
        prior: Inputs,
        scale: Scale,
        x: FloatArray | None,
        again: Again | None,
        steps: Steps,
    ) -> _Reached:
        """Fit the population, and draw those specimens again of which few draws lie there, until there are none."""
        names, parameters, hyperprior = list(posteriors), prior_names(posteriors), scale.of_prior(prior)
        specimens = [scale.specimen(one, prior) for one in posteriors.values()]
        times: dict[str, int] = {}
        refused: dict[str, str] = {}
        for left in reversed(range(ROUNDS)):
            kept = steps.rows(f"densities, {left} more")
            fit = fitted(specimens, hyperprior, self.draws, self.seed, covariates=x, kept=kept)
            estimates = [fit.estimates(i, self.seed) for i in range(len(names))]
            low = [i for i, (_, size) in enumerate(estimates) if size < LEAST and names[i] not in refused]
            if again is None or not low or not left:
                break
            for i in low:
                wider = scale.inputs(parameters, fit.predictive(self.seed, None if x is None else x[i]), hyperprior)
                found, why = again(names[i], wider)
                if found is None:
                    refused[names[i]] = why
                    continue
                order = [found.names.index(name) for name in parameters]
                specimens[i] = scale.specimen(replace(found, names=parameters, values=found.values[:, order]), wider)
                times[names[i]] = times.get(names[i], 0) + 1
        return _Reached(fit, estimates, times, refused)


@dataclass(frozen=True)
class _Reached:
    """A population, the draws of each specimen under it with their effective sizes, and what was drawn again.

    Attributes
    ----------
    times
        How often specimens were drawn again, by name.
    refused
        Why others could not be.
    """

    fit: Fit
    estimates: list[tuple[FloatArray, float]]
    times: dict[str, int]
    refused: dict[str, str]


@dataclass(frozen=True)
class Columns:
    """Covariates as numbers: one column for each, or for each word but the first in the alphabet.

    Attributes
    ----------
    names
        Of the columns (q): ``grade``, or ``region = thalamus``.
    values
        Numbers (n, q) of the specimens, less their means.
    means
        (q,).
    words
        For each column the covariate, and the word that is 1 there; None for numbers.
    """

    names: tuple[str, ...]
    values: FloatArray
    means: FloatArray
    words: tuple[tuple[str, str | None], ...]

    @classmethod
    def of(cls, covariates: Mapping[str, Mapping[str, float | str]], specimens: Sequence[str]) -> Columns:
        """Return those of specimens.

        Raises `ValueError` if a specimen has none, one is unknown, a covariate mixes numbers and words or is the same
        for all, or there are too many of them.
        """
        words: list[tuple[str, str | None]] = []
        columns: list[list[float]] = []
        for name, given in covariates.items():
            for one in given:
                if one not in specimens:
                    raise ValueError(f"covariates.{name}: '{one}' is not a specimen; {nearest(one, list(specimens))}")
            missing = [one for one in specimens if one not in given]
            if missing:
                raise ValueError(f"covariates.{name}: nothing is said of {', '.join(missing)}, expected all specimens")
            values = [given[one] for one in specimens]
            texts = {value for value in values if isinstance(value, str)}
            if texts and len(texts) < len(set(values)):
                raise ValueError(f"covariates.{name}: numbers and words, expected either")
            if len(set(values)) == 1:
                raise ValueError(f"covariates.{name}: the same for all specimens, which says nothing on them")
            for word in sorted(texts)[1:] if texts else [None]:
                words.append((name, word))
                columns.append([float(value if word is None else value == word) for value in values])
        q = len(columns)
        if q > len(specimens) - 2:
            raise ValueError(
                f"covariates: {q} numbers to find for each parameter from {len(specimens)} specimens, expected fewer"
            )
        table = np.array(columns).reshape(q, len(specimens)).T
        names = tuple(name if word is None else f"{name} = {word}" for name, word in words)
        return cls(names, table - table.mean(axis=0), table.mean(axis=0), tuple(words))

    def row(self, given: Mapping[str, float | str]) -> FloatArray:
        """Return covariates (q,) less the means; errors as in `of`."""
        known = {name for name, _ in self.words}
        for name in given:
            if name not in known:
                raise ValueError(f"new: '{name}' is not a covariate; {nearest(name, sorted(known))}")
        row = np.zeros(len(self.names))
        for k, (name, word) in enumerate(self.words):
            if name not in given:
                continue
            value = given[name]
            if isinstance(value, str) == (word is None):
                wanted = "a number" if word is None else "a word"
                raise ValueError(f"new: {name} is {value!r}, expected {wanted}, as of the specimens")
            row[k] = (float(value) if word is None else float(value == word)) - self.means[k]
        return row


def prior_names(posteriors: Mapping[str, Draws]) -> tuple[str, ...]:
    """Names of the parameters of all specimens."""
    return next(iter(posteriors.values())).names


def _moments(draws: Draws) -> tuple[FloatArray, FloatArray]:
    mean = draws.weights @ draws.values
    return mean, np.sqrt(draws.weights @ (draws.values - mean) ** 2)


@dataclass(frozen=True)
class Scale:
    """The numbers that are normal over a population: parameters θ, or ln |θ| with the sign of each (d,)."""

    logarithmic: bool
    signs: FloatArray

    @classmethod
    def of(cls, distribution: str, posteriors: Mapping[str, Draws]) -> Scale:
        """Return that of a distribution; errors as in `Population.run`."""
        names = prior_names(posteriors)
        if len(posteriors) < 2:
            raise ValueError(f"has {len(posteriors)} specimen, expected at least 2")
        if distribution == "normal":
            return cls(False, np.ones(len(names)))
        every = np.concatenate([one.values[one.weights > 0] for one in posteriors.values()])
        positive, negative = (every > 0).all(axis=0), (every < 0).all(axis=0)
        for name, one in zip(names, positive | negative, strict=True):
            if not one:
                raise ValueError(f"'{name}' has draws of both signs, or zero: expected distribution = 'normal'")
        return cls(True, np.where(positive, 1.0, -1.0))

    def to(self, values: FloatArray) -> FloatArray:
        """Return z (…, d) of parameters (…, d)."""
        return np.log(values * self.signs) if self.logarithmic else values

    def back(self, z: FloatArray) -> FloatArray:
        """Return parameters (…, d) of z (…, d)."""
        return self.signs * np.exp(z) if self.logarithmic else z

    def specimen(self, draws: Draws, prior: Inputs) -> Specimen:
        """Return a posterior that was found under a prior."""
        some = draws.weights > 0
        z = self.to(draws.values[some])
        # dθ = |θ| dz
        logs = prior.log_density(draws.values[some]) + (z.sum(axis=1) if self.logarithmic else 0.0)
        supports = [prior.marginals[name].support or (-np.inf, np.inf) for name in draws.names]
        ends = np.sort(np.array(supports).T * self.signs, axis=0)
        if self.logarithmic:
            ends = np.log(ends.clip(0, None), out=np.full(ends.shape, -np.inf), where=ends > 0)
        given = ends if np.isfinite(ends).any() else None
        return Specimen(z, draws.weights[some] / draws.weights[some].sum(), logs, draws.effective, given)

    def of_prior(self, prior: Inputs) -> Hyperprior:
        """Return mean and standard deviation of the prior of a specimen."""
        points = prior.points(sobol_points(0, 0, 0, PRIOR, len(prior.names)))
        fits = (points * self.signs > 0).all(axis=1) if self.logarithmic else np.ones(PRIOR, dtype=bool)
        z = self.to(points[fits])
        return Hyperprior(z.mean(axis=0), z.std(axis=0))

    def inputs(self, names: Sequence[str], new: FloatArray, hyperprior: Hyperprior) -> Inputs:
        """Return a prior that covers draws (A, d) of a new specimen: as they are distributed, but wider.

        Widths are by quantiles, as few specimens leave long tails, and at most those of the prior of a population.
        There are no negative log-normal parameters: they are normal, cut at zero.
        """
        lower, middle, upper = np.quantile(new, (0.1587, 0.5, 0.8413), axis=0)
        widths = np.minimum(WIDER * (upper - lower) / 2, 2 * hyperprior.std)
        ranks = new.argsort(axis=0).argsort(axis=0)
        correlation = np.atleast_2d(2 * np.sin(np.pi / 6 * np.corrcoef(ranks.T))) * np.outer(self.signs, self.signs)
        correlation = 0.9 * correlation + 0.1 * np.eye(len(names))
        marginals = map(self._marginal, self.signs, middle, widths)
        return Inputs(
            dict(zip(names, marginals, strict=True)),
            tuple((names[i], names[j], float(correlation[i, j])) for i in range(len(names)) for j in range(i)),
        )

    def _marginal(self, sign: float, middle: float, width: float) -> Distribution:
        if not self.logarithmic:
            return Normal(mean=middle, std=width)
        mean = float(np.exp(middle + width**2 / 2))
        std = mean * float(np.sqrt(np.expm1(width**2)))
        if sign > 0:
            return LogNormal(mean=mean, std=std)
        return TruncatedNormal(mean=-mean, std=std, lower=-mean - 8 * std, upper=0.0)


def _beyond(fit: Fit, names: Sequence[str]) -> Iterator[Finding]:
    """Say of which parameters new specimens lie beyond ends of the prior under which specimens were found.

    By the medians of mean and spread: the tails of all draws together say how little few specimens tell.
    """
    from scipy.special import ndtr

    bounded = [one.ends for one in fit.specimens if one.ends is not None]
    if not bounded:
        return
    lower, upper = (np.median(ends, axis=0) for ends in np.swapaxes(bounded, 0, 1))
    middle, spread = np.median(fit.mean, axis=0), np.median(fit.std, axis=0)
    shares = ndtr((lower - middle) / spread) + ndtr((middle - upper) / spread)
    listed = [f"{name} ({percent(share)})" for name, share in zip(names, shares, strict=True) if share >= BEYOND]
    if listed:
        yield Finding("population-beyond", "warning", {"listed": ", ".join(listed)})


def _findings(reached: _Reached, names: list[str]) -> Iterator[Finding]:
    again = [f"{name} ({times})" if times > 1 else name for name, times in reached.times.items()]
    if again:
        often = " (how often, in parentheses)" if max(reached.times.values()) > 1 else ""
        yield Finding("population-redrawn", "note", {"specimens": ", ".join(again), "often": often})
    sizes = zip(names, (size for _, size in reached.estimates), strict=True)
    low = {name: f"{name} ({size:.0f})" for name, size in sizes if size < LEAST}
    if low:
        reasons = dict.fromkeys(reached.refused[name] for name in low if name in reached.refused)
        why = f"They cannot be drawn again: {'; '.join(reasons)}. " if reasons else ""
        yield Finding("population-few-draws", "warning", {"specimens": ", ".join(low.values()), "why": why})
    if reached.fit.effective < MIXED:
        worth = f"{reached.fit.effective:.0f} independent ones"
        yield Finding("population-worth", "warning", {"worth": worth})
    if len(names) < FEW:
        yield Finding("population-small", "note", {"specimens": len(names)})
