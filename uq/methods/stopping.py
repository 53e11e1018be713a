"""When a sampling method stops (samples, tolerance, time), and how long a solve will take."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from uq.methods.method import Method

UNASKED = "method.kind = 'automatic' needs a tolerance, expected accuracy.tolerance, such as 1e-3"
TEXTBOOK = 15  # ratio of the times of a solve from zero and a predicted one, at 10⁴ unknowns


class Amount(Method):
    """The requested amount of sampling, at least one of the three.

    Parameters
    ----------
    samples
        Number of samples; with a tolerance or a budget, the largest number.
    tolerance
        Largest error, of a quantity that depends on the method.
    budget_seconds
        Processor time (s) of all solves together, on all ranks: no work is begun that would exceed it, judging by the
        solves so far. Solves that a restart finds on disk count with the time that they took.
    """

    samples: Annotated[int, Field(ge=2)] | None = None
    tolerance: Annotated[float, Field(gt=0)] | None = None
    budget_seconds: Annotated[float, Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _check_amount(self) -> Amount:
        self.check_amount()
        return self

    def check_amount(self) -> None:
        """Raise a ValueError if no amount is given."""
        if not self.asked:
            message = "gives neither samples nor tolerance nor budget_seconds, expected at least one of them"
            raise ValueError(message)

    @property
    def asked(self) -> bool:
        """Whether any amount is given."""
        return self.samples is not None or self.open_ended

    @property
    def open_ended(self) -> bool:
        """Whether the study may end before the largest number of samples."""
        return self.tolerance is not None or self.budget_seconds is not None

    def met(self, reached: float) -> bool:
        """Whether a tolerance was requested and an error `reached` meets it."""
        return self.tolerance is not None and reached <= self.tolerance

    def affordable(self, solves: float, seconds: float) -> float:
        """Return the number of solves that the budget still allows, if they take as long as those `solves` did."""
        if self.budget_seconds is None or seconds == 0:
            return np.inf
        return max(0.0, solves * (self.budget_seconds / seconds - 1))

    def why_stopped(self, reached: float, error: str, count: int, limit: int, amount: str) -> str:
        """Say why sampling stopped.

        Parameters
        ----------
        reached, error
            The error that the tolerance is for, and the same in words.
        count, limit
            Number of samples, and the largest.
        amount
            The samples in words.
        """
        if self.met(reached):
            return f"tolerance {self.tolerance:g} met: {error} after {amount}"
        if count < limit:
            amount = f"{amount}, all that budget_seconds = {self.budget_seconds:g} pays for"
        elif self.tolerance is None:
            amount = f"{amount}, as asked"
        if self.tolerance is None:
            return f"{amount}: {error}"
        return f"tolerance {self.tolerance:g} not met: {error} after {'' if count < limit else 'all '}{amount}"


def seconds_per_solve(unknowns: int) -> float:
    """Weigh solves on nested meshes of so many unknowns against each other, in seconds.

    Methods choose numbers of samples by it: it depends only on the unknowns and stays fixed, so that results do too.
    The predictions of `check` are better (`forward.fem.cost`) and may improve further. Fitted to 0.011, 0.067 and 0.98
    s at 1 575, 9 963 and 70 227 unknowns (quadratic tetrahedra, a 2.8 GHz core; `python -m benchmarks realisation`).
    Inputs so wide that the prediction fails take several times as long.
    """
    return float(4e-3 + 1.2e-6 * unknowns**1.2)
