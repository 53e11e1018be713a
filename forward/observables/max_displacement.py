"""Largest displacement."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from forward.bodies.geometry import AXES
from forward.model import FloatArray
from forward.observables.observable import Equations, Functional, Observable


class MaxDisplacement(Observable):
    """Largest |u_c| over the nodes (m), or largest |u| where `component` is "magnitude".

    Differentiable where only one node attains it; derivatives are those at that node.
    """

    kind: Literal["max-displacement"] = "max-displacement"
    component: Literal["x", "y", "z", "magnitude"] = "magnitude"

    @property
    def negative(self) -> bool:
        """Whether it can be below 0."""
        return False

    def functional(self, equations: Equations) -> Functional:
        """Prepare the evaluation."""
        return _Extreme(equations, None if self.component == "magnitude" else AXES.index(self.component))


class _Extreme:
    """ψ = max over the nodes of |u_c|, or of |u|; of tied nodes, the first in canonical order counts."""

    def __init__(self, equations: Equations, axis: int | None) -> None:
        self._equations = equations
        self._axis = axis

    def _candidates(self) -> FloatArray:
        u = self._equations.displacements()
        return np.asarray(np.linalg.norm(u, axis=1) if self._axis is None else np.abs(u[:, self._axis]))

    def value(self) -> float:
        from forward.fem import ranks

        return -ranks.smallest(self._equations.comm, -self._candidates().max(initial=0.0))

    def place(self) -> int:
        """Number of the node of this rank at which it is largest."""
        candidates = self._candidates()
        return int(_tied(candidates, candidates.max(initial=0.0))[0])

    def gradient(self) -> FloatArray:
        from forward.fem import ranks

        candidates, top = self._candidates(), self.value()
        ties = _tied(candidates, top)
        position = self._equations.layout.positions[ties]
        first = ranks.smallest(self._equations.comm, float(position.min(initial=np.iinfo(np.int64).max)))
        g = np.zeros((len(candidates), 3))
        if top > 0:
            for node in ties[position == first]:
                u = self._equations.displacements()[node]
                if self._axis is None:
                    g[node] = u / np.linalg.norm(u)
                else:
                    g[node, self._axis] = np.sign(u[self._axis])
        return self._equations.with_pressures(g.ravel())

    def partial(self) -> FloatArray:
        return np.zeros(len(self._equations.parameters))


def _tied(candidates: FloatArray, top: float) -> NDArray[np.intp]:
    """Number the nodes at which candidates (n,) are the largest but for rounding."""
    return np.flatnonzero(candidates >= top * (1 - 1e-10))
