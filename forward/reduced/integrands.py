"""UFL as a graph of scalars: the integrands of a body, exactly as finite elements integrate them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from numpy.typing import NDArray

from forward.fem.dolfinx import spaces
from forward.fem.equations import Discretisation
from forward.graph import SELECT, Graph, Node, Tape
from forward.model import FloatArray
from forward.reduced.data import Points
from forward.reduced.kernels import Kernel

# Returns the node of a component of what has a value of its own: a function, its gradient, a constant, a place.
Known = Callable[[Any, tuple[int, ...]], Node]
_NAMES = {"Ln": "ln", "Power": "pow", "Division": "div", "Abs": "abs", "Atan2": "atan2"}
_NAMES |= {name.capitalize(): name for name in ("sqrt", "exp", "sin", "cos", "sinh", "cosh", "tanh", "atan")}
_TENSORS = {"Identity", "Indexed", "ComponentTensor", "IndexSum", "ListTensor", "Variable", "Conj", "Real"}
_NUMBERS = {"IntValue", "FloatValue", "RealValue", "ScalarValue"}
GIVEN = 24  # inputs that what is given may take while it is not known how many there are
LOGS = 8


class Reader:
    """Reads expressions into a graph, in which the nodes of terminals and of gradients of functions are known."""

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
                a, b = (self._component(one, (), at) for one in own[0].ufl_operands)
                yes, no = (self._component(one, component, at) for one in own[1:])
                condition = type(own[0]).__name__
                if condition not in {"LT", "LE", "GT", "GE"}:
                    raise NotImplementedError(f"reduced models cannot read the condition {condition}")
                return graph.apply(SELECT, *((a, b) if condition in {"LT", "LE"} else (b, a)), yes, no)
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


def _place(index: Any, at: dict[int, int]) -> int:
    return int(index) if isinstance(index, ufl.core.multiindex.FixedIndex) else at[index.count()]


@dataclass(frozen=True, eq=False)
class Integrand:
    """What is integrated, or evaluated, over the cells or over a boundary.

    Attributes
    ----------
    tape
        Its operations at a point.
    boundary, degree
        Name of the boundary, None for the body; degree of quadrature.
    components
        Which components (m,) of the state it takes: those of the values and then those of the gradient.
    given
        What it takes besides, as UFL; normals are asked for as such.
    fields
        Numbers of the random fields that it takes.
    """

    tape: Tape
    boundary: str | None
    degree: int
    components: tuple[int, ...]
    given: tuple[tuple[Any, tuple[int, ...]], ...]
    fields: tuple[int, ...]


def of_form(equations: Discretisation, form: Any, numbers: tuple[str, ...]) -> list[Integrand]:
    """Read a virtual work: for each of its measures, what works on the components of the virtual displacement."""
    whole = equations.written_out(form)
    found: dict[tuple[str | None, int], list[Any]] = {}
    for integral in whole.integrals():
        found.setdefault(_measure(equations, integral), []).append(integral.integrand())
    return [
        _read(equations, sum(parts[1:], parts[0]), *measure, numbers, virtual=True) for measure, parts in found.items()
    ]


def of_density(equations: Discretisation, density: Any, measure: Any, numbers: tuple[str, ...]) -> Integrand:
    """Read a density over a measure."""
    (integral,) = equations.written_out(density * measure).integrals()
    return _read(equations, integral.integrand(), *_measure(equations, integral), numbers, virtual=False)


def _measure(equations: Discretisation, integral: Any) -> tuple[str | None, int]:
    degree = int(integral.metadata()["quadrature_degree"])
    if integral.integral_type() == "cell":
        return None, degree
    return equations.boundary_of(integral), degree


def _read(
    equations: Discretisation,
    integrand: Any,
    boundary: str | None,
    degree: int,
    numbers: tuple[str, ...],
    *,
    virtual: bool,
) -> Integrand:
    values = equations.size_of_value
    count = 4 * values  # components of values and gradients
    first = {"given": 2 * count, "logs": 2 * count + GIVEN, "numbers": 2 * count + GIVEN + LOGS}
    graph = Graph(first["numbers"] + len(numbers))
    given: list[tuple[Any, tuple[int, ...]]] = []
    fields: list[int] = []
    paths = {id(constant): path for path, constant in equations.constants.items()}
    logs = {id(field.function): i for i, field in enumerate(equations.fields)}

    def known(e: Any, component: tuple[int, ...]) -> Node:
        gradient = type(e).__name__ == "Grad"
        what = e.ufl_operands[0] if gradient else e
        kind = type(what).__name__
        own = values + 3 * component[0] + component[1] if gradient else (component or (0,))[0]
        if what is equations.unknown:
            return own
        if isinstance(what, ufl.Argument):
            return count + own
        if gradient:
            raise NotImplementedError(f"reduced models cannot read the gradient of {what}")
        if id(what) in paths and paths[id(what)] in numbers:
            return first["numbers"] + numbers.index(paths[id(what)])
        if id(what) in logs:
            number = logs[id(what)]
            if number not in fields:
                fields.append(number)
            return first["logs"] + fields.index(number)
        if isinstance(what, ufl.Constant):
            return graph.constant(float(np.asarray(what.value)[component]))
        if isinstance(what, ufl.Coefficient) or kind in {"SpatialCoordinate", "FacetNormal"}:
            if (what, component) not in given:
                given.append((what, component))
            return first["given"] + given.index((what, component))
        raise NotImplementedError(f"reduced models cannot read {kind}")

    node = Reader(graph, known)(integrand)
    if virtual:
        works = [graph.tangent([node], count + k)[0] for k in range(count)]
        tape = graph.tape(works)
        acting = {k for k, one in enumerate(works) if graph.value(one) != 0}
    else:
        tape, acting, works = graph.tape([node]), set[int](), [node]
    used = {int(i) for i in tape.arguments.ravel() if 0 <= i < count} | {int(i) for i in tape.outputs if i < count}
    components = tuple(sorted(used | acting))
    if virtual:
        tape = graph.tape([works[k] for k in components])
    kept = [*components, *(first["given"] + np.arange(len(given))), *(first["logs"] + np.arange(len(fields)))]
    kept += [*(first["numbers"] + np.arange(len(numbers)))]
    return Integrand(_with_inputs(tape, kept), boundary, degree, components, tuple(given), tuple(fields))


def _with_inputs(tape: Tape, kept: list[int]) -> Tape:
    """Return a tape that has some of its inputs only, in another order."""
    places = np.full(tape.inputs + len(tape.constants) + len(tape.codes), -1, dtype=np.int64)
    places[kept] = np.arange(len(kept))
    places[tape.inputs :] = len(kept) + np.arange(len(places) - tape.inputs)
    arguments = np.where(tape.arguments >= 0, places[tape.arguments], -1)
    return Tape(len(kept), tape.constants, tape.codes, arguments, places[tape.outputs])


class Sampler:
    """Values of functions of a body at the points of an integrand, of a part of them if that is enough."""

    def __init__(self, equations: Discretisation, integrand: Integrand) -> None:
        self._equations, self.integrand = equations, integrand
        shape = ufl.grad(equations.unknown)
        values = equations.size_of_value
        parts = [
            _component(equations.unknown, (k,)) if k < values else shape[(k - values) // 3, (k - values) % 3]
            for k in integrand.components
        ]
        self._state = self._at(ufl.as_vector(parts)) if parts else None
        self.weights, self._normals = self._areas()
        self.count = len(self.weights)

    def _at(self, expression: Any) -> Callable[[], FloatArray]:
        """Compile a vector: a function that returns its values (n, k) at all points."""
        equations, size = self._equations, int(np.prod(expression.ufl_shape))
        if self.integrand.boundary is not None:
            return equations.on_facets(expression, self.integrand.boundary, self.integrand.degree)
        points, _ = spaces.quadrature(equations.space, self.integrand.degree)
        values = equations.at(expression, points)
        return lambda: values().reshape(-1, size)

    def _areas(self) -> tuple[FloatArray, FloatArray]:
        """Weights (n,) of the points and, on a boundary, unit normals (n, 3)."""
        equations = self._equations
        jacobian = ufl.Jacobian(equations.mesh)
        at = self._at(ufl.as_vector([jacobian[i, j] for i in range(3) for j in range(3)]))
        J = at().reshape(-1, 3, 3)
        if self.integrand.boundary is None:
            _, weights = spaces.quadrature(equations.space, self.integrand.degree)
            return np.abs(np.linalg.det(J)) * np.tile(weights, len(J) // len(weights)), np.zeros((len(J), 3))
        outward = np.einsum("nji,nj->ni", np.linalg.inv(J), at.outward)  # type: ignore[attr-defined]
        areas = np.linalg.norm(outward, axis=1)
        return np.abs(np.linalg.det(J)) * areas, outward / areas[:, None]

    def kernel(self, numbers: int) -> Kernel:
        """Compile the integrand, which takes so many numbers."""
        return Kernel(self.integrand.tape, self.integrand.tape.inputs - numbers)

    def components(self, state: FloatArray) -> FloatArray:
        """Return the components (m, n) that the integrand takes of a state (U_local,)."""
        if self._state is None:
            return np.zeros((0, self.count))
        self._equations.set_state(state)
        return np.ascontiguousarray(self._state().T)

    def inputs(self, components: FloatArray, points: Points, parameters: FloatArray) -> FloatArray:
        """Return what the integrand takes at points (varying, n): components (m, n), and what is known there."""
        fields = self._equations.fields
        logs = [log + slopes @ parameters[fields[i].positions] for i, log, slopes in points.logs]
        return np.ascontiguousarray(np.vstack([components, points.given, *logs]))

    def points(self, rows: FloatArray, chosen: NDArray[np.int64] | None = None) -> Points:
        """Return the points with the values of fields (N, U_local) there."""
        chosen = np.arange(self.count) if chosen is None else chosen
        m = len(self.integrand.components)
        fields = np.empty((m, len(chosen), len(rows)))
        for k, row in enumerate(rows):
            fields[:, :, k] = self.components(row)[:, chosen]
        return Points(self.weights[chosen], fields, self._given()[:, chosen], self._logs(chosen))

    def _given(self) -> FloatArray:
        rows = []
        for what, component in self.integrand.given:
            if type(what).__name__ == "FacetNormal":
                rows.append(self._normals[:, component[0]])
            else:
                rows.append(self._at(ufl.as_vector([_component(what, component)]))()[:, 0])
        return np.array(rows).reshape(len(rows), self.count)

    def _logs(self, chosen: NDArray[np.int64]) -> tuple[tuple[int, FloatArray, FloatArray], ...]:
        equations, found = self._equations, []
        for number in self.integrand.fields:
            field = equations.fields[number]
            at = self._at(ufl.as_vector([field.function]))
            coefficients = np.zeros(len(equations.parameters))
            field.set(coefficients)
            base = at()[chosen, 0]
            slopes = np.empty((len(chosen), len(field.positions)))
            for k, position in enumerate(field.positions):
                coefficients[:] = 0
                coefficients[position] = 1.0
                field.set(coefficients)
                slopes[:, k] = at()[chosen, 0] - base
            equations.linearisation_point.forget_parameters()
            found.append((number, base, slopes))
        return tuple(found)


def _component(what: Any, component: tuple[int, ...]) -> Any:
    return what[component] if what.ufl_shape else what
