"""Path, tolerance and limits of the solver, as given in a study."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from forward.settings import Settings


class SolverSettings(Settings):
    """Path, tolerance and limits of the solver.

    Parameters
    ----------
    kind
        "predict-correct" uses a prediction and a reference factor if the method provides them, and the last factor for
        more than one correction; "newton" is the textbook solver: from zero, a new factor for every step. If a method
        limits the iterations, both start from its prediction.
    tolerance
        Largest residual of the free unknowns, relative to the loads (and to the reactions where displacements are
        prescribed); in the mixed form, also of the volumes, as the force of the missing pressure.
    derivative_tolerance
        Largest error of a tangent or adjoint of a solution that was found with a reference factor, relative to its
        size. Derivatives of other solutions are exact.
    iterations
        Newton iterations allowed in one load step.
    corrections
        Largest number of corrections with a reference factor before Newton's method is used.
    minimum_damping
        Smallest fraction of a Newton step that is tried if the full step is not admissible.
    minimum_load_step
        Smallest load step, as a fraction of the load, before the solver gives up.
    solve_seconds
        Longest wall-clock time (s) of one solve, after which it has failed; no limit by default. It is checked between
        iterations. Whether a solve of about this length fails depends on the machine.
    linear
        What linear systems are solved with. "factor": LDLᵀ, or LU, of every stiffness. "multigrid": conjugate
        gradients with two levels, quadratic and linear elements, and no factor of the whole stiffness; samples then
        take steps of Newton's method from their predictions, with stiffnesses of their own. "both": these for Newton's
        method and derivatives, and a factor for the reference that corrects predictions. "auto" chooses by predicted
        time and memory; the textbook solver and the mixed form have factors.
    precision
        Of the factor of a reference, which corrects predictions. "single" takes half the memory and less time; what is
        solved is the same within the tolerance, since residuals are in double precision, and so are derivatives and
        the test for stability. "auto": single where the factor is large. It is in double precision where MUMPS is not
        there in single, for several ranks that share a model, and where too few digits would be left.
    accept_unstable
        Whether an equilibrium counts even if the stiffness has negative eigenvalues (the body has buckled). These are
        then not looked for.
    """

    kind: Literal["predict-correct", "newton"] = "predict-correct"
    tolerance: Annotated[float, Field(gt=0, le=1e-2)] = 1e-8
    derivative_tolerance: Annotated[float, Field(gt=0, le=1e-2)] = 1e-6
    iterations: Annotated[int, Field(ge=1)] = 25
    corrections: Annotated[int, Field(ge=1)] = 40
    minimum_damping: Annotated[float, Field(gt=0, lt=1)] = 1e-3
    minimum_load_step: Annotated[float, Field(gt=0, le=1)] = 1 / 8192
    solve_seconds: Annotated[float, Field(gt=0)] | None = None
    linear: Literal["auto", "factor", "multigrid", "both"] = "auto"
    precision: Literal["auto", "single", "double"] = "auto"
    accept_unstable: bool = False
