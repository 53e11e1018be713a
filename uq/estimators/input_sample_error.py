"""What estimates err because the draws that stand for a distribution are few.

Methods integrate over the draws themselves, and their errors are those of that. A mean over a distribution of which N
draws are worth n_e independent ones errs by σ_d/√n_e beside, σ_d² = Var E[ψ | draws] the part of the variance that
comes from them, the standard deviation σ by σ_d √((κ − 1)/n_e)/2 with the kurtosis κ, and a quantile as one of n_e
samples. Where parameters have distributions of their own too, σ_d² is at most what these do not explain linearly.

Monte Carlo that takes n of N draws of equal weight, each once, has samples of the distribution: of N that are worth as
many nothing is added up to n = N.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from forward.findings import Finding, entries
from forward.model import FloatArray
from uq.estimators.indices import shares
from uq.estimators.quantiles import Quantiles, quantiles
from uq.estimators.tails import kurtosis
from uq.findings import add
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.surrogates.expansion import Expansion
from uq.surrogates.regression import POINTS, TRUSTED

if TYPE_CHECKING:
    import xarray as xr

    from uq.inputs.draws import Draws

FEW = 100.0  # independent draws below which a finding says so
SHARE = 0.5  # of the square of an error, from which draws decide it


def with_errors_of_draws(dataset: xr.Dataset, inputs: Inputs, in_turn: int = 0) -> xr.Dataset:
    """Add to standard errors what draws are responsible for, and say where that is most of them.

    Parameters
    ----------
    dataset
        Results of a method.
    inputs
        The parameters, some of them given by draws.
    in_turn
        Number of samples that took the draws in turn; 0 where draws come by chance.
    """
    draws = inputs.draws
    if draws is None or "mean_error" not in dataset or "values" not in dataset or "row" in dataset.dims:
        return dataset
    taken = max(in_turn, len(draws.values)) if in_turn and draws.equal else np.inf
    left = max(1 / draws.effective - 1 / taken, 0.0)
    ok = dataset["ok"].to_numpy()
    points, values = _values(dataset, inputs, dataset["points"].to_numpy()[ok], dataset["values"].to_numpy()[ok])
    share = _share(inputs, points, values)
    std = dataset["std"].to_numpy()
    added = {
        "mean_error": std * np.sqrt(share * left),
        "std_error": std * np.sqrt(share * (kurtosis(values) - 1) * left) / 2,
    }
    dominated = []
    for name, error in added.items():
        known = dataset[name].to_numpy()
        dataset = dataset.assign(
            {name: (("output",), np.hypot(known, error)), f"{name}_of_draws": (("output",), error)}
        )
        dominated.append((error**2 > SHARE * (known**2 + error**2)) & (error > 0))
    if "quantiles" in dataset and left > 0:
        probabilities = dataset["quantile"].to_numpy().tolist()
        worth = min(1 / left, len(values))  # order statistics of few samples do not tell less than these err
        of_draws = quantiles(values, tuple(probabilities), worth)
        scale = np.sqrt(share * left * worth)
        sides = of_draws.central - of_draws.lower, of_draws.upper - of_draws.central
        found = Quantiles(*(dataset[f"quantiles{one}"].to_numpy() for one in ("", "_lower", "_upper", "_error")))
        dataset = found.wider(*(np.where(side > 0, scale * side, 0.0) for side in sides)).on(dataset, probabilities)
    if "field_mean_error" in dataset:
        whole = float(share.max(initial=0.0)) * left
        spread = dataset["field_std"].to_numpy()
        for name, error in (("mean", spread * np.sqrt(whole)), ("std", spread * np.sqrt(whole / 2))):
            whole_error = np.hypot(dataset[f"field_{name}_error"].to_numpy(), error)
            dataset = dataset.assign({f"field_{name}_error": (("node", "component"), whole_error)})
    outputs = [str(one) for one, few in zip(dataset["output"].values, dominated[0], strict=True) if few]
    if outputs:
        add(dataset, Finding("draws-decide", "note", {"worth": draws.effective}, about=entries(outputs)))
    return dataset


def findings_of_source(inputs: Inputs) -> Iterator[Finding]:
    """Say that the draws of some parameters are worth few."""
    if inputs.draws is not None:
        yield from findings_of_few(inputs.draws)


def findings_of_few(draws: Draws, *whose: str) -> Iterator[Finding]:
    """Say that draws, of these specimens if any, are worth few."""
    if draws.effective < FEW:
        values = {"n": len(draws.values), "names": ", ".join(draws.names), "worth": draws.effective, "fewest": FEW}
        yield Finding("draws-few-of" if whose else "draws-few", "warning", values, about=entries(whose))


def _share(inputs: Inputs, points: FloatArray, values: FloatArray) -> FloatArray:
    """Largest share (m,) of the variances of values (n, m) that may come from draws."""
    own = inputs.joint.start
    if not own or len(points) < 4 * (own + 1):
        return np.ones(values.shape[1])
    t = inputs.coordinates.of(points)[:, :own]
    columns = np.column_stack([np.ones(len(t)), t])
    left = values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0]
    return shares(left.var(axis=0), values.var(axis=0))


def _values(
    dataset: xr.Dataset, inputs: Inputs, points: FloatArray, values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return points (N, d) and outputs there (N, m): by an expansion at all draws, where it is trusted, or of samples.

    Few samples of many draws tell less of their ends than an expansion does, and nothing beyond their own.
    """
    if "multi_index" not in dataset:
        return points, values
    every, known = inputs.points(sobol_points(0, 0, 0, POINTS, len(inputs.names))), Expansion.of(dataset)
    again = values[np.arange(POINTS) * len(values) // POINTS]
    trusted = dataset["loo_error"].to_numpy() <= TRUSTED
    return every, np.where(trusted, known.basis.values(every) @ known.coefficients, again)
