"""Numbers and arrays that ranks agree on."""

from __future__ import annotations

from typing import Any

import numpy as np
from mpi4py import MPI

from forward.model import FloatArray


def smallest(comm: Any, value: float) -> float:
    """Smallest value over the ranks; NaN counts as −∞."""
    return float(comm.allreduce(value if value == value else -np.inf, op=MPI.MIN))  # noqa: PLR0124


def total(comm: Any, values: FloatArray) -> FloatArray:
    """Sum of arrays over the ranks."""
    if comm.size == 1:
        return values
    result = np.empty_like(values)
    comm.Allreduce(values, result, op=MPI.SUM)
    return result
