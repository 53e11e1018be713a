"""Results of a comparison of models for ArviZ."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from inverse.criticism.weights import resampled
from inverse.low_dimensional.posterior import NOISE

if TYPE_CHECKING:
    import xarray as xr

    from forward.model import FloatArray
    from workflows.studies.selection import Comparison

DRAWS = 1000  # of the constants


def arviz_groups(study: Comparison, found: xr.Dataset) -> dict[str, xr.Dataset]:
    """Return ArviZ's groups: `arviz.from_netcdf("results.nc")`.

    Draws of the constants of every model before and after the data, in each group of data; ln of the density of each
    datum at these draws, one variable for each model; the data.
    """
    import xarray as xr

    drawn, dense, before = dict[str, Any](), dict[str, Any](), dict[str, Any]()
    measured = np.isfinite(found["measured"].to_numpy())
    of_group = found["output_group"].to_numpy()[measured]
    dims = ("chain", "draw", "group")
    for model in map(str, found.model.values):
        one = found.sel(model=model)
        chosen = {
            str(group): resampled(one["point_weight"].sel(group=group).to_numpy(), DRAWS, 0)
            for group in found.group.values
        }
        for parameter in found.parameter.values:
            points = one["point"].sel(parameter=parameter)
            values = np.array([points.sel(group=group).to_numpy()[which] for group, which in chosen.items()])
            if np.isfinite(values).all():
                drawn[f"{model}.{parameter}"] = (dims, values.T[None])
        dense_at = one["point_log_likelihood"].to_numpy()[:, measured]
        columns = [dense_at[chosen[group], j] for j, group in enumerate(of_group)]
        dense[model] = (("chain", "draw", "output"), np.array(columns).T[None])
        before |= {
            f"{model}.{name}": (dims, np.broadcast_to(values[None, :, None], (1, DRAWS, len(chosen))))
            for name, values in _before(study, model).items()
        }
    where = {"group": found.group.values}
    return {
        "posterior": xr.Dataset(drawn, where),
        "prior": xr.Dataset(before, where),
        "log_likelihood": xr.Dataset(dense),
        "observed_data": xr.Dataset({found.attrs["quantity"]: found["measured"].isel(output=measured)}),
    }


def _before(study: Comparison, model: str) -> dict[str, FloatArray]:
    """Draws of the constants of a model before the data, and of the size of the errors where that is inferred."""
    inputs, factor = study.models[model].inputs, study.method.noise.factor
    rng = np.random.default_rng(study.method.seed)
    kept = np.zeros((0, len(inputs.names)))
    while len(kept) < DRAWS:
        points = inputs.from_normals(rng.standard_normal((DRAWS, len(inputs.names))))[0]
        kept = np.concatenate([kept, points[inputs.allowed(points)]])
    found = dict(zip(inputs.names, kept[:DRAWS].T, strict=True))
    return found if factor is None else found | {NOISE: factor.from_normal(rng.standard_normal(DRAWS))[0]}
