"""Measured points of a specimen, from the data of an inversion component by component."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from workflows.results.vtu import Grid

if TYPE_CHECKING:
    import xarray as xr


N = 3  # axes of displacements
VERTEX = 1  # of VTK
COLUMNS = ("measured", "predicted", "residuals", "residual_over_error", "moved")


@dataclass(frozen=True, eq=False)
class MeasuredPoints:
    """The points of a load case."""

    case: str  # its name
    places: FloatArray  # where (n, 3) they are on the body (m)
    # Displacements (n, 3) in the axes of the body (m); components that were not measured are zero in both.
    measured: FloatArray
    predicted: FloatArray
    over: FloatArray  # root mean square (n,) of the residuals of a point over their standard deviations
    moved: FloatArray  # how far (n,) it was moved onto the body (m)

    @property
    def residuals(self) -> FloatArray:
        """Measured minus predicted displacements (n, 3) (m)."""
        return self.measured - self.predicted


def measured_points(one: xr.Dataset) -> list[MeasuredPoints]:
    """Return the points of each load case that has some, of one data set that was inverted."""
    if not has_points(one):
        return []
    seen = one.isel(datum=np.flatnonzero(displacements(one)))
    found = []
    for number, case in enumerate(one.case.values):
        here = seen.isel(datum=np.flatnonzero(seen["datum_case"] == number))
        if not here.sizes["datum"]:
            continue
        axes = here["datum_axis"].to_numpy().astype(int)
        along = here["datum_direction"].to_numpy() if "datum_direction" in one else np.eye(3)[axes]
        moved = here["datum_move"].to_numpy() if "datum_move" in one else np.zeros(len(axes))
        points, first, which = np.unique(here["place"].to_numpy(), axis=0, return_index=True, return_inverse=True)
        which = which.ravel()
        sums: dict[str, FloatArray] = {name: np.zeros((len(points), 3)) for name in ("measured", "predicted")}
        for name, values in sums.items():
            np.add.at(values, which, here[name].to_numpy()[:, None] * along)
        over = np.sqrt(np.bincount(which, here["residual"].to_numpy() ** 2) / np.bincount(which))
        found.append(MeasuredPoints(str(case), points, sums["measured"], sums["predicted"], over, moved[first]))
    return found


def displacements(one: xr.Dataset) -> NDArray[np.bool_]:
    """Which data (n,) of one data set are displacements that were measured, rather than gaps or other outputs."""
    found: NDArray[np.bool_] = np.isfinite(one["measured"].to_numpy()) & (one["datum_axis"].to_numpy() < N)
    return found


def has_points(one: xr.Dataset) -> bool:
    """Whether displacements were measured, rather than other outputs alone."""
    return "datum_axis" in one and bool((one["datum_axis"] < N).any())


def points_grid(one: xr.Dataset) -> Grid:
    """Return the points of all load cases: a vertex for each point and load case."""
    parts = measured_points(one)
    places = np.concatenate([part.places for part in parts])
    columns = zip(*((one.measured, one.predicted, one.residuals, one.over, one.moved) for one in parts), strict=True)
    data = dict(zip(COLUMNS, map(np.concatenate, columns), strict=True))
    data["load_case"] = np.repeat(np.arange(len(parts)), [len(part.places) for part in parts])
    return Grid(places, np.arange(len(places))[:, None], VERTEX, data)
