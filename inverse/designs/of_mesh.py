"""Candidates whose values the mesh of the model gets wrong by more than their noise."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from forward.findings import Finding
from forward.model import FloatArray
from uq.findings import add

if TYPE_CHECKING:
    import xarray as xr


def with_mesh_errors(found: xr.Dataset, mesh: FloatArray | None, *, noise: bool) -> xr.Dataset:
    """Add estimated errors of the mesh to a design, and say of which candidates they exceed the noise.

    Parameters
    ----------
    found
        The design, with its values.
    mesh
        What the mesh takes away from all values (m,), NaN where that is not known; None if it is of none.
    noise
        Whether this counts as noise already.
    """
    if mesh is None or not np.isfinite(mesh).any():
        return found
    found = found.assign(value_mesh_error=("value", mesh))
    sigma, which, names = (found[name].to_numpy() for name in ("value_sigma", "value_candidate", "candidate"))
    measured = (which >= 0) & np.isfinite(mesh)
    own = np.sqrt(np.maximum(sigma**2 - mesh**2, 0)) if noise else sigma
    ratios = np.divide(mesh, own, out=np.zeros_like(mesh), where=measured & (own > 0))[measured]
    count, size = np.bincount(which[measured], minlength=len(names)), len(names)
    times = np.sqrt(np.bincount(which[measured], ratios**2, size) / np.maximum(count, 1))
    off, chosen = int((times > 1).sum()), found["chosen"].to_numpy()
    if not off:
        return found
    worst = chosen[np.argmax(times[chosen])]
    values = {
        "off": off,
        "size": size,
        "off_chosen": int((times[chosen] > 1).sum()),
        "chosen": len(chosen),
        "worst": names[worst],
        "times": times[worst],
    }
    add(found, Finding("design-mesh-as-noise", "note", values) if noise else Finding("design-mesh", "warning", values))
    return found
