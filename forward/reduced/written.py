"""UFL as a graph of scalars: the integrands of a body, exactly as finite elements integrate them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import ufl

from forward.reduced.graph import SELECT, Graph, Node

# Returns the node of a component of what has a value of its own: a function, its gradient, a constant, a place.
Known = Callable[[Any, tuple[int, ...]], Node]

_NAMES = {"Ln": "ln", "Power": "pow", "Division": "div", "Abs": "abs", "Atan2": "atan2"}
_NAMES |= {name.capitalize(): name for name in ("sqrt", "exp", "sin", "cos", "sinh", "cosh", "tanh", "atan")}

_TENSORS = {"Identity", "Indexed", "ComponentTensor", "IndexSum", "ListTensor", "Variable", "Conj", "Real"}
_NUMBERS = {"IntValue", "FloatValue", "RealValue", "ScalarValue"}


class Reader:
    """Reads expressions into a graph.

    Parameters
    ----------
    graph
        Where they go.
    known
        The nodes of terminals and of gradients of functions.
    """

    def __init__(self, graph: Graph, known: Known) -> None:
        self._graph, self._known = graph, known
        self._read: dict[tuple[int, tuple[int, ...], tuple[int, ...]], Node] = {}
        self._kept: list[Any] = []  # so that no other expression gets the same id

    def __call__(self, expression: Any, component: tuple[int, ...] = ()) -> Node:
        """Return the node of a component of an expression whose derivatives are expanded.

        Raises
        ------
        NotImplementedError
            For what cannot be read.
        """
        self._kept.append(expression)
        return self._component(expression, component, {})

    def _component(self, e: Any, component: tuple[int, ...], at: dict[int, int]) -> Node:
        key = id(e), component, tuple(at[i] for i in e.ufl_free_indices)
        if key not in self._read:
            self._read[key] = self._new(e, component, at)
        return self._read[key]

    def _new(self, e: Any, component: tuple[int, ...], at: dict[int, int]) -> Node:
        graph, kind, own = self._graph, type(e).__name__, e.ufl_operands
        if kind in _TENSORS:
            return self._of_tensor(e, component, at)
        if kind in _NUMBERS:
            return graph.constant(float(e))
        if kind in _NAMES:
            return graph.apply(_NAMES[kind], *(self._component(one, (), at) for one in own))
        if not own or kind == "Grad":
            return graph.constant(0) if kind == "Zero" else self._known(e, component)
        match kind:
            case "Sum":
                return graph.sum(self._component(one, component, at) for one in own)
            case "Product":
                return graph.mul(*(self._component(one, (), at) for one in own))
            case "Conditional":
                return self._choice(own, component, at)
            case "MaxValue" | "MinValue":
                a, b = (self._component(one, (), at) for one in own)
                return graph.apply(SELECT, a, b, *((b, a) if kind == "MaxValue" else (a, b)))
            case _:
                message = f"reduced models cannot read the operation {kind} of a load, a material or an output"
                raise NotImplementedError(message)

    def _of_tensor(self, e: Any, component: tuple[int, ...], at: dict[int, int]) -> Node:
        own = e.ufl_operands
        match type(e).__name__:
            case "Identity":
                return self._graph.constant(float(component[0] == component[1]))
            case "Indexed":
                return self._component(own[0], tuple(_place(i, at) for i in own[1].indices()), at)
            case "ComponentTensor":
                bound = {i.count(): c for i, c in zip(own[1].indices(), component, strict=True)}
                return self._component(own[0], (), at | bound)
            case "IndexSum":
                (index,) = own[1].indices()
                each = ({index.count(): i} for i in range(e.dimension()))
                return self._graph.sum(self._component(own[0], component, at | i) for i in each)
            case "ListTensor":
                return self._component(own[component[0]], component[1:], at)
            case _:  # that of a variable, or of a real number that is written as complex
                return self._component(own[0], component, at)

    def _choice(self, operands: tuple[Any, ...], component: tuple[int, ...], at: dict[int, int]) -> Node:
        condition, true, false = operands
        a, b = (self._component(one, (), at) for one in condition.ufl_operands)
        yes, no = (self._component(one, component, at) for one in (true, false))
        kind = type(condition).__name__
        if kind in {"LT", "LE"}:
            return self._graph.apply(SELECT, a, b, yes, no)
        if kind in {"GT", "GE"}:
            return self._graph.apply(SELECT, b, a, yes, no)
        message = f"reduced models cannot read the condition {kind}"
        raise NotImplementedError(message)


def _place(index: Any, at: dict[int, int]) -> int:
    return int(index) if isinstance(index, ufl.core.multiindex.FixedIndex) else at[index.count()]
