"""What solves say beside the results of a method: of a body at the mean of the inputs, and of any model."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from forward.bodies.crossing import CREASED, deepest, least_stretch
from forward.bodies.mesh import surface_of
from forward.external.derivatives import mistrusted
from forward.findings import Entry, Finding
from forward.model import FloatArray, ForwardModel, ReferenceSolution, Solution, SolveError
from forward.readable import number, place, told, with_unit
from uq.estimators.failure_domain import of_jumps
from uq.evaluation.block import merge
from uq.evaluation.request import Evaluate, Evaluations, FieldSum, Prediction, Request
from uq.inputs.random_parameters import Inputs

if TYPE_CHECKING:
    import xarray as xr

    from forward.fem.model import HyperelasticModel

Cell = Literal["tetrahedron", "hexahedron"]
AFFORDABLE = 30_000  # unknowns of a solve beside those of the study
SHARE, QUICK = 0.05, 1.0  # of all solves, and s: what asking a model again may take, the larger of both
TINY = 1e-9  # s, that a solve takes at least
EACH = 3  # solves where derivatives are compared
AWAY = (0.35, -0.35)  # of the probability of each parameter, from its median: one standard deviation to both sides
TENSOR = ("xx", "yy", "zz", "xy", "yz", "xz")  # the order of ParaView


@dataclass(frozen=True)
class Touched(FieldSum):
    """What each tool touches as rows (tools, U): of a node the pressure (Pa), and 1 at a vertex that may touch."""

    tools: tuple[str, ...]  # labels

    def on(self, model: Any) -> Callable[[Solution, FloatArray], FloatArray]:
        """Return the function (solution, parameters) → rows (tools, U_local), for one group's model."""
        from scipy.spatial import cKDTree

        nodes = cKDTree(model.space.coordinates)

        def rows(solution: Any, _: FloatArray) -> FloatArray:
            found = solution.visit().touched()
            whole = np.zeros((len(self.tools), model.equations.comm.allreduce(len(solution.state))))
            for row, tool in zip(whole, self.tools, strict=True):
                at = 3 * nodes.query(found[tool][:, :3])[1]
                row[at], row[at + 1] = found[tool][:, 3], 1.0
            return np.asarray(model.space.scatter(whole))

        return rows


def with_contact(
    dataset: xr.Dataset, model: Any, inputs: Inputs, evaluate: Evaluate, first: Evaluations | None
) -> xr.Dataset:
    """Add the vertices under the tools of a body, with the pressures there, at the mean of the inputs.

    Where what the method has evaluated `first` is the mean with its state, that is where the solve begins.
    """
    tools, places = tuple(load.label for load in model.spec.loads if load.contact), model.space.coordinates
    found = evaluate(Request(inputs.mean[None], fields=Touched(tools), start=at_mean(inputs, first)))
    if found.failures:
        return dataset
    of_nodes = found.fields[:, : places.size].reshape(len(tools), -1, 3)
    tool, node = np.nonzero(of_nodes[:, :, 1])
    order = np.lexsort((node, np.array(tools)[tool]))  # nodes have an order that ranks do not change
    tool, node = tool[order], node[order]
    vertex = ("contact_vertex",)
    return dataset.assign_coords(contact_tool=(vertex, np.array(tools)[tool])).assign(
        contact_position=((*vertex, "axis"), places[node], {"units": "m"}),
        contact_pressure=(vertex, of_nodes[tool, node, 0], {"units": "Pa"}),
    )


def at_mean(inputs: Inputs, first: Evaluations | None) -> Prediction | None:
    """Return the state at the mean of the inputs, if that is what was evaluated first and its state is known."""
    if first is None or not np.array_equal(first.points, inputs.mean[None]) or not first.ok.all():
        return None
    if first.tangents is None or first.fields.size == 0:
        return None
    reference = ReferenceSolution(inputs.mean, first.fields[0], inputs.std, bool(first.joined[0]))
    return Prediction(reference, first.fields[:0], inputs.coordinates)


def stressed(model: Any, mean: FloatArray) -> FloatArray | None:
    """Return Cauchy stresses (Pa) and Green–Lagrange strains (2, N, 6) at the nodes, at the mean (d,) of the inputs.

    None where there is no answer, and on other ranks than the first; collective over the model's ranks.
    """
    found: FloatArray | None = None
    with suppress(SolveError):
        found = model.solve(mean).visit().stressed()
    return found


def with_stresses(dataset: xr.Dataset, found: FloatArray | None) -> xr.Dataset:
    """Add stresses and strains, if fields are stored at the nodes."""
    if found is None or "node" not in dataset.dims:
        return dataset
    by_node = ("node", "tensor")
    return dataset.assign_coords(tensor=list(TENSOR)).assign(
        node_stress=(by_node, found[0], {"units": "Pa"}),
        node_strain=(by_node, found[1], {"units": "1"}),
        von_mises=(("node",), von_mises(found[0]), {"units": "Pa"}),
    )


