"""Expressions of scalars as graphs: what is calculated at one point of a body, with its derivatives.

A `Graph` is built by operations that simplify and never repeat a node; `tangent` adds derivatives of nodes. A `Tape` is
the part of it that some outputs need, as arrays: it is what files hold (data, not code), NumPy evaluates it, and
`forward.reduced.kernels` compiles it. A `Scalar` is a node that Python's formulas, as energies are, build upon.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property, reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray

SELECT = "select"  # of (a, b, c, d): c where a < b, d elsewhere
OPERATIONS: dict[str, tuple[int, Callable[..., Any]]] = {  # how many nodes each takes; files know it by its place here
    "sqrt": (1, np.sqrt),
    "exp": (1, np.exp),
    "ln": (1, np.log),
    "sin": (1, np.sin),
    "cos": (1, np.cos),
    "sinh": (1, np.sinh),
    "cosh": (1, np.cosh),
    "tanh": (1, np.tanh),
    "atan": (1, np.arctan),
    "abs": (1, np.abs),
    "add": (2, np.add),
    "mul": (2, np.multiply),
    "div": (2, np.divide),
    "pow": (2, np.power),
    "atan2": (2, np.arctan2),
    SELECT: (4, lambda a, b, c, d: np.where(a < b, c, d)),
    "log1p": (1, np.log1p),
    "expm1": (1, np.expm1),
}
CODES = (*OPERATIONS,)
Node = int


@dataclass(frozen=True, eq=False)
class Tape:
    """Operations in their order; nodes are the inputs, then the constants, then the operations.

    Those that hold the same are equal: what is derived from one serves the others.

    Attributes
    ----------
    inputs
        How many there are.
    constants
        Values (c,).
    codes
        Operations (k,), as numbers in `CODES`.
    arguments
        Nodes (k, 4) that each takes; −1 where it takes fewer.
    outputs
        Nodes (m,) that are returned.
    """

    inputs: int
    constants: FloatArray
    codes: NDArray[np.int64]
    arguments: NDArray[np.int64]
    outputs: NDArray[np.int64]

    @cached_property
    def _content(self) -> tuple[bytes, ...]:
        return tuple(np.asarray(getattr(self, one.name)).tobytes() for one in fields(self))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Tape) and self._content == other._content

    def __hash__(self) -> int:
        return hash(self._content)

    def __call__(self, inputs: Sequence[Any]) -> list[Any]:
        """Return the outputs (m, n), or numbers, at inputs: arrays (n,) or numbers."""
        values: list[Any] = [*inputs, *self.constants.tolist()]
        with np.errstate(all="ignore"):
            for function, arguments in self._steps:
                values.append(function(*[values[i] for i in arguments]))
        return [values[i] for i in self.outputs]

    @cached_property
    def _steps(self) -> list[tuple[Callable[..., Any], list[int]]]:
        rows = zip(self.codes, self.arguments.tolist(), strict=True)
        return [(OPERATIONS[CODES[code]][1], [i for i in arguments if i >= 0]) for code, arguments in rows]

    def graph(self) -> tuple[Graph, list[Node]]:
        """Return a graph with the same inputs, and the outputs in it."""
        graph = Graph(self.inputs)
        nodes = [*range(self.inputs), *map(graph.constant, self.constants.tolist())]
        for code, arguments in zip(self.codes, self.arguments, strict=True):
            nodes.append(graph.apply(CODES[code], *(nodes[i] for i in arguments if i >= 0)))
        return graph, [nodes[i] for i in self.outputs]


class Graph:
    """Nodes: first so many inputs, then constants and operations as they come."""

    def __init__(self, inputs: int) -> None:
        self.inputs = inputs
        self._nodes: list[tuple[Any, ...]] = [("input", i) for i in range(inputs)]
        self._numbers: dict[tuple[Any, ...], Node] = {}
        self._slopes: dict[tuple[Node, Node], Node] = {}

    def _node(self, *key: Any) -> Node:
        found = self._numbers.get(key)
        if found is None:
            found = self._numbers[key] = len(self._nodes)
            self._nodes.append(key)
        return found

    def constant(self, value: float) -> Node:
        """Return the node of a number."""
        return self._node("constant", float(value))

    def value(self, node: Node) -> float | None:
        """Return the number that a node is; None if it is none."""
        kind, *rest = self._nodes[node]
        return float(rest[0]) if kind == "constant" else None

    def apply(self, name: str, *arguments: Node) -> Node:
        """Return the node of an operation, by its name in `CODES`."""
        if name in {"add", "mul"}:
            return (self.add if name == "add" else self.mul)(*arguments)
        values = [self.value(a) for a in arguments]
        if name == "div" and values[1] is not None:
            return self.mul(arguments[0], self.constant(1 / values[1]))
        if name == "div" and values[0] == 0:
            return self.constant(0)
        if name == "pow" and values[1] is not None:
            return self.power(arguments[0], values[1])
        if name == SELECT and arguments[2] == arguments[3]:
            return arguments[2]
        if all(value is not None for value in values):
            with np.errstate(all="ignore"):
                return self.constant(float(OPERATIONS[name][1](*values)))
        return self._node(name, *arguments)

    def formula(self, name: str, *arguments: Any) -> Scalar:
        """Return an operation of numbers and scalars as a scalar."""
        return Scalar(self, self.apply(name, *map(self.node, arguments)))

    def node(self, value: Any) -> Node:
        """Return the node of a number or of a scalar."""
        return value.node if isinstance(value, Scalar) else self.constant(value)

    def add(self, a: Node, b: Node) -> Node:
        """Return a + b."""
        x, y = self.value(a), self.value(b)
        if x is not None and y is not None:
            return self.constant(x + y)
        if x == 0:
            return b
        if y == 0:
            return a
        return self._node("add", min(a, b), max(a, b))

    def mul(self, a: Node, b: Node) -> Node:
        """Return a · b."""
        x, y = self.value(a), self.value(b)
        if x is not None and y is not None:
            return self.constant(x * y)
        if 0 in {x, y}:
            return self.constant(0)
        if x == 1:
            return b
        if y == 1:
            return a
        return self._node("mul", min(a, b), max(a, b))

    def power(self, a: Node, exponent: float) -> Node:
        """Return a to the power of a number."""
        if exponent == 0:
            return self.constant(1)
        if exponent == 0.5:
            return self.apply("sqrt", a)
        if exponent == int(exponent) and 1 <= exponent <= 8:
            half = self.power(a, exponent // 2)
            square = self.mul(half, half)
            return self.mul(square, a) if exponent % 2 else square
        if exponent == int(exponent) and -8 <= exponent < 0:
            return self._node("div", self.constant(1), self.power(a, -exponent))
        value = self.value(a)
        if value is not None:
            return self.constant(value**exponent)
        return self._node("pow", a, self.constant(exponent))

    def sum(self, nodes: Iterable[Node]) -> Node:
        """Return the sum of nodes."""
        return reduce(self.add, nodes, self.constant(0))

    def minus(self, a: Node, b: Node) -> Node:
        """Return a − b."""
        return self.add(a, self.mul(self.constant(-1), b))

    def tangent(self, outputs: Sequence[Node], along: Node) -> list[Node]:
        """Return the derivatives of nodes by an input."""
        for node in self._below(outputs):
            if (node, along) not in self._slopes:
                self._slopes[node, along] = self._slope(node, along)
        return [self._slopes[node, along] for node in outputs]

    def _below(self, outputs: Sequence[Node]) -> list[Node]:
        """Return the nodes that outputs depend on, in an order in which they can be evaluated."""
        needed, waiting = set(), list(outputs)
        while waiting:
            node = waiting.pop()
            if node not in needed:
                needed.add(node)
                waiting += self._arguments(node)
        return sorted(needed)

    def _arguments(self, node: Node) -> tuple[Node, ...]:
        kind, *rest = self._nodes[node]
        return () if kind in {"input", "constant"} else tuple(rest)

    def _slope(self, node: Node, along: Node) -> Node:
        name, *arguments = self._nodes[node]
        if name in {"constant", "input"}:
            return self.constant(1.0 if node == along else 0.0)
        slopes = [self._slopes[a, along] for a in arguments]
        if all(self.value(slope) == 0 for slope in slopes):
            return self.constant(0)
        if name == "add":
            return self.add(*slopes)
        if name == "mul":
            return self.add(self.mul(slopes[0], arguments[1]), self.mul(arguments[0], slopes[1]))
        if name == SELECT:
            return self.apply(SELECT, arguments[0], arguments[1], slopes[2], slopes[3])
        if name == "div":
            return self.apply("div", self.minus(slopes[0], self.mul(node, slopes[1])), arguments[1])
        if name == "atan2":
            (y, x), (dy, dx) = arguments, slopes
            above = self.minus(self.mul(x, dy), self.mul(y, dx))
            return self.apply("div", above, self.add(self.mul(x, x), self.mul(y, y)))
        if name == "pow":
            a, b = arguments
            exponent = self.value(b)
            if exponent is not None:
                return self.mul(self.mul(self.constant(exponent), self.power(a, exponent - 1)), slopes[0])
            grown = self.add(self.mul(slopes[1], self.apply("ln", a)), self.apply("div", self.mul(b, slopes[0]), a))
            return self.mul(node, grown)
        (a,), (da,) = arguments, slopes
        return self.mul(self._unary_slope(name, node, a), da)

    def _unary_slope(self, name: str, node: Node, a: Node) -> Node:
        one = self.constant(1)
        slopes: dict[str, Callable[[], Node]] = {
            "exp": lambda: node,
            "expm1": lambda: self.add(node, one),
            "ln": lambda: self.apply("div", one, a),
            "log1p": lambda: self.apply("div", one, self.add(one, a)),
            "sqrt": lambda: self.apply("div", self.constant(0.5), node),
            "sin": lambda: self.apply("cos", a),
            "cos": lambda: self.mul(self.constant(-1), self.apply("sin", a)),
            "sinh": lambda: self.apply("cosh", a),
            "cosh": lambda: self.apply("sinh", a),
            "tanh": lambda: self.minus(one, self.mul(node, node)),
            "atan": lambda: self.apply("div", one, self.add(one, self.mul(a, a))),
            "abs": lambda: self.apply(SELECT, a, self.constant(0), self.constant(-1), one),
        }
        return slopes[name]()

    def tape(self, outputs: Sequence[Node]) -> Tape:
        """Return the operations that outputs need."""
        needed = self._below(outputs)
        constants = [node for node in needed if self._nodes[node][0] == "constant"]
        operations = [node for node in needed if self._nodes[node][0] not in {"constant", "input"}]
        places = {node: i for i, node in enumerate([*range(self.inputs), *constants, *operations])}
        rows = np.full((len(operations), 4), -1, dtype=np.int64)
        for row, node in zip(rows, operations, strict=True):
            arguments = self._arguments(node)
            row[: len(arguments)] = [places[a] for a in arguments]
        return Tape(
            self.inputs,
            np.array([self._nodes[node][1] for node in constants], dtype=float),
            np.array([CODES.index(self._nodes[node][0]) for node in operations], dtype=np.int64),
            rows,
            np.array([places[node] for node in outputs], dtype=np.int64),
        )


class Scalar:
    """A node of a graph as a number in formulas."""

    def __init__(self, graph: Graph, node: Node) -> None:
        self.graph, self.node = graph, node

    def __add__(self, other: Any) -> Scalar:
        return self.graph.formula("add", self, other)

    def __mul__(self, other: Any) -> Scalar:
        return self.graph.formula("mul", self, other)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> Scalar:
        return self * -1

    def __sub__(self, other: Any) -> Scalar:
        return self.graph.formula("add", self, -other)

    def __rsub__(self, other: Any) -> Scalar:
        return self.graph.formula("add", other, -self)

    def __truediv__(self, other: Any) -> Scalar:
        return self.graph.formula("div", self, other)

    def __rtruediv__(self, other: Any) -> Scalar:
        return self.graph.formula("div", other, self)

    def __pow__(self, other: Any) -> Scalar:
        return self.graph.formula("pow", self, other)

    def __rpow__(self, other: Any) -> Scalar:
        return self.graph.formula("pow", other, self)


def to_arrays(tape: Tape) -> dict[str, NDArray[Any]]:
    """Return a tape as arrays for a file."""
    return {one.name: np.asarray(getattr(tape, one.name)) for one in fields(tape)}


def from_arrays(arrays: Mapping[str, NDArray[Any]]) -> Tape:
    """Return the tape of a file.

    Raises
    ------
    ValueError
        If its arrays are not those of a tape.
    """
    inputs = int(arrays["inputs"])
    constants, codes, rows, outputs = (arrays[name] for name in ("constants", "codes", "arguments", "outputs"))
    before = inputs + len(constants) + np.arange(len(codes))
    taken = np.array([count for count, _ in OPERATIONS.values()])
    good = rows.shape == (len(codes), 4) and bool(np.isin(codes, np.arange(len(CODES))).all())
    good = good and bool(((rows >= 0).sum(axis=1) == taken[codes]).all() and (rows < before[:, None]).all())
    last = inputs + len(constants) + len(codes)
    if not good or not ((outputs >= 0) & (outputs < last)).all():
        raise ValueError("the file holds operations that are none")
    return Tape(inputs, constants.astype(float), *(one.astype(np.int64) for one in (codes, rows, outputs)))
