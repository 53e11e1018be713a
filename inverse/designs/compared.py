"""What results of a design hold: chosen observations beside random ones, their values, and what the mesh does."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from forward.findings import Finding
from forward.model import FloatArray
from inverse.data.measurements import Measurements
from inverse.designs.candidates import Candidates
from inverse.designs.criteria import IntArray
from inverse.designs.greedy import Choice
from uq.findings import add

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
    """Return what chosen candidates, which cost so much (c,), are worth, and random ones.

    In an order (n,) the first, the first two, … are worth (n,); so many random orders follow from the seed.
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


def with_values(
    found: xr.Dataset,
    values: Measurements,
    sigma: FloatArray,
    candidates: Candidates,
    mesh: FloatArray | None = None,
    *,
    noise: bool = False,
) -> xr.Dataset:
    """Add what the values of the candidates are, and say of which candidates errors of the mesh exceed the noise.

    The standard deviations (m,) are of the errors of all values. What the mesh is said to take away from them (m,) is
    NaN where that is not known, and may count as noise already.
    """
    which, names = candidates.which, candidates.names
    found = found.assign(
        value_candidate=("value", which),
        value_sigma=("value", sigma),
        value_place=(("value", "axis"), values.places),
        value_case=("value", values.tests),
        value_part=("value", values.names),
    ).assign_coords(value=values.labels)
    if mesh is None or not np.isfinite(mesh).any():
        return found
    found = found.assign(value_mesh_error=("value", mesh))
    measured = (which >= 0) & np.isfinite(mesh)
    own = np.sqrt(np.maximum(sigma**2 - mesh**2, 0)) if noise else sigma
    ratios = np.divide(mesh, own, out=np.zeros_like(mesh), where=measured & (own > 0))[measured]
    count, size = np.bincount(which[measured], minlength=len(names)), len(names)
    times = np.sqrt(np.bincount(which[measured], ratios**2, size) / np.maximum(count, 1))
    off, chosen = int((times > 1).sum()), found["chosen"].to_numpy()
    if not off:
        return found
    worst = chosen[np.argmax(times[chosen])]
    said = {
        "off": off,
        "size": size,
        "off_chosen": int((times[chosen] > 1).sum()),
        "chosen": len(chosen),
        "worst": names[worst],
        "times": times[worst],
    }
    add(found, Finding("design-mesh-as-noise", "note", said) if noise else Finding("design-mesh", "warning", said))
    return found
