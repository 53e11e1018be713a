"""The linearised equations of a body: K = ∂F/∂u, and solvers for it."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np
import ufl

from forward.bodies.geometry import AXES
from forward.fem import ranks
from forward.fem.cost import Linear, factor
from forward.fem.dolfinx import assembly, linear, single, spaces
from forward.fem.dolfinx.spaces import Transfer
from forward.fem.forms import Forms
from forward.fem.items import Items
from forward.loaded import LoadedBody
from forward.model import FloatArray, Work
from forward.solvers.system import ROUGH, TIGHT, LinearSolver, Move

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

OF_MODULI = 2  # degree of quadrature of their means


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

    def begin(self) -> None:
        """A solve at another point begins."""
        self.solution = self.factorised = self.factorised_at = None

    def forget_parameters(self) -> None:
        """Fields have changed: the parameters must be set again next time, whatever they are."""
        self.parameters = self.solution = None


class Linearisation(Forms):
    """The stiffness, assembled at the current state and parameters.

    Vectors hold this rank's part (U_local,); rows of prescribed unknowns are those of the identity.
    """

    def __init__(self, spec: LoadedBody, comm: Any, parameters: tuple[str, ...], beside: Forms | None = None) -> None:
        super().__init__(spec, comm, parameters, beside)
        self.work = Work()
        self.linearisation_point = LinearisationPoint()
        imbalance = self._imbalance_form()
        self._residual = self.vector(imbalance, often=True)
        # Equations beside others are those of an estimate, which has ways of its own.
        self._lasting = beside is None
        self.linear = spec.linear if self._lasting else Linear.FACTOR
        self._constraints, moved = self._held(self.unknowns)
        owned = sorted((3 * n + a, path) for (n, a), path in moved.items() if n < self.nodes_owned)
        self.fixed = np.array([unknown for unknown, _ in owned], dtype=np.int64)
        # Which prescribed unknowns each number of a prescribed displacement moves: 1, or 0, by its path.
        self.movers = {
            path: np.array([mover == path for _, mover in owned], dtype=float)
            for path in self._values
            if path.startswith("displacements.")
        }
        self._targets = np.zeros(len(self.fixed))
        self._moves = False
        self.items = Items(self)
        self._of_stiffness = self.stiffness_form(imbalance)
        if self._lasting:
            assert self._solver  # so that memory is checked before anything else is allocated

    @cached_property
    def _stiffness(self) -> Any:
        return self._bilinear(self._of_stiffness)

    @cached_property
    def _matrix(self) -> linear.StiffnessMatrix:
        blocked = self.linear != Linear.FACTOR
        return self._new_matrix(self._stiffness, symmetric=self.symmetric, blocked=blocked)

    @cached_property
    def _solver(self) -> LinearSolver:
        return self._solver_of(self._matrix, self._of_stiffness)

    def _solver_of(self, matrix: linear.StiffnessMatrix, form: Any) -> LinearSolver:
        """Return what solves with a matrix, of a form in UFL, at many states."""
        if self.linear == Linear.FACTOR:
            return linear.DirectSolver(matrix)
        below = spaces.Unknowns(self.mesh, 1, mixed=False)
        marks, held = self._held(below)
        trial = ufl.TrialFunction(self.unknowns.whole)
        there = {self._variation: ufl.TestFunction(below.whole), trial: ufl.TrialFunction(below.whole)}
        form = self._bilinear(ufl.replace(form, there))
        body = self.spec.body.model_copy(update={"degree": 1})
        expected = factor(body, mixed=False, symmetric=matrix.symmetric)
        coarse = linear.StiffnessMatrix(form, marks, below, self.comm, symmetric=matrix.symmetric, expected=expected)
        fixed = np.array([3 * n + a for n, a in sorted(held) if 3 * n < below.size], dtype=np.int64)
        transfer = Transfer(below.displacement, self.space)
        return linear.MultigridSolver(matrix, linear.DirectSolver(coarse), transfer, self.fixed, fixed)

    @cached_property
    def _moduli(self) -> tuple[assembly.PointValues, FloatArray]:
        """∂P along `_along` (n_cells, 9 q) at a few points of the cells, and the weights (q,) of these."""
        changes = self._invariants.derivative_of(self.stress_of(self._potential), self.unknown, self._along)
        points, weights = spaces.quadrature(self.space, OF_MODULI)
        return self.at(ufl.as_vector([changes[a, k] for a in range(3) for k in range(3)]), points, often=True), weights

    def moduli(self) -> FloatArray:
        """Means ∂P_ak/∂F_bl (n_cells, a, k, b, l) (Pa) over this rank's cells, at the state that is set."""
        changes, weights = self._moduli
        found = []
        for b, place in itertools.product(range(3), spaces.node_coordinates(self.space).T):
            along = np.zeros((self.nodes_owned, 3))
            along[:, b] = place
            self.unknowns.give(self._along, self.with_pressures(along.ravel()))
            self.work.residuals += 1
            found.append(np.einsum("q,cqi->ci", weights, changes().reshape(-1, len(weights), 9)) / weights.sum())
        return np.asarray(np.stack(found, axis=-1).reshape(-1, 3, 3, 3, 3))

    @cached_property
    def _of_nodes(self) -> linear.NodalBlocks:
        return linear.NodalBlocks(self.space)

    @cached_property
    def _blocks_of_boundaries(self) -> linear.BoundaryBlocks | None:
        """What loads on boundaries that follow the body, and tools, add to these; None without any."""
        rest = [one for one in self._of_stiffness.integrals() if one.integral_type() != "cell"]
        return linear.BoundaryBlocks(self._bilinear(ufl.Form(rest)), self.space, self.comm) if rest else None

    def nodal_blocks(self) -> FloatArray | None:
        """The 3×3 blocks (n_owned, 3, 3) of the nodes, roughly; None if one of this rank is not positive definite."""
        blocks = self._of_nodes(self.moduli())
        if self._blocks_of_boundaries is not None:
            blocks += self._blocks_of_boundaries()
        nodes, axes = np.divmod(self.fixed, 3)
        blocks[nodes, axes] = blocks[nodes, :, axes] = 0
        blocks[nodes, axes, axes] = 1
        return blocks if linear.positive(blocks) else None

    def preconditioner(self) -> linear.Preconditioner | None:
        """Return what a few steps at and near the state that is set are preconditioned by; collective.

        The 3×3 blocks of the nodes, from means of the moduli of the cells. With pressures a matrix is made, which does
        not stay. None if a block on any rank is not positive definite.
        """
        if self.p is not None:
            self.work.assemblies += 1
            matrix = self._new_matrix(self._stiffness, symmetric=self.symmetric)
            saddle = linear.saddle_blocks(matrix, self.nodes_owned, self.fixed)
            return saddle if ranks.smallest(self.comm, float(saddle is not None)) > 0 else None
        blocks, fixed = self.nodal_blocks(), self.fixed
        if not ranks.smallest(self.comm, float(blocks is not None)) > 0 or blocks is None:
            return None
        kept = np.linalg.inv(blocks)

        def apply(r: FloatArray) -> FloatArray:
            z: FloatArray = np.einsum("nij,nj->ni", kept, r.reshape(-1, 3)).ravel()
            z[fixed] = 0
            return z

        return linear.Preconditioner(apply, None)

    def _held(self, of: spaces.Unknowns) -> tuple[list[Any], dict[tuple[int, int], str]]:
        """Marks for assembly of prescribed unknowns, and the path that moves each (if any), by node and axis."""
        moved: dict[tuple[int, int], str] = {}
        marks = []
        held = [(on, dict.fromkeys(AXES, "")) for on in self.spec.clamp]
        given = [
            (one.on, {axis: f"displacements.{one.label}.{axis}" for axis in one.components})
            for one in self.spec.displacements
        ]
        for on, paths in [*given, *held]:
            nodes = spaces.boundary_nodes(of.displacement, self.facets[on])
            for axis, path in paths.items():
                a = AXES.index(axis)
                marks.append(of.constraint(a, nodes))
                moved |= {(int(n), a): path for n in nodes}
        return marks, moved

    def set_state(self, u: FloatArray) -> None:
        """Give the unknowns (U_local,) their values, ghosts included."""
        self.linearisation_point.solution = None
        self.unknowns.give(self.unknown, u)

    def state(self) -> FloatArray:
        """This rank's part (U_local,) of the state that is set."""
        return self.unknowns.take(self.unknown.x.array)

    def displacements(self) -> FloatArray:
        """Displacements (nodes_owned, 3) of the state that is set."""
        return self.state()[: 3 * self.nodes_owned].reshape(-1, 3)

    def with_pressures(self, displacements: FloatArray) -> FloatArray:
        """Extend this rank's part (3 nodes_owned,) of a vector by zeros for the pressures, if these are unknowns."""
        return np.append(displacements, np.zeros(self.size - len(displacements)))

    def dot(self, x: FloatArray, y: FloatArray) -> float:
        """Inner product over all ranks."""
        return float(ranks.total(self.comm, np.array([x @ y]))[0])

    def total(self, values: FloatArray) -> FloatArray:
        """Sum over all ranks."""
        return ranks.total(self.comm, values)

    def norms(self, rows: FloatArray) -> FloatArray:
        """Euclidean norms over the displacements of rows (k, U_local), of all ranks."""
        displacements = rows[:, : 3 * self.nodes_owned]
        return np.asarray(np.sqrt(self.total(np.einsum("kn,kn->k", displacements, displacements))))

    def norm(self, x: FloatArray) -> float:
        """Euclidean norm over the displacements (or their forces) of all ranks."""
        return float(self.norms(x[None])[0])

    @cached_property
    def free_displacements(self) -> FloatArray:
        """1 on free displacements, 0 on other unknowns (U_local,)."""
        free = np.zeros(self.size)
        free[: 3 * self.nodes_owned] = 1
        free[self.fixed] = 0
        return free

    @cached_property
    def _symmetric_form(self) -> Any:
        """The symmetric part of a stiffness that is not symmetric, in UFL.

        That of friction is the stiffness at pressures that stay: what slides has no other resistance along the tool.
        """
        trial = ufl.TrialFunction(self.unknowns.whole)
        works = list(zip(self.spec.loads, self.virtual_works, strict=True))
        rest = sum((work for load, work in works if load.symmetric), self._variation_of(self._potential) * self.dx)
        found = self.derivative(rest, trial)
        for _, load, at in self._rubbing:
            pressed = ufl.derivative(load.potential(at), self.unknown, self._variation)
            found += self.derivative(ufl.algorithms.expand_derivatives(pressed), trial)
            found += load.rubbing_stiffness(at, self.unknowns.split(trial)[0])
        followers = [work for load, work in works if not load.symmetric and not load.contact and load.written]
        if followers:
            of_followers = self.derivative(sum(followers[1:], followers[0]), trial)
            found += 0.5 * of_followers + 0.5 * ufl.adjoint(of_followers)
        return found

    @cached_property
    def _symmetric_stiffness(self) -> Any:
        return self._bilinear(self._symmetric_form)

    def new_factor(self) -> LinearSolver:
        """Return a solver for the stiffness that makes the factor of a reference, with a matrix of its own.

        Estimates count no signs of it.
        """
        matrix = self._new_matrix(self._stiffness, symmetric=self.symmetric)
        alone = self.comm.size == 1  # entries and right-hand sides are not distributed
        if self.spec.single and alone:
            return single.SingleSolver(matrix, counted=self._lasting)
        return linear.DirectSolver(matrix)

    def new_symmetric_solver(self) -> LinearSolver:
        """Return a solver for the symmetric part of a stiffness that is not symmetric, with a matrix of its own."""
        matrix = self._new_matrix(self._symmetric_stiffness, symmetric=True, blocked=self.linear != Linear.FACTOR)
        return self._solver_of(matrix, self._symmetric_form)

    def _new_matrix(self, form: Any, *, symmetric: bool, blocked: bool = False) -> linear.StiffnessMatrix:
        expected = factor(self.spec.body, mixed=self.spec.mixed, symmetric=symmetric)
        return linear.StiffnessMatrix(
            form,
            self._constraints,
            self.unknowns,
            self.comm,
            symmetric=symmetric,
            expected=expected,
            blocked=blocked,
            items=partial(self.items.entries, symmetric=symmetric) if self.items else None,
        )

    @cached_property
    def _symmetric_part(self) -> LinearSolver:
        return self.new_symmetric_solver()

    def factorise(self, u: FloatArray, *, curved: bool = True, last: Move | None = None) -> FloatArray | float:
        """Assemble and factorise the stiffness at u (U_local,), as `System.factorise`."""
        self.set_state(u)
        left = last is not None and self._off_tools(*last)
        self.work.assemblies += 1
        self.work.factorisations += 1
        self.linearisation_point.factorised = None  # a factorisation that fails leaves no factor
        self._curved.value = float(curved and not left)
        try:
            self._solver.factorise()
            beyond = self._beyond() * self.free_displacements if left else 0.0
        finally:
            self._curved.value = 1.0
            for one in self._left.values():
                one.value = 0.0
        self.linearisation_point.factorised_at = u
        return beyond

    def _off_tools(self, before: FloatArray, step: FloatArray) -> bool:
        """Note which tools the body has left altogether, at the state that is set, though a step was to press it."""
        off = [not self._inside(gaps) for _, gaps in self._gaps]
        if not any(off):
            return False
        for function, values in zip(self._last, (before, step), strict=True):
            self.unknowns.give(function, values)
        left = [one and self._inside(gaps) for one, gaps in zip(off, self._expected_gaps, strict=True)]
        for (load, _), one in zip(self._gaps, left, strict=True):
            self._left[load.label].value = one
        return any(left)

    def _inside(self, gaps: assembly.FacetValues) -> bool:
        return ranks.smallest(self.comm, float(gaps().min(initial=np.inf))) < 0

    @cached_property
    def _expected_gaps(self) -> list[assembly.FacetValues]:
        """As `_gaps`, where the last step was to lead."""
        found: list[tuple[Any, Any, Any]] = list(self._tools)
        return [self.on_facets(load.expected_gap(at), load.on, load.degree) for _, load, at in found]

    @cached_property
    def _beyond(self) -> assembly.VectorAssembler:
        works = [load.expected(at, at.u)[1] for _, load, at in self._tools]
        return self.vector(sum(works[1:], works[0]), often=True)

    def release(self) -> None:
        """Free the factor, if there is one."""
        if self.linearisation_point.factorised is not None:
            self._solver.release()
        self.linearisation_point.factorised = None

    def solve(self, right: FloatArray) -> FloatArray:
        """Solve K x = right; rows of prescribed unknowns hold their values."""
        if self._moves or self.movers:
            known = right[self.fixed]
            if ranks.smallest(self.comm, -float(np.abs(known).max(initial=0.0))) < 0:
                w = np.zeros_like(right)
                w[self.fixed] = known
                assert self.linearisation_point.factorised_at is not None
                self.set_state(self.linearisation_point.factorised_at)
                right = right - self.stiffness_times(w)
                right[self.fixed] = known
        return self.back_substitute(right, tolerance=ROUGH)

    def back_substitute(self, right: FloatArray, *, transpose: bool = False, tolerance: float = TIGHT) -> FloatArray:
        """Solve with K, or with Kᵀ, whose prescribed rows and columns are those of the identity; (n,) or (k, n).

        The tolerance is that of `LinearSolver.solve`.
        """
        self.work.back_substitutions += 1 if right.ndim == 1 else len(right)
        return self._solver.solve(right, transpose=transpose, tolerance=tolerance)

    def stiffness_times(self, w: FloatArray, *, transpose: bool = False) -> FloatArray:
        """Product of the stiffness of all unknowns (or its transpose) with w (U_local,), at the state that is set."""
        self.unknowns.give(self._along, w)
        self.work.residuals += 1
        found = (self._transposed_action if transpose else self._stiffness_action)()
        return found + self.items.stiffness_times(w, transpose=transpose) if self.items else found

    def imbalance_by_vertices(self, w: FloatArray) -> FloatArray:
        """Virtual works F(u; φ_i w) (n_vertices,) of w (U_local,) times the hat function of each own vertex.

        At the current state; they sum to wᵀF.
        """
        self.unknowns.give(self._along, w)
        self.work.residuals += 1
        return self._weighted_imbalance()

    def free_stiffness_times(self, x: FloatArray, *, transpose: bool = False) -> FloatArray:
        """Product (k, n) of the matrix that `back_substitute` inverts, at the state that is set, with rows x (k, n)."""
        w = np.array(x)
        w[:, self.fixed] = 0
        y = np.array([self.stiffness_times(row, transpose=transpose) for row in w])
        y[:, self.fixed] = x[:, self.fixed]
        return y

    def sparse_stiffness(self) -> csr_matrix:
        """The stiffness (U, U) at the state that is set, in one process; the factor of `factorise` is lost."""
        self.linearisation_point.factorised = None
        return self._matrix.sparse()

    def inertia(self) -> int | None:
        """Number of negative eigenvalues of the factorised stiffness beyond one for each pressure; None if unknown."""
        return self._condensed(self._solver.negative_eigenvalues())

    def negative_eigenvalues(self, u: FloatArray) -> int | None:
        """Factorise at u (U_local,) and count negative eigenvalues, of the symmetric part if pressures act.

        They are those of the condensed stiffness: the one of each pressure in the mixed form is not counted.
        """
        if self.symmetric:
            self.factorise(u)
            return self.inertia()
        self.set_state(u)
        self.work.assemblies += 1
        self.work.factorisations += 1
        self._symmetric_part.factorise()
        return self._condensed(self._symmetric_part.negative_eigenvalues())

    def _condensed(self, negative: int | None) -> int | None:
        return None if negative is None else negative - self.unknowns.pressures
