"""A reduced model that follows parameters as they move: a correction or two a frame, with a factor that is kept.

Two rates, as in haptics: a `Local` model (factor, slopes, error estimate) is made now and then, wherever there is time
for it, and every frame predicts with its slopes and corrects with its factor the nonlinear equations at the parameters
of the frame. Where there is no time even for that, a frame is the local model alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from forward.model import FloatArray
from forward.reduced.level import Level
from forward.reduced.model import ReducedModel

CLOSE = 1e-4  # forces left, relative to what they would be if they did not cancel, at which a frame is done
MOST = 3  # corrections in a frame
LOST = 0.3  # forces left from which on the factor is too far away


@dataclass(frozen=True, eq=False)
class Local:
    """The linearisation of a reduced model at one place.

    Attributes
    ----------
    parameters, modes
        Place: all parameters (d,), coordinates of the modes (n,).
    inverse
        Inverse (n, n) of the stiffness.
    slopes
        Derivatives (n, d) of the coordinates by the parameters.
    outputs, jacobian
        Outputs (m,), and their derivatives (m, d) along the equilibria.
    errors
        Estimated errors (m,) of the outputs.
    spread
        Standard deviations (m,) of the outputs due to the parameters that are uncertain, to first order.
    """

    parameters: FloatArray
    modes: FloatArray
    inverse: FloatArray
    slopes: FloatArray
    outputs: FloatArray
    jacobian: FloatArray
    errors: FloatArray
    spread: FloatArray


def local(model: ReducedModel, parameters: FloatArray, start: FloatArray | None, uncertain: FloatArray) -> Local:
    """Solve and linearise at all parameters (d,), of which the uncertain ones have standard deviations (d,), others 0.

    Raises
    ------
    SolveError
        Where there is no equilibrium.
    """
    solution = model.reduced(parameters, start)
    free = model.level.free
    jacobian = solution.jacobian
    return Local(
        np.array(parameters),
        solution.c[free].copy(),
        np.linalg.inv(solution.stiffness[free, free]),
        solution.slopes[free].copy(),
        np.array(solution.outputs),
        jacobian,
        np.array(solution.estimate.outputs),
        np.sqrt(((jacobian * uncertain) ** 2).sum(axis=1)),
    )


class Frame(NamedTuple):
    """What a frame knows.

    Attributes
    ----------
    outputs
        Outputs (m,).
    residual
        Forces that were left before the last correction, relative to what they would be if they did not cancel.
    corrections
        How many corrections were made: none in a frame of the local model alone.
    """

    outputs: FloatArray
    residual: float
    corrections: int


class Stream:
    """Frames of a reduced model.

    Parameters
    ----------
    model
        The model, of all its parameters.
    at
        Where it begins.
    """

    def __init__(self, model: ReducedModel, at: Local) -> None:
        self.model, self.level = model, model.level
        self.here = at
        self.modes = at.modes.copy()
        self.parameters = at.parameters.copy()
        self.lost = False  # whether a new local model is needed
        self._each_frame = [i for i, output in enumerate(model.data.outputs) if output.kind != "peak"]

    def moved(self, at: Local) -> None:
        """Use another local model from now on."""
        self.here, self.lost = at, False

    def linear(self, parameters: FloatArray) -> Frame:
        """Return what the local model says at parameters (d,), without solving anything."""
        return Frame(self.here.outputs + self.here.jacobian @ (parameters - self.here.parameters), np.nan, 0)

    def frame(self, parameters: FloatArray) -> Frame:
        """Correct the state for parameters (d,); the largest of values at many points comes from the local model."""
        level: Level = self.level
        modes = self.modes + self.here.slopes @ (parameters - self.parameters)
        if self.lost:
            modes = self.here.modes + self.here.slopes @ (parameters - self.here.parameters)
        c = level.coordinates(parameters, modes)
        residual, corrections = np.inf, 0
        while corrections < MOST:
            R, scale = level.forces(c, parameters)
            before, residual = residual, float(np.abs(R[level.free]).max()) / (scale or 1.0)
            if not residual < before:
                break
            c[level.free] -= self.here.inverse @ R[level.free]
            corrections += 1
            if residual <= CLOSE:
                break
        if not residual < LOST:
            self.lost = True
            return self.linear(parameters)
        self.modes, self.parameters = c[level.free].copy(), parameters.copy()
        outputs = self.linear(parameters).outputs
        outputs[self._each_frame] = level.some_outputs(self._each_frame, c, parameters)
        return Frame(outputs, residual, corrections)


def begin(model: ReducedModel, uncertain: FloatArray) -> Stream:
    """Return a stream that begins at the mean parameters."""
    return Stream(model, local(model, model.data.nominal, None, uncertain))
