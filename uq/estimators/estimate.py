"""An estimate with its errors, and the names by which results hold them: no other file puts these together.

With σ the standard error of sampling, e the error of the mesh (exact minus computed: added, it corrects) and δ what is
not known of e, √(σ² + (|e| + δ)²) is the total error of an estimate as it stands, and √(σ² + δ²) that of the corrected
one. Like σ itself they are to be doubled for 95 %.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray

# What results hold of an estimate beside its value: field of `Estimate`, and end of the name of the variable.
PARTS = {
    "error": "_error",
    "mesh": "_mesh_error",
    "doubt": "_mesh_error_doubt",
    "total": "_total_error",
    "corrected": "_corrected",
    "left": "_corrected_error",
}
ESTIMATED = ("mean", "std")  # of an output, always
BAND = ("mean", "mean_error", "std", "std_error", "lower", "upper")  # of what is predicted
OF_MESH = ("mesh", "doubt", "corrected", "left")
# First words of names, where errors that are not of sampling alone stand under others than the value.
SHORT = {"mean": "", "prediction_mean": "prediction", "cycle_value": "cycle"}
SHORTENED = ("mesh", "doubt", "total")
Variables = dict[str, tuple[tuple[str, ...], Any]]
Values = TypeVar("Values", float, FloatArray)


def part(name: str, which: str) -> str:
    """Name the variable that holds a part of an estimate, by a key of `PARTS`; of "", by a name for itself.

    >>> part("std", "mesh"), part("mean", "mesh"), part("mean", "corrected"), part("", "left")
    ('std_mesh_error', 'mesh_error', 'mean_corrected', 'corrected_error')
    """
    first = SHORT.get(name, name) if which in SHORTENED else name
    return f"{first}{PARTS[which]}".removeprefix("_")


class Estimate(NamedTuple, Generic[Values]):
    """A value and its errors, all of one shape; NaN where something is not known.

    Attributes
    ----------
    value
        As estimated.
    error
        Standard error of sampling.
    mesh, doubt
        Error of the mesh, exact minus computed, and its uncertainty.
    total
        Error of the value as it stands.
    corrected, left
        The value with the error of the mesh added, and the error of that.
    """

    value: Values
    error: Values
    mesh: Values
    doubt: Values
    total: Values
    corrected: Values
    left: Values


def estimate_of(results: Mapping[Any, Any], name: str) -> Estimate[FloatArray]:
    """Read an estimate from results: its value, whatever the dimensions, and what there is of its errors."""
    value = np.asarray(results[name])
    nothing = np.full(value.shape, np.nan)
    names = {which: part(name, which) for which in PARTS}
    if names["left"] not in results:  # nothing is sampled
        names["left"] = names["doubt"]
    return Estimate(value, **{key: np.asarray(results[at]) if at in results else nothing for key, at in names.items()})


def single(results: Mapping[Any, Any], name: str) -> Estimate[float]:
    """Read an estimate of one number, from results or from their part of a summary, where None stands for NaN."""
    there = {key: results[key] for key in (name, *(part(name, which) for which in PARTS)) if key in results}
    numbers = {key: np.nan if value is None else float(value) for key, value in there.items()}
    found = estimate_of({name: np.nan} | numbers, name)
    return Estimate(*map(float, found))


def with_mesh(
    value: FloatArray, error: FloatArray | float, mesh: FloatArray, doubt: FloatArray
) -> Estimate[FloatArray]:
    """Return an estimate that is sampled with a standard error, and has errors of a mesh with a doubt."""
    sampling = np.broadcast_to(error, np.shape(value))
    total, left = np.hypot(sampling, np.abs(mesh) + doubt), np.hypot(sampling, doubt)
    return Estimate(value, sampling, mesh, doubt, total, value + mesh, left)


def parts_of(found: Estimate[FloatArray], name: str, dims: Sequence[str], which: Sequence[str]) -> Variables:
    """Return parts of an estimate as variables of results."""
    values = found._asdict()
    return {part(name, one): (tuple(dims), values[one]) for one in which}


def of_samples(
    points: FloatArray, values: FloatArray, ok: NDArray[np.bool_], scramble: NDArray[np.int64] | None = None
) -> Variables:
    """Return samples as variables of results: points (n, d), outputs (n, m), which have answers, and scrambles (n,)."""
    found: Variables = {"points": (("sample", "parameter"), points), "values": (("sample", "output"), values)}
    found["ok"] = (("sample",), ok)
    return found if scramble is None else found | {"scramble": (("sample",), scramble)}


def holds(results: Mapping[Any, Any], name: str, which: str) -> bool:
    """Return whether results hold a part of an estimate."""
    return part(name, which) in results
