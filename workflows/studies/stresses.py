"""Stresses and strains at the mean of the inputs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from forward.model import FloatArray, SolveError

if TYPE_CHECKING:
    import xarray as xr

    from workflows.studies.sampling import Study

TENSOR = ("xx", "yy", "zz", "xy", "yz", "xz")  # the order of ParaView


def stressed(study: Study, model: Any) -> FloatArray | None:
    """Solve at the mean of the inputs; collective over the model's ranks.

    Returns
    -------
    FloatArray
        Cauchy stresses (Pa) and Green–Lagrange strains (2, N, 6) at the nodes; None where the study does not ask for
        them, where there is no answer, and on other ranks than the first.
    """
    if not getattr(study.spec, "stresses", False):
        return None
    try:
        found: FloatArray | None = model.solve(study.inputs.mean).stressed()
    except SolveError:
        return None
    return found


def with_stresses(dataset: xr.Dataset, found: FloatArray | None) -> xr.Dataset:
    """Add stresses and strains, if fields are stored at the nodes."""
    if found is None or "node" not in dataset.dims:
        return dataset
    by_node = ("node", "tensor")
    return dataset.assign_coords(tensor=list(TENSOR)).assign(
        node_stress=(by_node, found[0], {"units": "Pa"}),
        node_strain=(by_node, found[1], {"units": "1"}),
        von_mises=(("node",), von_mises(found[0]), {"units": "Pa"}),
    )


def von_mises(stress: FloatArray) -> FloatArray:
    """Return the von Mises stresses (n,) of stresses (n, 6): √(3/2 s:s) with the deviator s."""
    normal, shear = stress[:, :3], stress[:, 3:]
    deviator = normal - normal.mean(axis=1, keepdims=True)
    return np.asarray(np.sqrt(1.5 * ((deviator**2).sum(axis=1) + 2 * (shear**2).sum(axis=1))))
