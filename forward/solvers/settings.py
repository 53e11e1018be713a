"""Path, tolerance and limits of the solver, as a study has them."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from forward.settings import Settings


class SolverSettings(Settings):
    """Path, tolerance and limits of the solver.

    Parameters
    ----------
    kind
        "predict-correct" uses a prediction and a reference factor where the method has them, and the last factor for
        more than one correction; "newton" is the textbook: from zero, a new factor for every step. Where a method
        counts iterations, both go from its prediction.
    tolerance
        Largest residual of the free unknowns, relative to the loads (and to the reactions where displacements are
        prescribed); in the mixed form, also of the volumes, as the force of the pressure that they lack.
    derivative_tolerance
        Largest error of a tangent or adjoint of a solution that was found with a reference factor, relative to its
        size. Derivatives of other solutions are exact.
    iterations
        Newton iterations allowed in one load step.
    corrections
        Corrections with a reference factor that are allowed before Newton takes over.
    minimum_damping
        Shortest fraction of a Newton step that is tried where the whole step is not admissible.
    minimum_load_step
        Smallest load step, as a fraction of the load, before the solver gives up.
    solve_seconds
        Longest time (s, by the clock) for one solve, after which it has failed; none by default. It is looked at
        between iterations. Whether a solve that takes about so long fails depends on the machine.
    accept_unstable
        Whether an equilibrium counts where the stiffness has negative eigenvalues (the body has buckled). Nothing is
        then spent on looking for them.
    """

    kind: Literal["predict-correct", "newton"] = "predict-correct"
    tolerance: Annotated[float, Field(gt=0, le=1e-2)] = 1e-8
    derivative_tolerance: Annotated[float, Field(gt=0, le=1e-2)] = 1e-6
    iterations: Annotated[int, Field(ge=1)] = 25
    corrections: Annotated[int, Field(ge=1)] = 40
    minimum_damping: Annotated[float, Field(gt=0, lt=1)] = 1e-3
    minimum_load_step: Annotated[float, Field(gt=0, le=1)] = 1 / 8192
    solve_seconds: Annotated[float, Field(gt=0)] | None = None
    accept_unstable: bool = False
