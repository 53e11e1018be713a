"""A reduced model that follows parameters as they move: a correction or two a frame, with a factor that is kept.

Two rates, as in haptics: a `Local` model (factor, slopes, error estimate) is made now and then, wherever there is time
for it, and every frame predicts with its slopes and corrects with its factor the nonlinear equations at the parameters
of the frame. A correction that would not end in time is not begun: the frame is the last one, moved along the slopes,
and the corrections are made once it has been sent.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from forward.model import FloatArray
from forward.reduced.model import ReducedModel
from forward.reduced.reduced_equations import ReducedEquations

CLOSE = 1e-4  # forces left, relative to what they would be if they did not cancel, at which a frame is done
MOST = 3  # corrections in a frame
LONGER, SHORTER = 0.05, 0.5  # share of the newest time in the time that something takes
LOST = 0.3  # forces left from which on the factor is too far away
OPEN = 1e-2  # forces left before the last correction from which on the frame is no answer of the model yet
FADES = 0.5  # share of what tangents missed that is kept from one local model to the next


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
    errors
        Estimated errors (m,): those of the local model, and of outputs that are on its tangent what that may miss. What
        tangents missed of their own predictions when the last local models came is what they are taken to miss now.
    residual
        Forces that were left before the last correction, relative to what they would be if they did not cancel.
    corrections
        How many corrections were made: none where there was no time, or where the local model is too far away.
    """

    outputs: FloatArray
    errors: FloatArray
    residual: float
    corrections: int


class Stream:
    """Frames of a reduced model, of all its parameters.

    Attributes
    ----------
    behind
        Whether the newest parameters were answered without corrections for want of time.
    takes, besides
        Times (s) that a correction takes, and that the outputs take after it.
    """

    def __init__(self, model: ReducedModel, at: Local) -> None:
        self.model, self.level = model, model.level
        self.here = at
        self.modes = at.modes.copy()
        self.parameters = at.parameters.copy()
        self.outputs = at.outputs.copy()  # at these parameters
        self.lost = False  # whether a new local model is needed
        self.unbalanced = False  # whether forces were far from balance before the last correction
        self.behind, self.takes, self.besides = False, 0.0, 0.0
        self._bent = np.zeros(len(at.outputs))  # what a tangent misses, over what it predicts
        self._each_frame = [i for i, output in enumerate(model.data.outputs) if output.kind != "peak"]

    def moved(self, at: Local) -> None:
        """Use another local model from now on."""
        if self.lost:
            self.modes, self.parameters, self.outputs = at.modes.copy(), at.parameters.copy(), at.outputs.copy()
            self.unbalanced = False
        else:
            own = self._from_here(at, self.parameters)
            own[self._each_frame] = self.outputs[self._each_frame]
            missed = np.abs(own - self._from_here(self.here, self.parameters))
            far = self._far(self.here.parameters, self.parameters)
            self._bent = np.maximum(np.divide(missed, far, out=np.zeros_like(far), where=far > 0), FADES * self._bent)
            self.outputs = own
        self.here, self.lost = at, False

    @staticmethod
    def _from_here(at: Local, parameters: FloatArray) -> FloatArray:
        return at.outputs + at.jacobian @ (parameters - at.parameters)

    def _far(self, start: FloatArray, end: FloatArray) -> FloatArray:
        """How much each parameter moves the outputs (m,) along the tangent, summed over them without their signs."""
        return np.asarray(np.abs(self.here.jacobian) @ np.abs(end - start))

    def linear(self, parameters: FloatArray) -> Frame:
        """Return the last frame moved along the slopes to parameters (d,), without solving anything."""
        if self.lost:
            return Frame(self._from_here(self.here, parameters), np.full(len(self.outputs), np.nan), np.nan, 0)
        far = self._far(self.here.parameters, parameters)
        far[self._each_frame] = self._far(self.parameters, parameters)[self._each_frame]
        moved = self.here.jacobian @ (parameters - self.parameters)
        return Frame(self.outputs + moved, self.here.errors + self._bent * far, np.nan, 0)

    def frame(self, parameters: FloatArray, within: float = math.inf) -> Frame:
        """Correct the state for parameters (d,) within a time (s).

        The largest of values at many points comes from the local model.
        """
        ends = time.perf_counter() + within - self.besides
        self.behind = self.takes + self.besides > within
        if self.behind:
            return self.linear(parameters)
        level: ReducedEquations = self.level
        modes = self.modes + self.here.slopes @ (parameters - self.parameters)
        if self.lost:
            modes = self.here.modes + self.here.slopes @ (parameters - self.here.parameters)
        c = level.coordinates(parameters, modes)
        residual, corrections = np.inf, 0
        now = time.perf_counter()
        while corrections < MOST and (corrections == 0 or now + self.takes <= ends):
            R, scale = level.forces(c, parameters)
            before, residual = residual, float(np.abs(R[level.free]).max()) / (scale or 1.0)
            if not residual < before:
                break
            c[level.free] -= self.here.inverse @ R[level.free]
            corrections += 1
            since, now = now, time.perf_counter()
            self.takes = _learnt(self.takes, now - since)
            if residual <= CLOSE:
                break
        if not residual < LOST:
            self.lost = True
            return self.linear(parameters)
        self.unbalanced = residual > OPEN
        outputs, far = self._from_here(self.here, parameters), self._far(self.here.parameters, parameters)
        far[self._each_frame] = 0.0
        outputs[self._each_frame] = level.outputs(c, parameters, self._each_frame)
        self.modes, self.parameters, self.outputs = c[level.free].copy(), parameters.copy(), outputs
        self.besides = _learnt(self.besides, time.perf_counter() - now)
        return Frame(outputs.copy(), self.here.errors + self._bent * far, residual, corrections)


def _learnt(before: float, seconds: float) -> float:
    """Return how long something takes, after it took so long; what was interrupted for long says little."""
    if not before:
        return seconds
    share = SHORTER if seconds < before else LONGER
    return before + share * (min(seconds, 3 * before) - before)
