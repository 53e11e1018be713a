"""Tapes at many points at once: compiled by the C compiler where there is one, by NumPy elsewhere.

What depends on numbers alone is calculated once, the rest in one loop over the points. Compiled code is kept, by a hash
of its source, in the folder of compiled forms.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterable, Sequence
from functools import cache, cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from forward.graph import CODES, SELECT, Tape
from forward.model import FloatArray
from forward.native import library
from forward.reduced.data import Points

_INFIX = {"add": "+", "mul": "*", "div": "/"}
_NAMES = {"ln": "log", "abs": "fabs"}
_REALS = {8: ("double", ""), 4: ("float", "f")}  # of so many bytes: in C, and how functions and constants of it end
_APART = "#pragma GCC ivdep"  # what one point writes no other reads
# out[i, q, :] = Σ_j H[i, j, q] B[j, q, :]: the derivative of what acts at the points along each mode.
_SPREAD = """
void spread(long rows, long columns, long n, long modes, const double *H, const double *B, double *out)
{
  for (long i = 0; i < rows; ++i)
    for (long q = 0; q < n; ++q) {
      double *restrict o = out + (i * n + q) * modes;
      for (long k = 0; k < modes; ++k) o[k] = 0.0;
      for (long j = 0; j < columns; ++j) {
        const double h = H[(i * columns + j) * n + q];
        const double *restrict b = B + (j * n + q) * modes;
        if (h != 0.0) for (long k = 0; k < modes; ++k) o[k] += h * b[k];
      }
    }
}
"""


class Kernel:
    """A tape whose first inputs vary from point to point and whose others are the same at all of them."""

    def __init__(self, tape: Tape, varying: int, real: DTypeLike = np.float64) -> None:
        self.tape, self._varying, self._real = tape, varying, np.dtype(real)
        self.size = len(tape.outputs)
        self._function = _compiled(*_source(tape, varying, *_REALS[self._real.itemsize]), "at_points")

    def __call__(self, points: FloatArray, numbers: FloatArray, out: FloatArray | None = None) -> FloatArray:
        """Return the outputs (m, n) at points (varying, n) and numbers (the other inputs,), in `out` if it is given."""
        n = points.shape[1]
        out = np.empty((self.size, n), self._real) if out is None else out
        if self._function is None:
            for row, one in zip(out, self.tape([*points, *numbers.tolist()]), strict=True):
                row[:] = one
            return out
        points, numbers = (np.ascontiguousarray(one, self._real) for one in (points, numbers))
        self._function(n, points.ctypes.data, numbers.ctypes.data, out.ctypes.data)
        return out


def spread(H: FloatArray, B: FloatArray) -> FloatArray:
    """Return Σ_j H[i, j, q] B[j, q, :], (m, n, modes), of H (m, k, n) and B (k, n, modes), both contiguous."""
    function = _spread()
    if function is None:
        return np.asarray(np.einsum("ijq,jqk->iqk", H, B))
    rows, columns, n = H.shape
    out = np.empty((rows, n, B.shape[2]))
    function(rows, columns, n, B.shape[2], H.ctypes.data, B.ctypes.data, out.ctypes.data)
    return out


@cache
def _spread() -> Any | None:
    return _compiled(_SPREAD, "", "spread")


def _source(tape: Tape, varying: int, real: str, end: str) -> tuple[str, str]:
    """Return C for a tape, and what it can do without."""
    first = tape.inputs + len(tape.constants)
    moving = {*range(varying)}  # nodes that vary
    names = [f"p[{i} * n + q]" if i < varying else f"c[{i - varying}]" for i in range(tape.inputs)]
    names += [
        f"({value!r}{end})" if np.isfinite(value) else f"({'-' * (value < 0)}INFINITY)"
        for value in tape.constants.tolist()
    ]
    outside: list[str] = []
    inside: list[str] = []
    used = {int(i) for row in tape.arguments for i in row if 0 <= i < varying}
    used |= {int(i) for i in tape.outputs if i < varying}
    for i in sorted(used):
        inside.append(f"const {real} x{i} = {names[i]};")
        names[i] = f"x{i}"
    for k, (code, row) in enumerate(zip(tape.codes.tolist(), tape.arguments.tolist(), strict=True)):
        given = [i for i in row if i >= 0]
        text = [names[i] for i in given]
        name = CODES[code]
        if name == SELECT:
            value = f"{text[0]} < {text[1]} ? {text[2]} : {text[3]}"
        elif name in _INFIX:
            value = f"{text[0]} {_INFIX[name]} {text[1]}"
        else:
            value = f"{_NAMES.get(name, name)}{end}({', '.join(text)})"
        varies = any(i in moving for i in given)
        if varies:
            moving.add(first + k)
        (inside if varies else outside).append(f"const {real} t{k} = {value};")
        names.append(f"t{k}")
    inside += [f"out[{m} * n + q] = {names[i]};" for m, i in enumerate(tape.outputs.tolist())]
    # Functions for several points in the lanes of a processor at once; not every library of C has them.
    functions = (f"log{end}({real})", f"exp{end}({real})", f"pow{end}({real}, {real})")
    in_lanes = "".join(f'__attribute__((simd("notinbranch"))) {real} {one};\n' for one in functions)
    lines = [
        "#include <math.h>",
        *in_lanes.splitlines(),
        f"void at_points(long n, const {real} *restrict p, const {real} *restrict c, {real} *restrict out)",
        *("{", *outside, _APART, "for (long q = 0; q < n; ++q) {", *inside, "}", "}"),
    ]
    return "\n".join(lines) + "\n", in_lanes


def _compiled(source: str, spare: str, name: str) -> Any | None:
    """Return a function of C, if need be without a part of it; None without a compiler, or if it fails."""
    found = library(source, against=("-lmvec", "-lm")) or library(source.replace(spare, ""))
    if found is None:
        return None
    function = found[name]
    longs = 4 if name == "spread" else 1
    function.argtypes = [ctypes.c_long] * longs + [ctypes.c_void_p] * 3
    function.restype = None
    return function


# A reduction makes several models of one body, and what a study asks of them makes them again.
@lru_cache(maxsize=256)
def _derived(tape: Tape, along: tuple[int, ...], varying: int, real: np.dtype[Any]) -> Kernel:
    """Compile the outputs followed by their derivatives by inputs, each output by all of these."""
    graph, outputs = tape.graph()
    slopes = [graph.tangent(outputs, i) for i in along]
    by_output = [one for row in zip(*slopes, strict=True) for one in row] if along else []
    return Kernel(graph.tape([*outputs, *by_output]), varying, real)


@lru_cache(maxsize=256)
def _dead(tape: Tape, components: int) -> bool:
    graph, outputs = tape.graph()
    slopes = (one for i in range(components) for one in graph.tangent(outputs, i))
    return all(graph.value(one) == 0 for one in slopes)


class Integrand:
    """An integrand at points, and its derivatives by what it takes.

    It takes so many numbers, and is evaluated in the precision `real`.
    """

    def __init__(self, tape: Tape, points: Points, numbers: int, real: DTypeLike = np.float64) -> None:
        self._tape, self.points, self.real = tape, points, real
        m, n, count = points.fields.shape
        self.components, self._varying = m, m + len(points.given) + len(points.logs)
        self.fields = points.fields.astype(real, copy=False)
        self._flat = self.fields.reshape(m * n, count)
        weighted = (points.weights[:, None] * points.fields).reshape(m * n, count)
        self.weighted = np.ascontiguousarray(weighted, real)
        self._numbers = numbers
        self._inputs = np.empty((self._varying, n), real)  # filled again and again: what is given never changes
        self._inputs[m : m + len(points.given)] = points.given

    def _derived(self, along: Iterable[int]) -> Kernel:
        return _derived(self._tape, tuple(along), self._varying, np.dtype(self.real))

    @cached_property
    def _values(self) -> Kernel:
        return self._derived(())

    @cached_property
    def dead(self) -> bool:
        """Whether its outputs do not depend on the state."""
        return _dead(self._tape, self.components)

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
