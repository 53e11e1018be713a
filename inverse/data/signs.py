"""Signs of measured outputs: a tool presses and never pulls, and many programs count forces that press as negative."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from inverse.data.table import DataError


def check(names: Iterable[str], values: FloatArray, labels: NDArray[np.str_], negative: Sequence[bool]) -> None:
    """Refuse data of which most are below 0, where their output cannot be; a few may be by their errors.

    Parameters
    ----------
    names, values, labels
        Of the data (m,): output, value, and location in the file.
    negative
        Whether the output of each can be below 0.

    Raises
    ------
    DataError
        With a line for each such output.
    """
    wrong = []
    for name in dict.fromkeys(names):
        mine = [k for k, one in enumerate(names) if one == name and not negative[k]]
        below = [k for k in mine if values[k] < 0]
        if 2 * len(below) > len(mine):
            wrong.append(
                f"{labels[below[0]]}: '{name}' is {values[below[0]]:g}, and {len(below)} of {len(mine)} are below 0, "
                "which it cannot be: a force is positive where the tool presses on the body; expected the other sign"
            )
    if wrong:
        raise DataError(*wrong)
