"""Meshes that are refined until the errors of outputs are small: solve, estimate, mark, refine.

The error of an output is estimated with elements of one degree higher (`forward.fem.enriched`), times a factor for what
these missed on the previous meshes. Cells are marked by their contributions, the fewest that make half of the total
(W. Dörfler, SIAM J. Numer. Anal. 33 (1996) 1106–1124), and are bisected (`forward.bodies.bisection`). All of this uses
arrays on the first rank, in the order of its cells.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from forward.bodies.bisection import Bisected
from forward.bodies.facets import lift_of
from forward.bodies.mesh import Contents, IntArray, Loaded, contents
from forward.bodies.tetrahedra import MeshInMemory, tetrahedra
from forward.fem.calibration import moved
from forward.fem.dolfinx import meshes
from forward.fem.mesh_error_cost import own_estimate
from forward.fem.model import HyperelasticModel
from forward.machine import MIB, headroom
from forward.model import FloatArray, Guess, SolveError
from forward.phases import phase

if TYPE_CHECKING:
    from forward.fem.solution import FiniteElementSolution
    from forward.loaded import LoadedBody

BULK = 0.5  # share of the refined cells in the sum of all indicators
TIES = 1e-6  # indicators that differ by less, relative to each other, are equal: symmetric meshes stay so
# How often a marked cell is bisected. At the corner of an L, quadratic elements, an error of 1 % takes 7 500 unknowns
# with 1, 9 000 with 2 and 12 000 with 3; but with 1 half as much time again for all meshes together.
TIMES = 2
SEEN = 4  # last meshes from which the missed part of the error is estimated
MOST = 3.0  # largest factor on an estimate
LARGER = 1.25  # times an estimate with its factor: errors may be so large, and a tolerance holds for that


@dataclass(frozen=True)
class Cycle:
    """The results on one mesh.

    Attributes
    ----------
    cells, unknowns
        Their numbers.
    values, errors
        The outputs (m,), and their estimated errors of the mesh: the exact minus these values; NaN if there is no
        estimate.
    factors
        Factors on the errors (m,), since elements of one degree higher do not capture all.
    seconds
        Processor time of the solve and the estimate, on the first rank.
    """

    cells: int
    unknowns: int
    values: tuple[float, ...]
    errors: tuple[float, ...]
    factors: tuple[float, ...]
    seconds: float

    @property
    def sizes(self) -> FloatArray:
        """Reference sizes (m,) for relative errors: the corrected outputs, or the errors if these are larger."""
        errors = np.array(self.errors)
        return np.asarray(np.maximum(np.abs(np.array(self.values) + errors), np.abs(errors)))

    @property
    def relative(self) -> FloatArray:
        """Sizes (m,) of the errors over those of the outputs, at most 1; 0 where both are 0, as in symmetric bodies."""
        errors, sizes = np.abs(self.errors), self.sizes
        return np.divide(errors, sizes, out=np.where(np.isnan(errors), np.nan, 0.0), where=sizes > 0)


@dataclass(frozen=True, eq=False)
class Adapted:
    """A mesh that was refined.

    Attributes
    ----------
    mesh, indicators
        The mesh, and the contribution of each of its cells (c,) to the errors, with sum 1; on the first rank.
    contents
        The contents of the mesh.
    cycles
        All meshes, the last one included.
    stopped
        Why it is not refined further, if the errors are still above the tolerance.
    """

    mesh: Loaded | None
    indicators: FloatArray | None
    contents: Contents
    cycles: tuple[Cycle, ...]
    stopped: str | None


@phase("refining the mesh")
def adapt(
    spec: LoadedBody,
    comm: Any,
    parameters: tuple[str, ...],
    point: FloatArray,
    say: Callable[[str], None] = lambda _: None,
) -> Adapted:
    """Refine the mesh of a body at a point (d,) of its parameters; collective over `comm`.

    After each solve, `say` is called with a line on the first rank.

    Raises
    ------
    SolveError
        If the body has no answer on its first mesh.
    """
    settings = spec.adapt
    assert settings is not None
    marked, place, before, lift = None, None, None, None
    if comm.rank == 0:
        first, place = tetrahedra(spec.body)
        marked = Bisected.of(first)
        if spec.body.kind == "mesh" and (whole := spec.body.lifted()) is not None:
            lift = partial(lift_of, first, whole)
    found: Adapted | None = None
    cycles: tuple[Cycle, ...] = ()
    while True:
        mesh = None
        if marked is not None and place is not None:
            mesh = marked.loaded()
            points = place(mesh.points)
            mesh = replace(mesh, points=points, lift=None if lift is None else lift(points))
        held = comm.bcast(None if mesh is None else contents(mesh, ""))
        finer = spec.model_copy(update={"body": MeshInMemory.of(mesh, held, spec.body)})
        if found is not None:
            enough = f"cycles = {settings.cycles}" if len(cycles) > settings.cycles else None
            if stopped := _too_large(finer, settings.unknowns) or enough:
                return replace(found, stopped=stopped)
        begin = time.process_time()
        try:
            model = HyperelasticModel(finer, comm, parameters)
            start = None if before is None else moved(before[0], model.equations, before[1])
            solution = model.solve(point, None if start is None else Guess(model.space.scatter(start)[0]))
            cycle = _cycle(cycles, finer, solution)
            relative = cycle.relative[list(settings.named(spec))]
            indicators = _indicators(model, solution, cycle, mesh)
        except SolveError as error:
            if found is None:
                raise
            return replace(found, stopped=f"on a mesh of {finer.unknowns:,} unknowns there is no answer: {error}")
        cycles = (*cycles, replace(cycle, seconds=time.process_time() - begin))
        found = Adapted(mesh, indicators, held, cycles, None)
        before = None if finer.mixed else (model.equations, solution.state[None])
        say(_line(spec, cycle))
        if (LARGER * relative <= settings.tolerance).all():
            return found
        if marked is not None and indicators is not None:
            marked = marked.refined(largest(indicators), TIMES)


def _cycle(before: tuple[Cycle, ...], spec: LoadedBody, solution: FiniteElementSolution) -> Cycle:
    """Estimate the errors of a solution, after meshes `before`; collective."""
    values, error = solution.outputs, solution.mesh_error()
    seen = error.outputs if error.nonlinearity < 1 else np.full(len(values), np.nan)  # worth nothing
    known = [cycle for cycle in before if np.isfinite(cycle.errors).any()]
    factors = saturation(
        np.array([*(cycle.values for cycle in known), values]),
        np.array([*(np.divide(cycle.errors, cycle.factors) for cycle in known), seen]),
    )
    of_outputs, errors, missed = (tuple(map(float, part)) for part in (values, factors * seen, factors))
    return Cycle(spec.body.cell_count, spec.unknowns, of_outputs, errors, missed, 0.0)


def saturation(values: FloatArray, estimates: FloatArray) -> FloatArray:
    """Return factors (m,) on the errors (k, m) of outputs that were estimated on k meshes.

    If they are the same part 1/s of the true ones on all of the last meshes, ψ_k + s e_k is the same for all, and s is
    the slope of ψ over −e: between 1 and `MOST`, and 1 if there are fewer than three meshes.
    """
    last, seen = values[-SEEN:], estimates[-SEEN:]
    if len(last) < 3:
        return np.ones(values.shape[1])
    last, seen = last - last.mean(axis=0), seen - seen.mean(axis=0)
    square = (seen**2).sum(axis=0)
    slopes = np.divide(-(seen * last).sum(axis=0), square, out=np.ones_like(square), where=square > 0)
    return np.where(np.isnan(slopes), 1.0, np.clip(slopes, 1.0, MOST))


def largest(indicators: FloatArray) -> IntArray:
    """Return the fewest cells that have `BULK` of the sum of indicators (c,), and those that tie with the last."""
    order = np.argsort(-indicators, kind="stable")
    sums = np.cumsum(indicators[order])
    last = indicators[order[np.searchsorted(sums, BULK * sums[-1])]]
    return np.asarray(np.flatnonzero(indicators >= (1 - TIES) * last))


def _too_large(spec: LoadedBody, most: int) -> str | None:
    """Say why the mesh is too large to be made; None if it is not."""
    if spec.unknowns > most:
        return f"the next mesh would have {spec.unknowns:,} unknowns, unknowns = {most:,}"
    needed, left = spec.cost(factors=1).bytes + own_estimate(spec).bytes, headroom()
    if needed > left.size:
        return f"the next mesh, of {spec.unknowns:,} unknowns, would need {needed / MIB:,.0f} MiB, {left}"
    return None


def _indicators(
    model: HyperelasticModel, solution: FiniteElementSolution, cycle: Cycle, mesh: Loaded | None
) -> FloatArray | None:
    """Return the contributions (c,) of cells, with sum 1, on the first rank; collective.

    Indicators of several outputs are added, weighted by relative errors; outputs within the tolerance do not count.
    """
    spec = model.spec
    assert spec.adapt is not None
    named = np.array(spec.adapt.named(spec))
    relative, known = cycle.relative[named], named[cycle.sizes[named] > 0]
    open_ones = LARGER * relative > spec.adapt.tolerance
    chosen = named[open_ones] if open_ones.any() else known
    if spec.adapt.indicator == "recovery" or not len(chosen):  # of a mesh too coarse for estimates, stresses tell
        equations = solution.visit()
        stresses = _by_cell(model, equations.stresses_at_vertices())
        corners = _by_cell(model, meshes.corners_as_given(equations.mesh))  # in the order of those stresses
        if stresses is None or corners is None or mesh is None:
            return None
        found = recovery(replace(mesh, cells=corners), stresses.reshape(len(stresses), 4, 9))
        return np.asarray(found / found.sum())
    weights = np.zeros((len(chosen), len(cycle.values)))
    weights[np.arange(len(chosen)), chosen] = 1 / cycle.sizes[chosen]
    by_output = _by_cell(model, solution.mesh_indicators(weights).T)
    if by_output is None:
        return None
    found = by_output.sum(axis=1)
    return np.asarray(found / found.sum())


def _by_cell(model: HyperelasticModel, values: NDArray[Any]) -> NDArray[Any] | None:
    """Collect values (n_owned, k) of this rank's cells in the order of the mesh's arrays, on the first rank."""
    parts = model.equations.comm.gather((meshes.cells_as_given(model.equations.mesh), values))
    if parts is None:
        return None
    numbers, rows = (np.concatenate(part) for part in zip(*parts, strict=True))
    return np.asarray(rows[np.argsort(numbers)])


def _line(spec: LoadedBody, cycle: Cycle) -> str:
    assert spec.adapt is not None
    if not np.isfinite(cycle.errors).any():
        return f"mesh of {cycle.unknowns:,} unknowns: too coarse for estimates, refined where stresses jump"
    errors = ", ".join(f"{spec.outputs[i].name} {100 * cycle.relative[i]:.2g} %" for i in spec.adapt.named(spec))
    return f"mesh of {cycle.unknowns:,} unknowns: estimated errors {errors}"


def recovery(mesh: Loaded, stresses: FloatArray) -> NDArray[np.float64]:
    """Return ∫|P* − P|² dX of each tetrahedron, from P (c, 4, 9) at its vertices: an indicator that knows no outputs.

    Stresses averaged at the vertices, interpolated inside the cells, are nearer to the right ones than those of the
    elements, so that the difference of both says how wrong the latter are: O. C. Zienkiewicz, J. Z. Zhu, A simple error
    estimator and adaptive procedure for practical engineering analysis, Int. J. Numer. Meth. Eng. 24 (1987) 337–357.

    P* is linear in a cell; at a vertex it is the mean of P over the cells of one region that meet there, by volume:
    across an interface of materials stresses do jump.
    """
    at = mesh.points[mesh.cells]
    volumes = np.abs(np.linalg.det(at[:, 1:] - at[:, :1])) / 6
    vertices = (mesh.cells * len(mesh.regions) + mesh.region[:, None]).ravel()
    shares = np.repeat(volumes, 4)
    size = len(mesh.points) * len(mesh.regions)
    total = np.bincount(vertices, weights=shares, minlength=size)
    found = np.zeros(len(mesh.cells))
    for component in np.moveaxis(stresses, 2, 0):
        sums = np.bincount(vertices, weights=shares * component.ravel(), minlength=size)
        recovered = np.divide(sums, total, out=np.zeros(size), where=total > 0)
        jump = recovered[vertices].reshape(component.shape) - component
        # ∫ λ_i λ_j dX = (1 + δ_ij) V/20 of barycentric coordinates λ.
        found += volumes / 20 * ((jump**2).sum(axis=1) + jump.sum(axis=1) ** 2)
    return found
