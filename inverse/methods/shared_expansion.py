"""One expansion for all data sets of a batch: the solves that they share.

Data sets of one kind of specimen differ in what was measured, not in the model. So the model is solved at points of the
prior once, outputs are expanded in polynomials fitted to values and derivatives (`uq.surrogates.regression`), and every
data set is inverted with the expansion, which costs next to nothing. What finer meshes say of the error of the mesh
is smooth and small: a few solves expand it too. How far the expansions miss samples that are left out counts among
the errors of the data.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri

from forward.model import FloatArray, SolveError
from forward.pointwise import FunctionModel
from inverse.criticism.finer import Finer, Solved
from inverse.methods.invert import LEAST_SHARED
from uq.evaluation.request import Evaluate, Request
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.surrogates.basis import Basis
from uq.surrogates.linearisation import linearise
from uq.surrogates.regression import Regression

ORDER = 8  # highest degree that is tried
WIDER = 1.5  # standard deviations of the points over those of the prior: data may come from its tails
MARGIN = 0.3  # of the range of the points, by which the expansions reach beyond it on either side
FEWER = 4  # solves for each on finer meshes


@dataclass(frozen=True, eq=False)
class SharedExpansion:
    """Expansions in place of a model.

    Attributes
    ----------
    model
        The expansion of its outputs.
    finer
        That of what finer meshes say; None if there are no meshes.
    error
        Root mean square (m,) of the errors at samples that are left out, of both together.
    solves, finer_solves
        Numbers of solves.
    """

    model: FunctionModel
    finer: Finer | None
    error: FloatArray
    solves: int
    finer_solves: int


@dataclass(frozen=True, eq=False)
class _Expansion:
    """A polynomial on a range (d,) of its coordinates."""

    basis: Basis
    coefficients: FloatArray
    lower: FloatArray
    upper: FloatArray

    def outputs(self, point: FloatArray) -> FloatArray:
        self._check(point)
        return np.asarray(self.basis.values(point[None])[0] @ self.coefficients)

    def slopes(self, point: FloatArray) -> FloatArray:
        """Derivatives (m, d)."""
        self._check(point)
        along = (self.basis.derivatives(point[None]) @ self.coefficients)[0].T
        return np.asarray(along / self.basis.coordinates.steps(point[None])[0])

    def _check(self, point: FloatArray) -> None:
        at = self.basis.coordinates.of(point[None])[0]
        if (at < self.lower).any() or (at > self.upper).any():
            raise SolveError("beyond the points at which the expansion that the data sets share was fitted")


def shared_expansion(
    inputs: Inputs, evaluate: Evaluate, finer: Evaluate | None, samples: int, why: str = ""
) -> SharedExpansion:
    """Solve a model, and on finer meshes, at so many points of the prior, and expand both; collective over the groups.

    Finer meshes (`forward.fem.finer`) are None where there is nothing to look at, or where `why` says why not. Raises
    `SolveError` if too few points have an answer.
    """
    start = None
    with suppress(SolveError):  # or else every solve begins at zero
        start = linearise(inputs, evaluate, inputs.mean).prediction
    points = _points(inputs, samples)
    found = evaluate(Request(points, tangents=True, start=start))
    ok = found.ok
    assert found.tangents is not None
    own, error = _fitted(inputs, points[ok], found.outputs[ok], found.tangents[ok])
    model = FunctionModel(own.outputs, evaluate.parameters, evaluate.outputs, own.slopes)
    if finer is None:
        return SharedExpansion(model, Finer(None, why) if why else None, error, len(points), 0)
    few = _points(inputs, max(samples // FEWER, LEAST_SHARED))
    there, missed = expanded_finer(inputs, finer, few, lambda point: (own.outputs(point), own.slopes(point)))
    return SharedExpansion(model, there, np.hypot(error, missed), len(points), len(few))


def expanded_finer(
    inputs: Inputs, finer: Evaluate, points: FloatArray, own: Callable[[FloatArray], tuple[FloatArray, FloatArray]]
) -> tuple[Finer, FloatArray]:
    """Expand what finer meshes add to a model, by solves at points (n, d) of the prior; collective over the groups.

    Outputs (m,) and derivatives (m, d) of the model itself are given at parameters (d,). Returned are what finer meshes
    say anywhere, the model and the expansion of the difference, and the root mean square (m,) of the errors of the
    expansion at samples that are left out.
    """
    there = finer(Request(points, tangents=True))
    assert there.tangents is not None
    good = there.ok
    gap, slopes = there.outputs[good].copy(), there.tangents[good].copy()
    for k, point in enumerate(points[good]):
        outputs, tangents = own(point)
        m = len(outputs)
        gap[k, :m] -= outputs
        slopes[k, :m] -= tangents
    more, missed = _fitted(inputs, points[good], gap, slopes)

    def solve(point: FloatArray, tangents: bool) -> Solved:
        outputs, derivatives = more.outputs(point), more.slopes(point)
        here, of_here = own(point)
        outputs[: len(here)] += here
        derivatives[: len(here)] += of_here
        return outputs, derivatives if tangents else None

    return Finer(solve), missed[:m]


def _points(inputs: Inputs, count: int) -> FloatArray:
    """Points (n, d) of the prior, whose normal coordinates are wider, where the model is defined."""
    normals = ndtri(sobol_points(0, 0, 0, 2 * count, len(inputs.names)))
    points = np.concatenate([inputs.from_normals(width * normals)[0] for width in (WIDER, 1.0)])
    return np.asarray(points[inputs.allowed(points)][:count])


def _fitted(
    inputs: Inputs, points: FloatArray, values: FloatArray, tangents: FloatArray
) -> tuple[_Expansion, FloatArray]:
    """Expand values (n, m) with tangents (n, m, d); its errors (m,) at samples that are left out."""
    if len(points) < LEAST_SHARED:
        raise SolveError(f"{len(points)} points have an answer, too few for an expansion that the data sets share")
    found = Regression.of(inputs, points, values, tangents, ORDER)
    seen = inputs.coordinates.of(points)
    low, high = seen.min(axis=0), seen.max(axis=0)
    reach = MARGIN * (high - low)
    return _Expansion(found.basis, found.fit.coefficients, low - reach, high + reach), found.fit.loo
