"""The equations of a body in few coordinates: forces, stiffness, and derivatives by parameters and of outputs.

With a state Σ c_k φ_k, the forces are R_i = Σ_q w_q T_q · φ_i(q) + Σ loads, T what works on the components of a virtual
displacement at a point; K = ∂R/∂c. All are the derivatives of one energy where there is one, whatever the points are.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from forward.model import FloatArray
from forward.reduced.data import LevelData, Output, Points, ReducedData
from forward.reduced.kernels import Integrand, spread

LENGTH = 3  # in place of an axis
LEAST = 0.1  # of the forces of the largest snapshot: below, forces that are left are measured against this


class At(NamedTuple):
    """Where outputs are differentiated: coordinates (N,), parameters (d,), derivatives of the forces there by both."""

    c: FloatArray
    parameters: FloatArray
    K: FloatArray
    F: FloatArray


class ReducedEquations:
    """One of the levels of a reduced model: so many modes at its points.

    Outputs are all, or those of these numbers (m,); integrands are evaluated in the precision `real`.
    """

    def __init__(
        self, data: ReducedData, level: LevelData, which: Iterable[int] | None = None, real: DTypeLike = np.float64
    ) -> None:
        self.integrals = level.integrals
        self.data, self.modes = data, level.modes
        self.before = data.before
        self.count = self.before + level.modes
        p = len(data.numbers)
        self.real = real
        pairs = zip(data.works, level.works, strict=True)
        self.works = [Integrand(tape, points, p, real) for tape, points in pairs]
        outputs = data.outputs if which is None else [data.outputs[i] for i in which]
        self._outputs = [_of_output(output, self, p) for output in outputs]
        self.free = slice(self.before, self.count)
        # In the norm of the modes forces are as large as coordinates; without loads they cancel to nothing.
        self.least = LEAST * float(np.abs(data.coordinates[:, self.free]).max(initial=0.0))

    @cached_property
    def pressures(self) -> int:
        """How many of the modes are pressures: they move no node."""
        moved = self.data.fields[self.free, : self.data.places.size]
        return int((~moved.any(axis=1)).sum())

    def coordinates(self, parameters: FloatArray, modes: FloatArray) -> FloatArray:
        """Return all coordinates (N,) from the parameters (d,) and those of the modes."""
        c = np.zeros(self.count)
        for k, (number, value) in enumerate(self.data.lifts):
            c[k] = value if number < 0 else parameters[number]
        c[self.free] = modes
        return c

    def numbers(self, parameters: FloatArray) -> FloatArray:
        """Return the numbers that integrands take."""
        return parameters[self.data.numbers]

    def coefficients(self, parameters: FloatArray) -> list[FloatArray]:
        """Return the coefficients of each random field."""
        return [parameters[which] for _, which in self.data.coefficients]

    def forces(self, c: FloatArray, parameters: FloatArray) -> tuple[FloatArray, float]:
        """Return the forces (N,) on all coordinates, and the size that they would have if they did not cancel."""
        numbers, coefficients = self.numbers(parameters), self.coefficients(parameters)
        ofs = ((work, work.values(work.inputs(c, coefficients), numbers)) for work in self.works)
        return self._summed([self.proportional(parameters), *(T.ravel() @ work.weighted for work, T in ofs)])

    def stiffness(self, c: FloatArray, parameters: FloatArray) -> tuple[FloatArray, FloatArray, float]:
        """Return the forces (N,), their derivative (N, N) by all coordinates, and that size."""
        numbers, coefficients = self.numbers(parameters), self.coefficients(parameters)
        parts, K = [self.proportional(parameters)], np.zeros((self.count, self.count))
        for work in self.works:
            inputs = work.inputs(c, coefficients)
            if work.dead:
                parts.append(work.values(inputs, numbers).ravel() @ work.weighted)
                continue
            T, H = work.by_state(inputs, numbers)
            parts.append(T.ravel() @ work.weighted)
            K += work.weighted.T @ spread(H, work.fields).reshape(-1, self.count)
        R, size = self._summed(parts)
        return R, K, size

    def _summed(self, parts: Sequence[FloatArray]) -> tuple[FloatArray, float]:
        every = np.array(parts)
        R = every.sum(axis=0)
        largest = float(np.abs(every[:, self.free]).max(initial=0.0))
        return R, max(largest, float(np.abs(R[: self.before]).max(initial=self.least)))

    def by_parameters(self, c: FloatArray, parameters: FloatArray, K: FloatArray) -> FloatArray:
        """Return the derivatives (N, d) of the forces by the parameters at coordinates of the modes that stay."""
        numbers, coefficients = self.numbers(parameters), self.coefficients(parameters)
        slopes = np.zeros((self.count, len(parameters)))
        for work in self.works:
            by_logs, by_numbers = work.by_parameters(work.inputs(c, coefficients), numbers)
            moved = np.einsum("kpn->pkn", by_numbers).reshape(len(numbers), -1)
            np.add.at(slopes.T, self.data.numbers, moved @ work.weighted)
            for i, (number, _, change) in enumerate(work.points.logs):
                moved = (by_logs[:, i, :, None] * change).reshape(-1, change.shape[1])
                slopes[:, self.data.coefficients[number][1]] += work.weighted.T @ moved
        for number, _, row in self.data.dead:
            if number >= 0:
                slopes[:, number] += row[: self.count]
        for k, (number, _) in enumerate(self.data.lifts):
            if number >= 0:
                slopes[:, number] += K[:, k]
        return slopes

    def proportional(self, parameters: FloatArray) -> FloatArray:
        """Return the forces (N,) of loads that are proportional to a number."""
        R = np.zeros(self.count)
        for number, value, row in self.data.dead:
            R += (value if number < 0 else parameters[number]) * row[: self.count]
        return R

    def outputs(self, c: FloatArray, parameters: FloatArray, which: Sequence[int] | None = None) -> FloatArray:
        """Return the outputs (m,), or some of them by number."""
        some = self._outputs if which is None else [self._outputs[i] for i in which]
        return np.array([output.value(c, parameters) for output in some])

    def outputs_together(self, c: FloatArray, parameters: FloatArray) -> FloatArray:
        """Return the outputs (s, m) at coordinates (s, N) and parameters (s, d) of several samples."""
        if not len(c):
            return np.zeros((0, len(self._outputs)))
        return np.array([output.values(c, parameters) for output in self._outputs]).T.copy()

    def output_slopes(self, at: At) -> tuple[FloatArray, FloatArray]:
        """Return derivatives of the outputs by the coordinates (m, N) and by the parameters (m, d)."""
        pairs = [output.slopes(at) for output in self._outputs]
        by_state = np.array([one for one, _ in pairs]).reshape(-1, self.count)
        by_parameters = np.array([other for _, other in pairs]).reshape(-1, len(at.parameters))
        for k, (number, _) in enumerate(self.data.lifts):
            if number >= 0:
                by_parameters[:, number] += [
                    0.0 if output.whole else row[k] for output, row in zip(self._outputs, by_state, strict=True)
                ]
        return by_state, by_parameters


class _Output:
    """An output of a level; `whole` if its derivatives by parameters know what prescribed displacements move."""

    whole = False

    def __init__(self, output: Output, level: ReducedEquations) -> None:
        self.output, self.level = output, level

    def value(self, c: FloatArray, parameters: FloatArray) -> float:
        raise NotImplementedError

    def values(self, c: FloatArray, parameters: FloatArray) -> FloatArray:
        """Return the values (s,) of several samples."""
        return np.array([self.value(one, point) for one, point in zip(c, parameters, strict=True)])

    def slopes(self, at: At) -> tuple[FloatArray, FloatArray]:
        raise NotImplementedError


class _Linear(_Output):
    """ψ = row · c."""

    def _row(self) -> FloatArray:
        assert self.output.row is not None
        return self.output.row[: self.level.count]

    def value(self, c: FloatArray, parameters: FloatArray) -> float:
        return float(self._row() @ c)

    def slopes(self, at: At) -> tuple[FloatArray, FloatArray]:
        return self._row(), np.zeros(len(at.parameters))


class _Work(_Output):
    """ψ = the work of all forces on a test field."""

    whole = True

    @property
    def _place(self) -> int:
        return len(self.level.data.lifts) + self.output.which

    def value(self, c: FloatArray, parameters: FloatArray) -> float:
        return float(self.level.forces(c, parameters)[0][self._place])

    def slopes(self, at: At) -> tuple[FloatArray, FloatArray]:
        return at.K[self._place], at.F[self._place].copy()


class _Largest(_Output):
    """ψ = the largest displacement over the nodes; of those that are equal the first counts."""

    @cached_property
    def _rows(self) -> FloatArray:
        axes = range(3) if self.output.which == LENGTH else (self.output.which,)
        n = 3 * len(self.level.data.places)
        level = self.level
        return np.ascontiguousarray([level.data.fields[: level.count, axis:n:3].T for axis in axes], level.real)

    def _there(self, c: FloatArray) -> tuple[int, FloatArray]:
        u = self._rows @ c
        sizes = np.sqrt((u**2).sum(axis=0))
        node = int(np.argmax(~(sizes < sizes.max() * (1 - 1e-10))))  # also where there are no numbers
        return node, u[:, node]

    def value(self, c: FloatArray, parameters: FloatArray) -> float:
        return float(np.linalg.norm(self._there(c)[1]))

    def values(self, c: FloatArray, parameters: FloatArray) -> FloatArray:
        c = c.astype(self.level.real, copy=False)
        squares = np.sum([(c @ rows.T) ** 2 for rows in self._rows], axis=0)
        return np.asarray(np.sqrt(squares.max(axis=1)))

    def slopes(self, at: At) -> tuple[FloatArray, FloatArray]:
        node, u = self._there(at.c)
        size = float(np.linalg.norm(u))
        row = (u / size) @ self._rows[:, node] if size else np.zeros(self.level.count)
        return row, np.zeros(len(at.parameters))


class _OfDensity(_Output):
    """An output of values at points: their weighted sum, or the largest."""

    def __init__(self, output: Output, level: ReducedEquations, points: Points, numbers: int) -> None:
        super().__init__(output, level)
        assert output.density is not None
        self._density = Integrand(output.density, points, numbers, level.real)

    def _weights(self, values: FloatArray) -> FloatArray:
        raise NotImplementedError

    def value(self, c: FloatArray, parameters: FloatArray) -> float:
        level = self.level
        inputs = self._density.inputs(c, level.coefficients(parameters))
        values = self._density.values(inputs, level.numbers(parameters))[0]
        return float(self._weights(values) @ values)

    def values(self, c: FloatArray, parameters: FloatArray) -> FloatArray:
        return np.array([self._weights(values) @ values for values in self._at(c, parameters)])

    def _at(self, c: FloatArray, parameters: FloatArray) -> FloatArray:
        """Return the values (s, n) of the density at the points."""
        level = self.level
        coefficients, numbers = zip(*((level.coefficients(p), level.numbers(p)) for p in parameters), strict=True)
        return self._density.at(c, coefficients, numbers)[:, 0]

    def slopes(self, at: At) -> tuple[FloatArray, FloatArray]:
        level, density = self.level, self._density
        inputs, numbers = density.inputs(at.c, level.coefficients(at.parameters)), level.numbers(at.parameters)
        values, by_state = density.by_state(inputs, numbers)
        weights = self._weights(values[0])
        by_logs, by_numbers = density.by_parameters(inputs, numbers)
        slopes = np.zeros(len(at.parameters))
        np.add.at(slopes, level.data.numbers, by_numbers[0] @ weights)
        for i, (number, _, change) in enumerate(density.points.logs):
            slopes[level.data.coefficients[number][1]] += (weights * by_logs[0, i]) @ change
        row: FloatArray = (by_state[0] * weights).ravel() @ density.fields.reshape(-1, density.fields.shape[2])
        return row, slopes


class _Integral(_OfDensity):
    def _weights(self, values: FloatArray) -> FloatArray:
        return self._density.points.weights / self.output.size


class _Peak(_OfDensity):
    def values(self, c: FloatArray, parameters: FloatArray) -> FloatArray:
        return np.asarray(self._at(c, parameters).max(axis=1))

    def _weights(self, values: FloatArray) -> FloatArray:
        weights = np.zeros(len(values))
        weights[int(np.argmax(values))] = 1.0
        return weights


def _of_output(output: Output, level: ReducedEquations, numbers: int) -> _Output:
    kind = {"linear": _Linear, "work": _Work, "largest": _Largest}.get(output.kind)
    if kind is not None:
        return kind(output, level)
    of_density = {"integral": _Integral, "peak": _Peak}.get(output.kind)
    if of_density is None:
        raise ValueError(f"the file has an output of the unknown kind '{output.kind}'")
    points = level.integrals[output.which] if output.points is None else output.points.of(level.count)
    return of_density(output, level, points, numbers)
