"""What tools touch at the mean of the inputs: where, and with what pressure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from forward.model import FloatArray, SolveError

if TYPE_CHECKING:
    import xarray as xr

    from workflows.studies.sampling import Study


def touched(study: Study, model: Any) -> dict[str, FloatArray]:
    """Solve at the mean of the inputs; collective over the model's ranks.

    Returns
    -------
    dict
        Undeformed places (m) and pressures (Pa), (n, 4), of the vertices under each tool; empty where no tool touches
        the body, or where there is no answer.
    """
    if not study.spec.touched:
        return {}
    try:
        found: dict[str, FloatArray] = model.solve(study.inputs.mean).touched()
    except SolveError:
        return {}
    return found


def with_contact(dataset: xr.Dataset, found: dict[str, FloatArray]) -> xr.Dataset:
    """Add the vertices under tools, with the pressures there."""
    if not found:
        return dataset
    labels = np.repeat(list(found), [len(rows) for rows in found.values()])
    rows = np.concatenate(list(found.values()))
    order = np.lexsort((*rows[:, :3].T, labels))  # whatever the number of ranks
    vertex = ("contact_vertex",)
    return dataset.assign_coords(contact_tool=(vertex, labels[order])).assign(
        contact_position=((*vertex, "axis"), rows[order, :3], {"units": "m"}),
        contact_pressure=(vertex, rows[order, 3], {"units": "Pa"}),
    )
