"""What the equations of a body are set to: all that they remember of the last point."""

from __future__ import annotations

from dataclasses import dataclass

from forward.model import FloatArray


@dataclass
class Latest:
    """The point that a body is set to, and the one whose stiffness is factorised.

    Whatever changes the body says so here, so that nothing that was set or computed at one point serves at another.

    Attributes
    ----------
    parameters
        Parameters (d,) that are set; None if they have to be set anew.
    solution
        The solution whose parameters, load and state are set; None if they are those of no solution.
    factorised
        The solution that owns the factor at hand; None if it is that of no solution.
    factorised_at
        State (U_local,) whose stiffness is factorised.
    rounding
        What the forces of the body without loads are rounded to (N), once it is known.
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
        """Another point is solved for."""
        self.solution = self.factorised = None

    def forget_parameters(self) -> None:
        """Fields were changed: set the parameters anew next time, whatever they are."""
        self.parameters = self.solution = None
