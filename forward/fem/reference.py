"""The factor at a reference state of a body, which corrects predictions and screens equilibria elsewhere.

It is rotated with the body (`forward.solvers.rotations`).
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from forward.fem.equations import Discretisation
from forward.model import FloatArray, ReferenceSolution, SolveError, Work
from forward.solvers.anderson import Inverse, block_galerkin
from forward.solvers.lanczos import negative_eigenvalues
from forward.solvers.rotations import Turned, rotations, turn
from forward.solvers.stability import BLOCK, SMOOTH, Rows, Screened, screen, screening_vectors
from forward.solvers.steps import Steps, finish, through
from forward.solvers.system import ROUGH, TIGHT, LinearSolver
from forward.solvers.way import MANY

STEP = 1e-2  # of finite differences of the stiffness, in standard deviations
DIRECTIONS = 6  # of changes of parameters for the screen: one by one or, if there are more parameters, at random
# A step of parameters, parameters and state there, imbalance, rotations from the reference.
End = tuple[float, FloatArray, FloatArray, FloatArray, FloatArray]


class ReferenceFactor:
    """The factor at a reference state of a body, as an approximate inverse of the stiffness at other states."""

    def __init__(self, equations: Discretisation) -> None:
        self._equations = equations
        self._solver = equations.new_factor()
        self._rotations = np.empty((3, 3, 0))
        self._reference: ReferenceSolution | None = None
        self._slopes: FloatArray | None = None
        self._lengths: FloatArray | None = None
        self._rest: float | None = None
        self._vectors: FloatArray | None = None
        self._random: FloatArray | None = None  # forces that Lanczos' process begins with
        self._screening: LinearSolver | None = None  # where the stiffness is not symmetric

    def at(self, reference: ReferenceSolution) -> ReferenceFactor:
        """Return the factor at a reference; this may change parameters and state."""
        self.prepare(reference)
        return self

    def prepare(self, reference: ReferenceSolution) -> bool:
        """Factorise at a reference, unless the current factor is its own; this changes parameters and state.

        Returns whether there was another factor, or none.
        """
        if self._reference is not None and self._reference.same(reference):
            return False
        self._reference = self._slopes = self._lengths = self._rest = self._vectors = None
        equations = self._set(reference)
        self._solver.factorise()
        self._rotations = rotations(equations.gradients())
        self._reference = reference
        return True

    def release(self) -> None:
        """Free the factor, if there is one."""
        if self._reference is not None:
            self._solver.release()
            self._reference = self._slopes = self._lengths = self._rest = self._vectors = None

    def _set(self, reference: ReferenceSolution) -> Discretisation:
        self._equations.set_to(reference.parameters, reference.state)
        return self._equations

    def slopes(self) -> FloatArray:
        """Derivatives (d, U_local) of the state at the reference; this may change parameters and state."""
        if self._slopes is None:
            assert self._reference is not None
            equations = self._set(self._reference)
            kept, equations.work = equations.work, Work()  # its cost is not counted for the first solution
            self._slopes = self._solver.solve(equations.right_sides_along(np.eye(len(equations.parameters))))
            equations.work = kept
        return self._slopes

    def lengths(self) -> FloatArray:
        """Norms (d,) of the derivatives of the state by parameters; zeros where these are more than `MANY`."""
        assert self._reference is not None
        if self._lengths is None:
            d = len(self._reference.parameters)
            self._lengths = np.zeros(d) if d > MANY else self._equations.norms(self.slopes())
        return self._lengths

    def from_rest(self) -> float:
        """Distance of the state from what the tangent at rest predicts for its loads, over its size."""
        assert self._reference is not None
        if self._rest is None:
            equations, state = self._set(self._reference), self._reference.state
            kept, equations.work = equations.work, Work()  # as that of the factor
            zero = np.zeros_like(state)
            equations.factorise(zero)
            apart = equations.norm(state + equations.solve(equations.residual(zero).vector))
            equations.work = kept
            size = equations.norm(state)
            self._rest = apart / size if size > 0 else 0.0
        return self._rest

    def prepare_screen(self) -> bool:
        """Compute the vectors that show instabilities, unless they exist; this may change parameters and state.

        False if there are none: without spread of the parameters, or if the reference itself is unstable.
        """
        assert self._reference is not None
        reference, equations = self._reference, self._equations
        if reference.spread is None or not np.isfinite(reference.spread).all():
            return False
        if self._vectors is None and not equations.symmetric:
            self._set(reference)
            self._screening = self._screening or equations.new_symmetric_solver()
            self._screening.factorise()
        if self._definite().negative_eigenvalues() != equations.unknowns.pressures:
            return False
        if self._vectors is None:
            kept, equations.work = equations.work, Work()  # counted for no solution, as the factor
            random = np.random.default_rng(0)
            forces = equations.layout.scatter(random.standard_normal((BLOCK, equations.layout.size)))
            self._vectors = screening_vectors(
                self._changes(reference, random),
                partial(self._definite().solve, tolerance=SMOOTH),
                forces,
                equations.free_displacements,
                equations.total,
            )
            equations.work = kept
        return True

    def indefinite(self) -> bool:
        """Whether the factor has negative eigenvalues beyond one for each pressure; False where it does not tell."""
        negative = self._solver.negative_eigenvalues()
        return negative is not None and negative > self._equations.unknowns.pressures

    def _definite(self) -> LinearSolver:
        """Solver for the symmetric part of the stiffness, factorised at the reference."""
        if self._equations.symmetric:
            return self._solver
        assert self._screening is not None
        return self._screening

    def _changes(self, reference: ReferenceSolution, random: np.random.Generator) -> Iterator[Rows]:
        """Products with the change of the stiffness for one standard deviation of the parameters, along tangents.

        They are second differences of forces: a product takes two assemblies of forces; assembling a stiffness takes
        as long as forty.
        """
        assert reference.spread is not None
        equations, d = self._equations, len(reference.parameters)
        if reference.spread.ndim == 2:
            directions = reference.spread
        elif d <= DIRECTIONS:
            directions = np.diag(reference.spread)[reference.spread > 0]
        else:
            directions = random.standard_normal((DIRECTIONS, d)) * reference.spread
        self._set(reference)
        slopes = self._solver.solve(equations.right_sides_along(directions))
        for direction, slope in zip(directions, slopes, strict=True):
            ends: list[End] = []
            for step in (STEP, -STEP):
                parameters, state = reference.parameters + step * direction, reference.state + step * slope
                R = self.rotation(state)
                equations.set_to(parameters, state)
                ends.append((step, parameters, state, equations.imbalance(), R))

            def multiply(rows: FloatArray, ends: list[End] = ends) -> FloatArray:
                # As in the screen, rotated with the body, so that rotations do not count as a change.
                total = np.zeros_like(rows)
                for step, parameters, state, imbalance, R in ends:
                    along = turn(rows, R)
                    along[:, equations.fixed] = 0
                    equations.set_parameters(parameters)
                    equations.at_load(1.0)
                    products = equations.stiffness_near(state, imbalance, along)
                    total += turn(products, R, back=True) / (2 * step)
                total[:, equations.fixed] = 0
                return total

            yield multiply

    def screen(self, u: FloatArray, imbalance: FloatArray, R: FloatArray) -> Steps[Screened]:
        """Screen a state u (U_local,) with its imbalance, rotated by R from the reference."""
        assert self._vectors is not None
        equations, free = self._equations, self._equations.free_displacements
        vectors = turn(self._vectors, R)
        vectors[:, equations.fixed] = 0
        steps = screen(
            vectors,
            lambda rows: equations.stiffness_near(u, imbalance, rows),
            Turned(R, equations.fixed),
            free,
            equations.total,
        )
        if equations.symmetric:
            return (yield from steps)
        return finish(steps, self._counted(self._definite()))  # its symmetric part has a factor of its own

    def definite(self, u: FloatArray, imbalance: FloatArray, R: FloatArray) -> Steps[bool]:
        """Whether the stiffness at a state u (U_local,) with its imbalance, rotated by R, is surely positive definite.

        Seen by Lanczos' process with the factor, where that is positive definite itself. False says nothing.
        """
        equations = self._equations
        if not equations.symmetric or equations.unknowns.pressures > 0:
            return False
        if self._random is None:
            random = np.random.default_rng(1).standard_normal((1, equations.layout.size))
            self._random = equations.layout.scatter(random)[0] * equations.free_displacements
        steps = negative_eigenvalues(
            lambda row: equations.stiffness_near(u, imbalance, row[None])[0],
            self._random,
            equations.total,
            equations.layout.size,
        )
        try:
            return (yield from through(steps, Turned(R, equations.fixed))) == 0
        except SolveError:
            return False

    def rotation(self, u: FloatArray) -> FloatArray:
        """Return the rotations (3, 3, n_owned) of the nodes from the reference to a state u (U_local,)."""
        return rotations(self._equations.gradients_at(u), self._rotations)

    def solve_near(
        self,
        R: FloatArray,
        right: FloatArray,
        tolerance: float,
        iterations: int,
        *,
        transpose: bool = False,
        first: FloatArray | None = None,
    ) -> FloatArray | None:
        """Solve with the stiffness at the state that is set, rotated by R (3, 3, n_owned) from the reference.

        For rows (k, U_local) that are zero on prescribed unknowns, by products with that stiffness; None without
        convergence: the reference is too far away. Arguments as of `block_galerkin`.
        """
        equations = self._equations
        inverse = self._counted(self._solver, transpose=transpose, tolerance=ROUGH)
        return block_galerkin(
            lambda x: equations.free_stiffness_times(x, transpose=transpose),
            Turned(R, equations.fixed).by(inverse),
            right,
            equations.total,
            equations.norms,
            tolerance,
            iterations,
            first,
        )

    def solve(self, right: FloatArray) -> FloatArray:
        """Solve with the factor at the reference; (n,) or (k, n)."""
        return self._counted(self._solver, tolerance=ROUGH)(right)

    def solve_uncounted(self, right: FloatArray) -> FloatArray:
        """The same, where the caller knows to which solutions the work belongs."""
        return self._solver.solve(right, tolerance=ROUGH)

    def _counted(self, solver: LinearSolver, *, transpose: bool = False, tolerance: float = TIGHT) -> Inverse:
        def inverse(right: FloatArray) -> FloatArray:
            self._equations.work.back_substitutions += 1 if right.ndim == 1 else len(right)
            return solver.solve(right, transpose=transpose, tolerance=tolerance)

        return inverse
