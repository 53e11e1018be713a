"""Tables of draws of other programs: CSV, netCDF, and ArviZ's netCDF (PyMC, Stan, emcee)."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from forward.model import FloatArray
from inverse.data.table import DataError, read_table
from inverse.low_dimensional.posterior import NOISE
from uq.evaluation.hdf5 import Variable, variables
from uq.inputs.draws import Draws, effective

Columns = dict[str, FloatArray]
WEIGHTS = ("weight", "weights")
LOG_WEIGHTS = ("log_weight", "log_weights")
# What programs write beside parameters (with everything that ends in two underscores, as Stan's).
BESIDE = {
    *("chain", "draw", "iteration", "walker", "sample"),
    *("lp", "log_prob", "log_posterior", "log_likelihood", "log_prior"),
}


def of_table(path: Path, digest: str) -> Draws:
    """Read draws by the names of columns or variables; a column `weight` or `log_weight` is their weight.

    Raises `ValueError` if it is no table of draws: one line, and `OSError` if it cannot be read.
    """
    columns, chains = _netcdf(path) if path.suffix.lower() in {".nc", ".netcdf", ".h5"} else _table(path)
    return _of_columns(path.name, columns, chains, digest)


def _table(path: Path) -> tuple[Columns, FloatArray | None]:
    try:
        table = read_table(path)
    except DataError as error:
        raise ValueError(str(error.args[0])) from None
    columns: Columns = {}
    for name in table.columns:
        values = []
        for line, row in zip(table.lines, table.rows, strict=True):
            try:
                values.append(float(row[name]))
            except ValueError:
                if _beside(name):
                    break
                message = f"{path.name}: line {line}: '{row[name]}' in column '{name}', expected a number"
                raise ValueError(message) from None
        else:
            columns[name] = np.array(values)
    return columns, columns.get("chain", columns.get("chain__"))


def _netcdf(path: Path) -> tuple[Columns, FloatArray | None]:
    """Columns of variables with the dimensions chain and draw, or all with the same first dimension."""
    content = path.read_bytes()
    if content[:3] == b"CDF":
        from scipy.io import netcdf_file

        with netcdf_file(io.BytesIO(content), mmap=False) as file:
            found = {name: Variable(one.data.copy(), one.dimensions) for name, one in file.variables.items()}
    else:
        try:
            found = variables(content, "posterior")[0]
        except OSError:
            raise ValueError(f"{path.name}: is no netCDF file") from None
    columns: Columns = {}
    chains = None
    for name, one in found.items():
        values, dims = np.asarray(one.values), one.dims
        if not dims or name in dims or values.dtype.kind not in "fiu":
            continue
        if dims[:2] == ("chain", "draw"):
            chains = np.repeat(np.arange(values.shape[0]), values.shape[1])
            values, dims = values.reshape(-1, *values.shape[2:]), dims[1:]
        for place, index in enumerate(np.ndindex(values.shape[1:])):
            labels = [_label(found, dim, i) for dim, i in zip(dims[1:], index, strict=True)]
            column = values.reshape(len(values), -1)[:, place]
            columns[name + (f"[{','.join(labels)}]" if labels else "")] = column.astype(float)
    if not columns:
        message = f"{path.name}: has no draws, expected a group 'posterior' with dimensions chain and draw, or columns"
        raise ValueError(message)
    if len({len(one) for one in columns.values()}) > 1:
        raise ValueError(f"{path.name}: its variables have different numbers of draws, expected the same of each")
    return columns, chains


def _label(found: dict[str, Variable], dim: str, i: int) -> str:
    """Name a place along a dimension: by its text, if it has one."""
    labels = np.asarray(found[dim].values if dim in found else ())
    return str(labels[i]) if labels.dtype.kind in "OSU" and len(labels) > i else str(i)


def _beside(name: str) -> bool:
    return name.lower() in {*BESIDE, *WEIGHTS, *LOG_WEIGHTS, NOISE} or name.endswith("__") or not name


def _of_columns(name: str, columns: Columns, chains: FloatArray | None, digest: str) -> Draws:
    """Draws from columns (N,), with the weights among them."""
    names = tuple(one for one in columns if not _beside(one))
    if not names:
        raise ValueError(f"{name}: has columns {', '.join(columns)}, expected one for each parameter")
    values = np.column_stack([columns[one] for one in names])
    if not np.isfinite(values).all():
        row, column = np.argwhere(~np.isfinite(values))[0]
        raise ValueError(f"{name}: draw {row + 1} of '{names[column]}' is {values[row, column]}, expected numbers")
    weights = np.ones(len(values))
    for one in columns:
        if one.lower() in WEIGHTS:
            weights = columns[one]
        elif one.lower() in LOG_WEIGHTS:
            weights = np.exp(columns[one] - columns[one].max())
    if not (np.isfinite(weights).all() and (weights >= 0).all() and weights.sum() > 0):
        raise ValueError(f"{name}: weights are negative, infinite or all zero, expected numbers ≥ 0")
    weights = weights / weights.sum()
    worth = 1 / float((weights**2).sum())
    if np.ptp(weights) == 0:
        worth = min(worth, *(effective(column, chains) for column in values.T))
    return Draws(names, values, weights, worth, digest)
