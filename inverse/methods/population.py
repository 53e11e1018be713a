"""The distribution of parameters over specimens as a method: from the posteriors of a batch, or of groups of data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field

from forward.model import Finding, FloatArray
from forward.settings import Settings, nearest
from inverse.low_dimensional.population import Fit, Hyperprior, Specimen, fitted
from uq.findings import add
from uq.inputs.draws import Draws
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points

if TYPE_CHECKING:
    import xarray as xr

LEAST = 20.0  # effective size of a specimen's draws under the population, below which its estimates are rough
MIXED = 100.0  # independent draws of the population, below which its quantiles are rough
FEW = 4  # specimens, below which the prior decides how wide a population is
PRIOR = 4096  # points that stand for the prior
QUANTILES = (0.025, 0.5, 0.975)


class Population(Settings):
    """Distribution of parameters over specimens.

    Parameters
    ----------
    source
        Results of ``invert`` with several data sets, or of ``select`` with several groups of data: the specimens.
    model
        The candidate of ``select``: its name, or "best".
    distribution
        "log-normal" (parameters of one sign; of negative ones their size) or "normal", with covariance.
    covariates
        What specimens differ in that may move their means, linearly: for each, the numbers of all specimens, or words,
        by their names: ``grade = { one = 1, two = 3 }``, ``region = { one = "cortex", two = "thalamus" }``.
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
    distribution: Literal["normal", "log-normal"] = "log-normal"
    covariates: dict[str, dict[str, float | str]] = Field(default={})
    new: dict[str, float | str] = Field(default={})
    draws: Annotated[int, Field(ge=100, le=100_000)] = 1000
    seed: Annotated[int, Field(ge=0)] = 0
    digest: str = ""

    def run(self, posteriors: Mapping[str, Draws], prior: Inputs) -> xr.Dataset:
        """Fit the population, without solving anything.

        Parameters
        ----------
        posteriors
            Draws of the specimens, all of the same parameters.
        prior
            The prior of every specimen.

        Returns
        -------
        xarray.Dataset
            The variables of docs/results.md.

        Raises
        ------
        ValueError
            If there is only one specimen, or a parameter of a log-normal distribution has both signs.
        """
        import xarray as xr

        scale = Scale.of(self.distribution, posteriors)
        specimens, hyperprior = scale.specimens(posteriors, prior)
        columns = Columns.of(self.covariates, list(posteriors))
        x, at = (columns.values, columns.row(self.new)) if self.covariates else (None, None)
        fit = fitted(specimens, hyperprior, self.draws, self.seed, covariates=x)
        estimates = [fit.estimates(i, self.seed) for i in range(len(specimens))]
        new = scale.back(fit.predictive(self.seed, at))
        own = np.array([np.array(_moments(one)) for one in posteriors.values()])
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
                "logarithmic": ((), int(scale.logarithmic)),
            },
            {
                "parameter": list(prior_names(posteriors)),
                "partner": list(prior_names(posteriors)),
                "specimen": list(posteriors),
                "quantile": list(QUANTILES),
            },
        )
        if fit.slopes is not None:
            by_covariate = ("covariate", "parameter")
            slopes = np.swapaxes(fit.slopes, 1, 2)
            found = found.assign(
                slope=(("draw_number", *by_covariate), slopes),
                slope_quantiles=(("quantile", *by_covariate), np.quantile(slopes, QUANTILES, axis=0)),
                covariate_value=(("specimen", "covariate"), columns.values + columns.means),
            ).assign_coords(covariate=list(columns.names))
        add(found, *_findings(fit, list(posteriors), [size for _, size in estimates]))
        return found


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

        Raises
        ------
        ValueError
            If a specimen has none, one is unknown, a covariate mixes numbers and words or is the same for all, or there
            are too many of them.
        """
        words: list[tuple[str, str | None]] = []
        columns: list[list[float]] = []
        for name, given in covariates.items():
            for one in given:
                if one not in specimens:
                    message = f"covariates.{name}: '{one}' is not a specimen; {nearest(one, list(specimens))}"
                    raise ValueError(message)
            missing = [one for one in specimens if one not in given]
            if missing:
                message = f"covariates.{name}: nothing is said of {', '.join(missing)}, expected all specimens"
                raise ValueError(message)
            values = [given[one] for one in specimens]
            texts = {value for value in values if isinstance(value, str)}
            if texts and len(texts) < len(set(values)):
                message = f"covariates.{name}: numbers and words, expected either"
                raise ValueError(message)
            if len(set(values)) == 1:
                message = f"covariates.{name}: the same for all specimens, which says nothing on them"
                raise ValueError(message)
            for word in sorted(texts)[1:] if texts else [None]:
                words.append((name, word))
                columns.append([float(value if word is None else value == word) for value in values])
        q = len(columns)
        if q > len(specimens) - 2:
            message = (
                f"covariates: {q} numbers to find for each parameter from {len(specimens)} specimens, expected fewer"
            )
            raise ValueError(message)
        table = np.array(columns).reshape(q, len(specimens)).T
        names = tuple(name if word is None else f"{name} = {word}" for name, word in words)
        return cls(names, table - table.mean(axis=0), table.mean(axis=0), tuple(words))

    def row(self, given: Mapping[str, float | str]) -> FloatArray:
        """Return covariates (q,) less the means; errors as in `of`."""
        known = {name for name, _ in self.words}
        for name in given:
            if name not in known:
                message = f"new: '{name}' is not a covariate; {nearest(name, sorted(known))}"
                raise ValueError(message)
        row = np.zeros(len(self.names))
        for k, (name, word) in enumerate(self.words):
            if name not in given:
                continue
            value = given[name]
            if isinstance(value, str) == (word is None):
                wanted = "a number" if word is None else "a word"
                message = f"new: {name} is {value!r}, expected {wanted}, as of the specimens"
                raise ValueError(message)
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
            message = f"has {len(posteriors)} specimen, expected at least 2"
            raise ValueError(message)
        if distribution == "normal":
            return cls(False, np.ones(len(names)))
        every = np.concatenate([one.values[one.weights > 0] for one in posteriors.values()])
        positive, negative = (every > 0).all(axis=0), (every < 0).all(axis=0)
        for name, one in zip(names, positive | negative, strict=True):
            if not one:
                message = f"'{name}' has draws of both signs, or zero: expected distribution = 'normal'"
                raise ValueError(message)
        return cls(True, np.where(positive, 1.0, -1.0))

    def to(self, values: FloatArray) -> FloatArray:
        """Return z (…, d) of parameters (…, d)."""
        return np.log(values * self.signs) if self.logarithmic else values

    def back(self, z: FloatArray) -> FloatArray:
        """Return parameters (…, d) of z (…, d)."""
        return self.signs * np.exp(z) if self.logarithmic else z

    def specimens(self, posteriors: Mapping[str, Draws], prior: Inputs) -> tuple[list[Specimen], Hyperprior]:
        """Return the posteriors and the prior of a specimen."""
        found = []
        for draws in posteriors.values():
            some = draws.weights > 0
            z = self.to(draws.values[some])
            # dθ = |θ| dz
            logs = prior.log_density(draws.values[some]) + (z.sum(axis=1) if self.logarithmic else 0.0)
            found.append(Specimen(z, draws.weights[some] / draws.weights[some].sum(), logs, draws.effective))
        points = prior.points(sobol_points(0, 0, 0, PRIOR, len(prior.names)))
        fits = (points * self.signs > 0).all(axis=1) if self.logarithmic else np.ones(PRIOR, dtype=bool)
        z = self.to(points[fits])
        return found, Hyperprior(z.mean(axis=0), z.std(axis=0))


def _findings(fit: Fit, names: list[str], sizes: list[float]) -> Iterator[Finding]:
    low = [f"{name} ({size:.0f})" for name, size in zip(names, sizes, strict=True) if size < LEAST]
    if low:
        yield Finding(
            "warning",
            f"Few draws of {', '.join(low)} lie where the population has its specimens (effective sizes in "
            "parentheses): their estimates, and what they say of the population, are rough. More samples in their own "
            "study, or a prior like the population there, help.",
        )
    if fit.effective < MIXED:
        worth = f"{fit.effective:.0f} independent ones"
        yield Finding("warning", f"The draws of the population are worth {worth}: its ends are rough.")
    if len(names) < FEW:
        yield Finding("note", f"{len(names)} specimens say little on how wide the population is: its prior does.")
