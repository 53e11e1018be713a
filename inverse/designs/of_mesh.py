"""Candidates whose values the mesh of the model gets wrong by more than their noise."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from forward.model import Finding, FloatArray
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
    of_chosen = f"{int((times[chosen] > 1).sum())} of the {len(chosen)} chosen ones"
    text = (
        f"The mesh is estimated to err by more than the noise at {off:,} of {size:,} candidates, {of_chosen} among "
        f"them; at {names[worst]} it errs by {times[worst]:.2g} times the noise"
    )
    if noise:
        add(found, Finding("note", f"{text}. This is counted as noise."))
    else:
        remedy = "a finer mesh, or an inversion that corrects the error as invert does"
        said = f"what they are said to tell needs {remedy}; method.mesh_error = 'noise' counts it as noise"
        add(found, Finding("warning", f"{text}: {said}."))
    return found