def von_mises(stress: FloatArray) -> FloatArray:
    """Return the von Mises stresses (n,) of stresses (n, 6): √(3/2 s:s) with the deviator s."""
    normal, shear = stress[:, :3], stress[:, 3:]
    deviator = normal - normal.mean(axis=1, keepdims=True)
    return np.asarray(np.sqrt(1.5 * ((deviator**2).sum(axis=1) + 2 * (shear**2).sum(axis=1))))


def measured(model: HyperelasticModel, mean: FloatArray, reach: Mapping[str, tuple[float, float]]) -> list[Finding]:
    """Compare outputs at the mean (d,) of the inputs with a form that locks less; collective over the model's ranks.

    Empty if the body does not lock by the tables, for parameters within `reach`, or if the solve would be too large or
    fails.
    """
    spec, better = model.spec, model.spec.unlocked()
    tables = spec.locking(reach)
    if better.unknowns > AFFORDABLE or not any(finding.severity == "warning" for finding in tables):
        return []
    try:
        solutions = model.solve(mean), better.build(model.equations.comm, model.parameters).solve(mean)
    except SolveError:
        return []
    if any(solution.work.snaps for solution in solutions):  # not the same branch, so nothing about the form
        return []
    found, right = (solution.outputs for solution in solutions)
    units = {output.name: output.unit for output in spec.returned}
    said = [
        Entry(
            name,
            f" = {with_unit(number(float(value)), units[name])}, there {with_unit(number(float(other)), units[name])}",
            float(value),
        )
        for name, value, other in zip(model.outputs, found, right, strict=True)
    ]
    form = "quadratic cells and pressures" if better.mixed else "quadratic cells"
    return [Finding("locking-measured", "warning", {"form": form}, about=tuple(said))]


def crossings(
    first: Evaluations | None, points: FloatArray, nodes: FloatArray, cells: NDArray[np.int64], cell: Cell
) -> Iterator[Finding]:
    """Say where a body passes through itself, or its surface would crease: at the mean, and where it moves most.

    That is, of solved parameters `points` (n, d), where derivatives predict the largest displacement: the evaluation
    `first`, at the mean, has the state and its derivatives as fields. Nodes (N, 3) are in m, those of cells in VTK's
    order, corners first.
    """
    if first is None or not first.fields.size or not first.ok[0]:
        return
    state, *slopes = first.fields[:, : nodes.size]
    states = {"At the mean parameters": state}
    if len(slopes) == points.shape[1] and len(points):
        moves, along = points - first.points[0], np.array(slopes)
        sizes = 2 * moves @ (along @ state) + np.einsum("ni,ij,nj->n", moves, along @ along.T, moves)
        states["Where the displacement is predicted to be largest"] = state + moves[sizes.argmax()] @ along
    cells = cells[:, : 4 if cell == "tetrahedron" else 8]
    faces, _ = surface_of(cells, cell)
    for where, one in states.items():
        moved = nodes + one.reshape(-1, 3)
        vertex, stretch = least_stretch(nodes, moved, faces)
        if stretch < CREASED:
            values = {"where": where, "place": place(nodes[vertex].tolist()), "short": 100 * (1 - stretch)}
            yield Finding("surface-creases", "note", values)
        found = deepest(moved, cells, cell, faces)
        if found is not None:
            at, deep = place(nodes[found[0]].tolist()), told(found[1], "m")
            yield Finding("passes-through-itself", "warning", {"where": where, "place": at, "deep": deep})
        if found is not None or stretch < CREASED:
            return


def of_answers(model: ForwardModel, inputs: Inputs, solved: Sequence[Evaluations] = ()) -> tuple[Finding, ...]:
    """Ask a model from outside again at the mean, and compare its derivatives there and elsewhere; on rank 0.

    That is nearly free: what was `solved` before, where that is known, begins with the mean. Of slow models, only as
    many solves are added as are a small share of those of the study.
    """
    spare, known, spread = math.inf, None, None
    if solved:
        first, every = solved[0], merge(solved)
        spare = max(SHARE * len(every.points), QUICK / max(float(every.seconds.mean()), TINY))
        known = first.outputs[0] if np.array_equal(first.points[0], inputs.mean) and first.ok[0] else None
        spread = every.outputs[every.ok].std(axis=0) if every.ok.sum() > 1 else None
    if spare < 1:
        return ()
    each = EACH if model.differentiable else math.inf
    away = AWAY[: int(min(len(AWAY), max(spare - each, 0) // each))]
    signs = np.random.default_rng(0).choice([-1.0, 1.0], len(inputs.mean))
    others = [inputs.points(0.5 + share * signs[None])[0] for share in away]
    return mistrusted(model, np.array([inputs.mean, *others]), inputs.std, known, spread)


def findings_of_solves(evaluations: Iterable[Evaluations]) -> list[Finding]:
    """Say how many solves had parameters without a model, of zero likelihood, and where a body has several states."""
    every = list(evaluations)
    jumps = list(of_jumps(every))
    lost = [failure for found in every for failure in found.failures if failure.inadmissible]
    if not lost:
        return jumps
    solves = sum(len(found.points) for found in every)
    return [
        Finding("solves-inadmissible", "note", {"lost": len(lost), "solves": solves, "reason": lost[0].reason}),
        *jumps,
    ]
