"""Chosen observations beside random ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from forward.model import FloatArray
from inverse.designs.candidates import Candidates, Values
from inverse.designs.criteria import IntArray
from inverse.designs.greedy import Choice

if TYPE_CHECKING:
    import xarray as xr

FARTHER = 6  # times as many random observations as chosen ones
BAND = (0.05, 0.5, 0.95)
QUANTILES = ("lower", "median", "upper")


def compared(
    choice: Choice,
    candidates: Candidates,
    costs: FloatArray,
    worth: Callable[[IntArray], FloatArray],
    random: int,
    seed: int,
) -> xr.Dataset:
    """Return what chosen candidates are worth, and random ones.

    Parameters
    ----------
    choice
        The chosen ones.
    candidates
        All of them.
    costs
        What they cost (c,).
    worth
        What the first, the first two, … of candidates in an order (n,) are worth (n,).
    random, seed
        Number of random orders, and of their seed.
    """
    import xarray as xr

    order, worth_of_chosen = np.array(choice.order), np.cumsum(choice.gains)
    rng = np.random.default_rng([seed, 2])
    most = min(len(costs), FARTHER * len(order))
    orders = [rng.permutation(len(costs))[:most] for _ in range(random)]
    at_random = np.quantile([worth(one) for one in orders], BAND, axis=0)
    counts = np.flatnonzero(at_random[1] >= worth_of_chosen[-1])
    return xr.Dataset(
        {
            "chosen": ("choice", order),
            "worth": ("choice", worth_of_chosen),
            "cost": ("choice", np.cumsum(costs[order])),
            **{f"random_{name}": ("random_number", line) for name, line in zip(QUANTILES, at_random, strict=True)},
            "random_equal": float(counts[0] + 1) if len(counts) else np.nan,
            "candidate_cost": ("candidate", costs),
            "candidate_place": (("candidate", "axis"), candidates.places),
            "candidate_case": ("candidate", list(candidates.cases)),
            "candidate_part": ("candidate", list(candidates.parts)),
            "looks": choice.looks,
        },
        {"candidate": list(candidates.names), "random_number": np.arange(1, most + 1)},
    )


def with_values(found: xr.Dataset, values: Values, sigma: FloatArray, candidates: Candidates) -> xr.Dataset:
    """Add what the values of the candidates are."""
    return found.assign(
        value_candidate=("value", candidates.which),
        value_sigma=("value", sigma),
        value_place=(("value", "axis"), values.places),
        value_case=("value", list(values.case)),
        value_part=("value", list(values.part)),
    ).assign_coords(value=list(values.names))
