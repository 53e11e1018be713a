"""Graphs of scalars: derivatives, arrays and back, compiled and by NumPy."""

import numpy as np
import pytest
import sympy

from forward.graph import OPERATIONS, SELECT, Graph, from_arrays, to_arrays
from forward.reduced import kernels
from forward.reduced.kernels import Kernel, spread

UNARY = [name for name, (count, _) in OPERATIONS.items() if count == 1]


def expression(graph, ops):
    """A function of three inputs that uses every operation, as a graph and by SymPy."""
    x, y, z = 0, 1, 2
    total = graph.constant(0)
    for name in UNARY:
        total = graph.add(total, graph.apply(name, graph.mul(x, y)))
    total = graph.add(total, graph.apply("div", graph.power(y, 3), graph.power(z, -0.7)))
    total = graph.add(total, graph.apply("atan2", x, graph.add(y, z)))
    total = graph.add(total, graph.apply("pow", y, z))
    a, b, c = sympy.symbols("a b c", positive=True)
    other = {
        "ln": sympy.log,
        "abs": sympy.Abs,
        "log1p": lambda x: sympy.log(1 + x),
        "expm1": lambda x: sympy.exp(x) - 1,
    }
    of = sum((other[name] if name in other else getattr(sympy, name))(a * b) for name in UNARY)
    of += b**3 / c ** sympy.Float(-0.7) + sympy.atan2(a, b + c) + b**c
    return total, of, (a, b, c)


def test_first_and_second_derivatives_are_those_of_sympy():
    graph = Graph(3)
    total, of, symbols = expression(graph, None)
    first = [graph.tangent([total], i)[0] for i in range(3)]
    second = [one for i in range(3) for one in graph.tangent(first, i)]
    tape = graph.tape([total, *first, *second])
    at = (0.7, 1.3, 0.9)
    found = np.array(tape(at), dtype=float)
    wanted = [of, *(of.diff(s) for s in symbols), *(of.diff(s, t) for s in symbols for t in symbols)]
    expected = [float(one.evalf(30, subs=dict(zip(symbols, at, strict=True)))) for one in wanted]
    np.testing.assert_allclose(found, expected, rtol=1e-13)


@pytest.mark.unit
def test_a_choice_has_the_derivative_of_what_is_chosen():
    graph = Graph(2)
    larger = graph.apply(SELECT, 0, 1, graph.mul(1, 1), graph.mul(0, graph.constant(3)))
    tape = graph.tape([larger, *graph.tangent([larger], 0), *graph.tangent([larger], 1)])
    np.testing.assert_allclose(
        np.array(tape((np.array([1.0, 4.0]), np.array([2.0, 2.0]))[:2]), dtype=float).T[0], [4, 0, 4]
    )
    np.testing.assert_allclose([one[1] for one in tape((np.array([1.0, 4.0]), np.array([2.0, 2.0])))], [12, 3, 0])


@pytest.mark.unit
@pytest.mark.flags
def test_compiled_and_numpy_agree_also_for_what_is_the_same_at_all_points(monkeypatch):
    graph = Graph(3)
    total, _, _ = expression(graph, None)
    tape = graph.tape([total, graph.tangent([total], 0)[0], 2, graph.constant(4)])
    points, numbers = np.random.default_rng(0).uniform(0.2, 2, (2, 9)), np.array([0.6])
    compiled = Kernel(tape, 2)
    if compiled._function is None:
        pytest.skip("there is no C compiler")
    monkeypatch.setattr(kernels, "_compiled", lambda *_: None)
    by_numpy = Kernel(tape, 2)
    np.testing.assert_allclose(compiled(points, numbers), by_numpy(points, numbers), rtol=1e-14)
    monkeypatch.undo()
    single = Kernel(tape, 2, np.float32)(points, numbers)
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, compiled(points, numbers), rtol=2e-6)


@pytest.mark.unit
def test_spread_is_a_product_at_every_point(monkeypatch):
    H, B = np.random.default_rng(1).standard_normal((3, 4, 5)), np.random.default_rng(2).standard_normal((4, 5, 6))
    np.testing.assert_allclose(spread(H, B), np.einsum("ijq,jqk->iqk", H, B), rtol=1e-13)
    monkeypatch.setattr(kernels, "_spread", lambda: None)
    np.testing.assert_allclose(spread(H, B), np.einsum("ijq,jqk->iqk", H, B), rtol=1e-13)


@pytest.mark.unit
def test_arrays_and_back():
    graph = Graph(3)
    total, _, _ = expression(graph, None)
    tape = graph.tape([total])
    again = from_arrays(to_arrays(tape))
    assert again((0.3, 0.4, 0.5)) == tape((0.3, 0.4, 0.5))
    other, outputs = again.graph()
    assert other.tape(outputs)((0.3, 0.4, 0.5)) == pytest.approx(tape((0.3, 0.4, 0.5)), rel=1e-15)


@pytest.mark.unit
@pytest.mark.parametrize(("name", "value"), [("outputs", 10_000), ("codes", 999), ("arguments", 10_000)])
def test_arrays_that_are_no_tape_are_refused(name, value):
    graph = Graph(3)
    total, _, _ = expression(graph, None)
    arrays = to_arrays(graph.tape([total]))
    arrays[name] = arrays[name].copy()
    arrays[name].flat[-4 if name == "arguments" else -1] = value
    with pytest.raises(ValueError, match="operations that are none"):
        from_arrays(arrays)
