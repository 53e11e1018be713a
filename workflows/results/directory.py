"""The results directory: results.nc, summary.json and files for ParaView; each written completely or not at all."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from forward.errors import Error
from forward.findings import Finding
from forward.machine import write_whole
from forward.readable import per
from uq.findings import add
from workflows.results.norms import squares
from workflows.results.points import has_points, points_grid
from workflows.results.surfaces import surface, tools_of
from workflows.results.vtu import Grid, vtu

if TYPE_CHECKING:
    import xarray as xr

ROUNDING = 2.0**-52
TRIANGLE, TETRAHEDRON = 5, 10  # of VTK
AXES = 3
# Of arrays that are not numbers, other than displacements and their derivatives.
UNITS = {"stress": "Pa", "von_mises": "Pa", "moved": "m", "indicator by volume": "1/m³"}
MOST = 0.9  # of the variance of a random field: modes that keep less leave out what is worth a word
# Dimensions of fields that are written, beside those of numbers at the nodes, alone or for each of something.
BY_NODE = (
    ("node", "component"),
    ("node", "tensor"),
    ("parameter", "node", "component"),
    ("random_field", "realisation", "node"),
)
STILL = 1e-9  # standard deviation of a node, over the largest, that is rounding


class NoResultsError(Error, FileNotFoundError):
    """A directory without results of a finished study."""


def write_dataset(path: Path, dataset: xr.Dataset, groups: Mapping[str, xr.Dataset] | None = None) -> None:
    """Write a netCDF-4 file, with groups, and rename it into place; equal datasets give equal bytes."""
    from uq.evaluation.hdf5 import netcdf

    write_whole(path, netcdf(dataset, groups))


def read_dataset(directory: Path) -> xr.Dataset:
    """Read the results of a study into memory; a FileNotFoundError if the directory holds none."""
    from uq.evaluation.hdf5 import stored_dataset

    path = directory / "results.nc"
    again = "`tissuq run` with the same study and --out makes it again"
    if not path.exists():
        begun = "; the command that began this one continues it" if (directory / "study.toml").exists() else ""
        message = f"{directory}: holds no results.nc, expected the directory of a finished study{begun}"
        if read_summary(directory) is not None:
            message = f"{directory}: results.nc is missing, although the study is finished; {again}"
        raise NoResultsError(message)
    try:
        found = stored_dataset(path)
    except (MemoryError, PermissionError):
        raise
    except Exception as error:  # HDF5 says in many ways that a file is damaged
        raise NoResultsError(f"{path}: is damaged ({(str(error).splitlines() or [''])[0]}); {again}") from None
    if "config" not in found.attrs:
        raise NoResultsError(f"{path}: holds no results of a study, expected a file that `tissuq run` has written")
    found.encoding["source"] = str(path)  # as xarray keeps it
    return found


def digest(directory: Path) -> str:
    """Return the hash of the results of a study, as summary.json keeps it."""
    return hashlib.sha256((directory / "results.nc").read_bytes()).hexdigest()


def read_summary(directory: Path) -> dict[str, Any] | None:
    """Read summary.json; None if there is none, or if it is not the summary of a finished study."""
    try:
        found: dict[str, Any] = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
        return found if {"study", "method", "status", "failed", "provenance"} <= found.keys() else None
    except (FileNotFoundError, ValueError, RecursionError, AttributeError):
        return None


def with_random_fields(
    dataset: xr.Dataset, factors: Mapping[str, NDArray[np.float64]], variance_kept: Mapping[str, float]
) -> xr.Dataset:
    """Add realisations (n, nodes) of random fields, if fields are stored at the nodes."""
    if not factors:
        return dataset
    dataset = dataset.assign_coords(random_field=list(variance_kept))
    dataset = dataset.assign(variance_kept=(("random_field",), list(variance_kept.values())))
    few = [(name, f"{kept:.0%}") for name, kept in variance_kept.items() if kept < MOST]
    add(dataset, *(Finding("field-truncated", "note", {"name": name, "kept": kept}) for name, kept in few))
    if "node" in dataset.dims:
        values = np.array([factors[name] for name in variance_kept])
        dataset = dataset.assign(factor=(("random_field", "realisation", "node"), values))
    return dataset


def with_regions(dataset: xr.Dataset, names: Sequence[str], numbers: NDArray[np.int64] | None) -> xr.Dataset:
    """Add the regions of the cells, if there are any and the mesh is stored."""
    if numbers is None or "cell" not in dataset.dims:
        return dataset
    return dataset.assign_coords(region=list(names)).assign(cell_region=(("cell",), numbers))


def body_grid(dataset: xr.Dataset) -> Grid:
    """Return the undeformed mesh with the fields of the results at its nodes.

    Unknown values are NaN, and fields without any values are left out: VTK cannot read vectors whose lengths are all
    infinite or NaN.
    """
    fields = {
        name: np.where(known, values, np.nan)
        for name, values in node_fields(dataset).items()
        if (known := np.isfinite(values)).any()
    }
    points, cells = dataset["node_position"].to_numpy(), dataset["cell_nodes"]
    regions = {"region": dataset["cell_region"].to_numpy()} if "cell_region" in dataset else {}
    return Grid(points, cells.to_numpy(), int(cells.attrs["vtk_cell_type"]), fields, regions)


def mesh_grid(dataset: xr.Dataset) -> Grid:
    """Return a mesh that was refined, with what each cell adds to errors, also by its volume."""
    cells, points = (dataset[f"mesh_{name}"].to_numpy() for name in ("cell_vertices", "vertex_position"))
    at = points[cells]
    shares = dataset["mesh_indicator"].to_numpy()
    by_volume = shares / (np.abs(np.linalg.det(at[:, 1:] - at[:, :1])) / 6)
    return Grid(points, cells, TETRAHEDRON, {}, {"indicator": shares, "indicator by volume": by_volume})


def write_fields(
    directory: Path, dataset: xr.Dataset, units_of: Callable[[str], Mapping[str, str]] = lambda _: {}
) -> Path | None:
    """Write the fields of the results on the undeformed mesh, for ParaView; nothing if there are none.

    Every tool is in a file of its own, at its depth, a mesh that was refined with what its cells add to errors, and
    displacements; what each data set says about the interior, and its points with what was measured and predicted
    there. Names of arrays end with their unit in parentheses; `units_of` returns those of the parameters of a model.
    """
    grids: dict[str, Callable[[], Grid]] = {}
    if "cell_nodes" in dataset:
        points = dataset["node_position"].to_numpy()
        grids |= {f"tool-{tool.label}": partial(Grid, *surface(tool, points), TRIANGLE) for tool in tools_of(dataset)}
    if "mesh_indicator" in dataset:
        grids["mesh"] = partial(mesh_grid, dataset)
    if "cell_nodes" in dataset and "data_set" in dataset.dims:
        sets = {str(name): dataset.sel(data_set=name) for name in dataset.data_set.values}
        grids |= {name: partial(body_grid, one) for name, one in sets.items()}
        seen = {name: one for name, one in sets.items() if "datum_axis" in one and bool(one["ok"]) and has_points(one)}
        grids |= {f"points-{name}": partial(points_grid, one) for name, one in seen.items()}
    elif "cell_nodes" in dataset:
        grids["displacement"] = partial(body_grid, dataset)
    path, of_parameters = None, units_of("/") if "field_derivative" in dataset else {}
    for name, grid in grids.items():
        directory.mkdir(exist_ok=True)
        path = directory / f"{name}.vtu"
        write_whole(path, vtu(with_units(grid(), of_parameters)))
    return path


def with_units(grid: Grid, of_parameters: Mapping[str, str]) -> Grid:
    """Return a grid whose arrays have their units in their names; numbers have none."""

    def named(name: str, values: NDArray[Any]) -> str:
        first, _, parameter = name.partition(" ")
        unit = UNITS.get(name, "1")
        if first.startswith("derivative"):
            unit = per("m", of_parameters.get(parameter, "1"))
        elif unit == "1" and values.ndim > 1 and values.shape[1] == AXES:
            unit = "m"
        return name if unit == "1" else f"{name} ({unit})"

    return replace(
        grid,
        point_data={named(name, values): values for name, values in grid.point_data.items()},
        cell_data={named(name, values): values for name, values in grid.cell_data.items()},
    )


def node_fields(dataset: xr.Dataset) -> dict[str, NDArray[np.float64]]:
    """Return the fields (n_nodes, 3), tensors (n_nodes, 6) and numbers (n_nodes,) of the results, named in words."""
    arrays = {}
    for name, variable in dataset.data_vars.items():
        dims, words = variable.dims, str(name)
        if dims not in BY_NODE and dims != ("node",) and dims[1:] != ("node",):
            continue
        if {"component", "tensor", "parameter"}.intersection(dims):
            words = words.removeprefix("field_").removeprefix("node_")
        values, before = variable.to_numpy(), dims[: dims.index("node")]
        for at in np.ndindex(values.shape[: len(before)]):
            labels = (str(variable[dim].values[i]) for dim, i in zip(before, at, strict=True))
            arrays[" ".join([words, *labels])] = values[at]
    return arrays


def completed(dataset: xr.Dataset) -> xr.Dataset:
    """Return the results of a method without what is only rounding, and with norms of derivatives of displacements.

    These are L² norms over the body, of u √∫|u|² dX (m^{5/2}), and root mean squares √(∫|u|² dX/V) (m).
    """
    if "field_derivative" in dataset:
        slopes = dataset["field_derivative"].to_numpy()
        total, volume = squares(dataset["node_position"].to_numpy(), dataset["cell_nodes"].to_numpy(), slopes)
        norms, dims = np.sqrt(total), ("parameter",)
        dataset = dataset.assign(
            field_derivative_norm=(dims, norms),
            field_derivative_norm_per_range=(dims, norms * dataset["parameter_range"].to_numpy()),
            field_derivative_rms=(dims, norms / np.sqrt(volume)),
        )
    return above_rounding(blank_where_still(dataset))


def above_rounding(dataset: xr.Dataset) -> xr.Dataset:
    """Let no standard error be smaller than the rounding error of its estimate.

    A standard deviation is a difference of numbers as large as the mean, an index a ratio of sums of that size.
    """
    found = {}
    for label, errors in dataset.data_vars.items():
        name = str(label).removesuffix("_error")
        if name == label or name not in dataset or set(dataset[name].dims) != set(errors.dims):
            continue
        size: Any = np.abs(dataset[name])
        if name.endswith("std") and (mean := f"{name.removesuffix('std')}mean") in dataset:
            size = np.maximum(size, np.abs(dataset[mean]))
        if "sobol" in name:
            size = np.maximum(size, 1.0)
        floor = (ROUNDING * size).transpose(*errors.dims).to_numpy()
        values = errors.to_numpy()
        found[name] = (errors.dims, np.where(values < floor, floor, values), errors.attrs)
    return dataset.assign({f"{name}_error": variable for name, variable in found.items()})


def blank_where_still(dataset: xr.Dataset) -> xr.Dataset:
    """Leave out the indices of nodes that do not vary: there they are ratios of rounding errors."""
    names = [str(name) for name in dataset.data_vars if str(name).startswith("node_sobol_")]
    if not names or "field_std" not in dataset:
        return dataset
    size = np.sqrt((dataset["field_std"] ** 2).sum("component"))
    return dataset.assign({name: dataset[name].where(size > STILL * size.max()) for name in names})


def label(
    dataset: xr.Dataset, units: Mapping[str, str], nodes: Any = None, cells: Any = None, vtk_cell_type: int = 0
) -> xr.Dataset:
    """Add the units of the outputs and, if there are fields, the mesh."""
    dataset = dataset.assign_coords(unit=("output", [units[str(name)] for name in dataset.output.values]))
    if "node" in dataset.dims:
        dataset = dataset.assign(
            node_position=(("node", "axis"), nodes),
            cell_nodes=(("cell", "corner"), cells, {"vtk_cell_type": vtk_cell_type}),
        )
        for name in dataset.data_vars:
            if str(name).startswith("field_") and not any(word in str(name) for word in ("derivative", "sobol")):
                dataset[name].attrs["units"] = "m"
    return dataset
