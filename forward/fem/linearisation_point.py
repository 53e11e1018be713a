"""The point at which the equations of a body are set: all their state that depends on the last point."""

from __future__ import annotations

from dataclasses import dataclass

from forward.model import FloatArray


@dataclass
class LinearisationPoint:
    """The point at which a body is set, and the one whose stiffness is factorised.

    Every change of the body is recorded here, so that nothing set or computed at one point is used at another.

    Attributes
    ----------
    parameters
        Parameters (d,) that are set; None if they must be set again.
    solution
        The solution whose parameters, load and state are set; None if there is no such solution.
    factorised
        The solution to which the current factor belongs; None if there is no such solution.
    factorised_at
        State (U_local,) whose stiffness this solve has factorised last; None if it has factorised none.
    rounding
        Size of the rounding errors (N) in the forces of the body without loads, once known.
    """

    parameters: FloatArray | None = None
    solution: object = None
    factorised: object = None
    factorised_at: FloatArray | None = None
    rounding: float | None = None

    def moved(self) -> None:
        """Parameters, load or state have changed."""
        self.solution = None

    def begin(self) -> None:
        """A solve at another point begins."""
        self.solution = self.factorised = self.factorised_at = None

    def forget_parameters(self) -> None:
        """Fields have changed: the parameters must be set again next time, whatever they are."""
        self.parameters = self.solution = None
