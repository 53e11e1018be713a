"""How many estimates of the error of the mesh a study affords, and how tolerances are split; plans ask for it."""

from __future__ import annotations

SHARE = 0.2  # of the solves of a study that estimates may cost
COST = 4  # of an estimate with its solution, in solves
FEWEST, MOST = 3, 16  # estimates: the fewest of which one can be left out of a line, and more than are needed
AT_ALL = 2  # of which one can be left out

OF_SOLVER = 0.01  # of a tolerance for all errors: what the solver may take
LEAST = 1e-9  # such tolerance: below, rounding decides


def estimates_for(solves: int, paid: float = MOST) -> int:
    """Number of estimates that a study of so many solves affords, `FEWEST` if so many are paid for, else `AT_ALL`."""
    return int(min(max(SHARE * solves / COST, FEWEST), MOST, max(paid, AT_ALL)))


def spare_for(solves: int) -> float:
    """Return how many solves are left of that share beside the estimates; negative where they take more."""
    return SHARE * solves - COST * estimates_for(solves)
