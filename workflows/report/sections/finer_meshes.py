"""The effect of a finer mesh on each candidate."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from forward.readable import spoken
from forward.words import NONE
from workflows.report.blocks import Block, Heading, Table, Text
from workflows.report.section import Results, Section

if TYPE_CHECKING:
    import xarray as xr


class FinerMeshes(Section):
    """The effect of a finer mesh on each candidate."""

    def applies(self, results: Results) -> bool:
        """Whether meshes were checked."""
        return "probability" in results.dataset and "mesh_checked" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Heading("Effect of a finer mesh", level=3)
        yield Text(
            "Solves of each candidate at its mode on finer meshes, with thinner cells at the faces that are held: the "
            "error of its mesh, and what correcting it does. Where a candidate is corrected, evidence and unknowns "
            "above are those of the corrected one; elsewhere it is what correcting it would do, to first order."
        )
        yield meshes(results.dataset)


def meshes(dataset: xr.Dataset) -> Table:
    """The effect of a finer mesh on data, evidence and unknowns of each candidate."""
    from inverse.criticism.doubts_of_meshes import change_in_words

    rows = []
    for model in dataset.model.values:
        one = dataset.sel(model=model).isel(group=0)
        if not bool(one["mesh_checked"]):
            rows.append((str(model), "no", NONE, NONE, NONE, f"not checked: {one['mesh_why'].item()}"))
            continue
        error, shift = one["mesh_error"].to_numpy(), one["mesh_shift"].dropna("parameter")
        shifts = [(spoken(str(name)), float(shift.sel(parameter=name))) for name in shift.parameter.values]
        listed = [f"{name} {by:+.2g}".replace(" -", " −") for name, by in shifts]
        size, most = (f"{value:.2g}" for value in (float(np.sqrt(np.nanmean(error**2))), float(np.nanmax(abs(error)))))
        moved = change_in_words(float(one["mesh_log_evidence"]), float(abs(shift).max()))
        corrected = "yes" if bool(one["mesh_corrected"]) else "no"
        rows.append((str(model), corrected, moved, size, most, ", ".join(listed)))
    head = (
        "model",
        "corrected",
        "ln Z",
        "data, over the errors",
        "at most",
        "unknowns, in deviations of the posterior",
    )
    return Table(head, rows, text=frozenset({0, 1, 5}), long=frozenset({5}))
