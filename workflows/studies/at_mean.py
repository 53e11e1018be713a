"""What a body has at the mean of the inputs: stresses and strains, and where tools touch it with what pressure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.model import FloatArray, SolveError
from uq.evaluation.request import Evaluate, Evaluations, Prediction, Request
from uq.inputs.random_parameters import Inputs

if TYPE_CHECKING:
    import xarray as xr

    from forward.model import Solution


TENSOR = ("xx", "yy", "zz", "xy", "yz", "xz")  # the order of ParaView


@dataclass(frozen=True)
class Touched:
    """What each tool touches as rows (tools, U): of a node the pressure (Pa), and 1 if it is a vertex that may touch.

    Attributes
    ----------
    tools
        Labels of the tools.
    """

    tools: tuple[str, ...]

    def on(self, model: Any) -> Callable[[Solution, FloatArray], FloatArray]:
        """Return the function (solution, parameters) → rows (tools, U_local), for one group's model."""
        from scipy.spatial import cKDTree

        nodes = cKDTree(model.space.coordinates)

        def rows(solution: Any, _: FloatArray) -> FloatArray:
            found = solution.touched()
            whole = np.zeros((len(self.tools), model.equations.comm.allreduce(len(solution.state))))
            for row, tool in zip(whole, self.tools, strict=True):
                at = 3 * nodes.query(found[tool][:, :3])[1]
                row[at], row[at + 1] = found[tool][:, 3], 1.0
            return np.asarray(model.space.scatter(whole))

        return rows


def with_contact(
    dataset: xr.Dataset,
    tools: tuple[str, ...],
    places: FloatArray,
    inputs: Inputs,
    evaluate: Evaluate,
    first: Evaluations | None,
) -> xr.Dataset:
    """Add the vertices under tools, with the pressures there, at the mean of the inputs.

    Parameters
    ----------
    dataset
        Results of a method.
    tools
        Their labels.
    places
        Coordinates (N, 3) of the nodes.
    inputs
        The inputs.
    evaluate
        The model.
    first
        What the method evaluated first: where that is the mean with its state, the map begins there.
    """
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
    joined = bool(first.joined[0])
    return Prediction(inputs.mean, first.fields[0], first.fields[:0], inputs.coordinates, inputs.std, joined)


def stressed(model: Any, mean: FloatArray) -> FloatArray | None:
    """Solve at the mean (d,) of the inputs; collective over the model's ranks.

    Returns
    -------
    FloatArray
        Cauchy stresses (Pa) and Green–Lagrange strains (2, N, 6) at the nodes; None where there is no answer, and on
        other ranks than the first.
    """
    try:
        found: FloatArray | None = model.solve(mean).stressed()
    except SolveError:
        return None
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
