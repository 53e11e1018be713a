"""Numbers and arrays that ranks agree on."""

from __future__ import annotations

from typing import Any

import numpy as np
from mpi4py import MPI

from forward.model import FloatArray


def smallest(comm: Any, value: float) -> float:
    """Smallest value over the ranks; NaN counts as −∞."""
    value = value if value == value else -np.inf  # noqa: PLR0124
    return float(value if comm.size == 1 else comm.allreduce(value, op=MPI.MIN))


def total(comm: Any, values: FloatArray) -> FloatArray:
    """Sum of arrays over the ranks."""
    if comm.size == 1:
        return values
    result = np.empty_like(values)
    comm.Allreduce(values, result, op=MPI.SUM)
    return result
