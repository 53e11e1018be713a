"""An integrand of a reduced model at its points: values, and derivatives by the state and by parameters."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import DTypeLike

from forward.model import FloatArray
from forward.reduced.data import Points, Written
from forward.reduced.kernels import Kernel


class Integrand:
    """An integrand at points, and its derivatives by what it takes.

    Parameters
    ----------
    written, points
        What it is, and where.
    numbers
        How many numbers it takes.
    real
        In what precision it is evaluated.
    """

    def __init__(self, written: Written, points: Points, numbers: int, real: DTypeLike = np.float64) -> None:
        self._written, self.points, self.real = written, points, real
        m, n, count = points.fields.shape
        self.components, self._varying = m, m + len(points.given) + len(points.logs)
        self.fields = points.fields.astype(real, copy=False)
        self._flat = self.fields.reshape(m * n, count)
        weighted = (points.weights[:, None] * points.fields).reshape(m * n, count)
        self.weighted = np.ascontiguousarray(weighted, real)
        self._numbers = numbers
        self._inputs = np.empty((self._varying, n), real)  # filled again and again: what is given never changes
        self._inputs[m : m + len(points.given)] = points.given

    def _derived(self, along: Sequence[int]) -> Kernel:
        """Compile the outputs followed by their derivatives by inputs, each output by all of these."""
        graph, outputs = self._written.tape.graph()
        slopes = [graph.tangent(outputs, i) for i in along]
        by_output = [one for row in zip(*slopes, strict=True) for one in row] if along else []
        return Kernel(graph.tape([*outputs, *by_output]), self._varying, self.real)

    @cached_property
    def _values(self) -> Kernel:
        return self._derived(())

    @cached_property
    def dead(self) -> bool:
        """Whether its outputs do not depend on the state."""
        graph, outputs = self._written.tape.graph()
        slopes = (one for i in range(self.components) for one in graph.tangent(outputs, i))
        return all(graph.value(one) == 0 for one in slopes)

    @cached_property
    def _by_state(self) -> Kernel:
        return self._derived(range(self.components))

    @cached_property
    def _by_parameters(self) -> Kernel:
        first = self.components + len(self.points.given)
        return self._derived(range(first, first + len(self.points.logs) + self._numbers))

    def inputs(self, c: FloatArray, coefficients: Sequence[FloatArray]) -> FloatArray:
        """Return what the integrand takes (varying, n) at coordinates, with the coefficients of all random fields.

        The array holds until this or `without_state` is called again.
        """
        found = self.without_state(coefficients)
        np.dot(self._flat, c.astype(self.real, copy=False), out=found[: self.components].reshape(-1))
        return found

    def without_state(self, coefficients: Sequence[FloatArray]) -> FloatArray:
        """Return what the integrand takes (varying, n) with no meaning in the rows of the state, as `inputs` does."""
        self._inputs[self._varying - len(self.points.logs) :] = self.logs([coefficients])[0]
        return self._inputs

    def logs(self, coefficients: Sequence[Sequence[FloatArray]]) -> FloatArray:
        """Return the logarithms (s, f, n) of its fields, with the coefficients of all fields of several samples."""
        points = self.points
        found = np.empty((len(coefficients), len(points.logs), len(points.weights)))
        for k, (number, log, slopes) in enumerate(points.logs):
            found[:, k] = log + np.array([one[number] for one in coefficients]) @ slopes.T
        return found

    def states(self, c: FloatArray) -> FloatArray:
        """Return the components (s, m, n) of the states at coordinates (s, N) of several samples."""
        return np.asarray((c.astype(self.real, copy=False) @ self._flat.T).reshape(len(c), self.components, -1))

    def values(self, inputs: FloatArray, numbers: FloatArray, out: FloatArray | None = None) -> FloatArray:
        """Return its outputs (k, n), in an array that is given or a new one."""
        return self._values(inputs, numbers, out)

    @property
    def size(self) -> int:
        """Number k of its outputs at a point."""
        return self._values.size

    def at(
        self, c: FloatArray, coefficients: Sequence[Sequence[FloatArray]], numbers: Sequence[FloatArray]
    ) -> FloatArray:
        """Return its outputs (s, k, n) at coordinates (s, N), coefficients and numbers of several samples."""
        inputs, first = self._inputs, self._varying - len(self.points.logs)
        found = np.empty((len(c), self.size, inputs.shape[1]), self.real)
        for out, of_sample, components, log in zip(
            found, numbers, self.states(c), self.logs(coefficients), strict=True
        ):
            inputs[: self.components], inputs[first:] = components, log
            self.values(inputs, of_sample, out)
        return found

    def by_state(self, inputs: FloatArray, numbers: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return its outputs (k, n), and their derivatives (k, m, n) by the components of the state."""
        found = self._by_state(inputs, numbers)
        k = len(found) // (1 + self.components)
        return found[:k], found[k:].reshape(k, self.components, -1)

    def by_parameters(self, inputs: FloatArray, numbers: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return derivatives (k, f, n) of its outputs by the logarithms of its fields, and (k, p, n) by numbers."""
        found = self._by_parameters(inputs, numbers)
        logs = len(self.points.logs)
        k = len(found) // (1 + logs + self._numbers)
        slopes = found[k:].reshape(k, logs + self._numbers, -1)
        return slopes[:, :logs], slopes[:, logs:]
