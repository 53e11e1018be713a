"""Estimates averaged over models, each with its probability: what varies within models, and between them.

With probabilities p_k, means m_k and variances v_k, the mean is m = Σ p_k m_k, the variance Σ p_k v_k within the models
and Σ p_k (m_k − m)² between them. Errors are those of the estimates of each model, which are independent, and of the
probabilities to first order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from forward.model import FloatArray
from uq.estimators.indices import shares
from uq.estimators.moments import ESTIMATES
from uq.findings import add, findings

if TYPE_CHECKING:
    import xarray as xr

FIELDS = tuple(f"field_{name}" for name in ESTIMATES)


def averaged(found: Mapping[str, xr.Dataset], probabilities: Sequence[float], errors: Sequence[float]) -> xr.Dataset:
    """Return the estimates averaged over models, beside those of each.

    Parameters
    ----------
    found
        Results of a method for each model, by name, with the same outputs.
    probabilities, errors
        Of the models (K,), of sum 1, with standard errors.
    """
    import xarray as xr

    p, unsure = np.asarray(probabilities), np.asarray(errors)
    first = next(iter(found.values()))
    by, each = ("output",), ("candidate", "output")
    outputs = {name: np.array([one[name].to_numpy() for one in found.values()]) for name in ESTIMATES}
    whole = average(p, unsure, *(outputs[name] for name in ESTIMATES))
    dataset = xr.Dataset(
        {
            **{name: (by, whole[name]) for name in (*ESTIMATES, "within", "between")},
            **{f"candidate_{name}": (each, values) for name, values in outputs.items()},
            "candidate_probability": (("candidate",), p),
            "candidate_probability_error": (("candidate",), unsure),
        },
        {"output": first["output"].values, "candidate": list(found)},
    )
    if all("field_mean" in one for one in found.values()):
        fields = average(p, unsure, *(np.array([one[name].to_numpy() for one in found.values()]) for name in FIELDS))
        of_nodes = {f"field_{name}": (("node", "component"), fields[name]) for name in (*ESTIMATES, "between")}
        dataset = dataset.assign_coords(component=["x", "y", "z"]).assign(of_nodes)
    for name, one in found.items():
        add(dataset, *(finding.of(f"Candidate '{name}'") for finding in findings(one)))
    dataset.attrs["stopped"] = "; ".join(f"{name}: {one.attrs['stopped']}" for name, one in found.items())
    return dataset


def average(
    p: FloatArray, unsure: FloatArray, mean: FloatArray, mean_error: FloatArray, std: FloatArray, std_error: FloatArray
) -> dict[str, FloatArray]:
    """Average moments (K, …) of K models with probabilities p (K,) of standard errors `unsure` (K,)."""
    p, unsure = (x.reshape(-1, *(1,) * (mean.ndim - 1)) for x in (p, unsure))
    middle = (p * mean).sum(axis=0)
    away = mean - middle
    within, between = (p * std**2).sum(axis=0), (p * away**2).sum(axis=0)
    variance = within + between
    # ∂var/∂m_k = 2 p_k (m_k − m), ∂var/∂s_k = 2 p_k s_k, ∂var/∂p_k = s_k² + (m_k − m)², less the mean as Σ p = 1
    slopes = [(2 * p * away, mean_error), (2 * p * std, std_error), (std**2 + away**2 - variance, unsure)]
    error = np.sqrt(sum(((slope * of) ** 2).sum(axis=0) for slope, of in slopes))
    return {
        "mean": middle,
        "mean_error": np.sqrt(((p * mean_error) ** 2 + (away * unsure) ** 2).sum(axis=0)),
        "std": np.sqrt(variance),
        "std_error": shares(error, 2 * np.sqrt(variance)),
        "within": within,
        "between": between,
    }
