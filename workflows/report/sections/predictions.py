"""What an inversion predicts: a table and a picture, before and after the data."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from forward.readable import and_error, interval, percent, size
from forward.words import NONE
from workflows.report.blocks import Block, Heading, Picture, Pictures, Table, Text
from workflows.report.section import Results, Section

if TYPE_CHECKING:
    import xarray as xr

SHOWN = 24  # rows of the table of a data set
SETS = 12  # data sets that have a table


class Predictions(Section):
    """What is predicted from each data set, and what its data added."""

    def applies(self, results: Results) -> bool:
        """Whether anything is."""
        return "prediction_share" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """A table and a picture for each data set."""
        from workflows.report.plots.predictions import bands

        of = results.dataset
        yield Heading("Predictions")
        yield Text(
            "Outputs that were not measured, by the posterior: mean ± standard deviation, and the interval that holds "
            "95 %. Beside it what was known before the data, and the share of the variance that the data have removed. "
            "The error of the mesh is what is to be added to the mean; intervals do not hold it."
        )
        done = [str(name) for name, ok in zip(of["data_set"].values, of["ok"].values, strict=True) if bool(ok)]
        for name in done[:SETS]:
            one = of.sel(data_set=name)
            if len(done) > 1:
                yield Heading(name, level=3)
            yield table(one)
            if np.isfinite(one["prediction_std"]).any():
                caption = "95 % intervals before and after the data, each relative to the one before."
                yield Pictures([Picture.drawn(bands(one), caption)])
        if len(done) > SETS:
            yield Text(f"Those of {len(done) - SETS} more data sets are in results.nc.")


def table(one: xr.Dataset) -> Table:
    """What is predicted from a data set."""
    rows = []
    for goal in one["goal"].values[:SHOWN]:
        at = one.sel(goal=goal)
        unit = str(at["goal_unit"].item())
        lower, upper, share, mesh = (float(at[f"prediction_{n}"]) for n in ("lower", "upper", "share", "mesh_error"))
        rows.append(
            (
                str(goal),
                and_error(float(at["prediction_mean"]), float(at["prediction_std"]), unit),
                interval(lower, upper, unit, float(at["prediction_mean"])),
                and_error(float(at["prediction_prior_mean"]), float(at["prediction_prior_std"]), unit),
                NONE if np.isnan(share) else percent(share) if share >= 0 else "none",
                size(mesh, unit) if np.isfinite(mesh) else "not estimated",
            )
        )
    head = ("output", "predicted", "95 %", "before the data", "share of the variance removed", "error of the mesh")
    return Table(head, rows)
