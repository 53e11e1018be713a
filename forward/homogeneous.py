"""Material-point tests: the stress of a homogeneously deformed specimen, from the energies of the finite elements.

A test prescribes one stretch (or shear) x, and perhaps another one z across; free faces leave the lateral stretch y.
With the energy W(x, z, y) of the specimen per volume, the nominal stresses that do work on x and on z are

    P1 = (1/k) dW(x, z, y(x, z))/dx,   P2 = dW(x, z, y(x, z))/dz,

with k = 2 where two equal stretches are prescribed. An incompressible specimen has y from J = 1; a compressible one has
∂W/∂y = 0, and then dW/dx = ∂W/∂x. Cauchy stresses are P1 x/J and P2 z/J. Fibres lie such that no shear is needed for
that. SymPy reads the energy and differentiates it, so that stresses and their derivatives with respect to the constants
are closed forms (of y, which Newton's method finds where it is not known): G. A. Holzapfel, Nonlinear Solid Mechanics
(2000), chapter 6; R. W. Ogden, Non-Linear Elastic Deformations (1984).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from types import SimpleNamespace
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from annotated_types import Gt
from pydantic import Field, model_validator

from forward.admissible import objection
from forward.materials import MATERIALS, constants, measured, measures
from forward.model import FloatArray, FunctionModel, FunctionSolution, InadmissibleError, Reference, SolveError
from forward.settings import Settings

Mode = Literal["uniaxial", "equibiaxial", "biaxial", "pure-shear", "simple-shear"]
Component = Literal["P1", "P2", "P1-P2"]
HELD: tuple[Mode, ...] = ("biaxial", "pure-shear")  # modes in which something acts across
Positive = Annotated[float, Gt(0)]
ITERATIONS = 60  # of Newton's method for the lateral stretch
ROUNDED = 1e-13  # relative change of the lateral stretch that ends it


class MaterialTest(Settings):
    """One homogeneous test of a material: what is prescribed, and which stress is read.

    Parameters
    ----------
    mode
        "uniaxial" (tension or compression), "equibiaxial", "biaxial" (two stretches), "pure-shear" (planar tension: one
        width is held) or "simple-shear".
    at
        Stretches λ > 0, or amounts of shear γ.
    across
        Second stretch at each of them (biaxial only).
    stress
        "nominal" (force over undeformed area) or "cauchy".
    component
        Which stress is read: "P1", along `at`; in "biaxial" and "pure-shear" also "P2", across, and their difference
        "P1-P2", which of Cauchy stresses does not depend on the pressure.
    name
        Name of the test in the names of the outputs; by default its mode, with the component where that is not P1.
    """

    mode: Mode
    at: tuple[float, ...] = Field(min_length=1)
    across: tuple[Positive, ...] | None = None
    stress: Literal["nominal", "cauchy"] = "nominal"
    component: Component = "P1"
    name: str = ""

    @property
    def label(self) -> str:
        """The name in outputs."""
        return self.name or named(self.mode, self.component)

    @model_validator(mode="after")
    def _check(self) -> MaterialTest:
        if self.mode != "simple-shear" and min(self.at) <= 0:
            message = f"at: stretch {min(self.at):g}, expected positive ones (1 is undeformed)"
            raise ValueError(message)
        if (self.across is not None) != (self.mode == "biaxial"):
            message = "across: is for mode = 'biaxial', and only for it"
            raise ValueError(message)
        if self.component != "P1" and self.mode not in HELD:
            message = f"component: {self.component} of a test '{self.mode}', expected P1: nothing acts across"
            raise ValueError(message)
        if self.across is not None and len(self.across) != len(self.at):
            message = f"across: {len(self.across)} stretches, expected as many as in at: {len(self.at)}"
            raise ValueError(message)
        return self


def named(test: str, component: Component) -> str:
    """Return the name of a test with that of the stress that is read, where it is not the first one."""
    return test if component == "P1" else f"{test} {component}"


class HomogeneousModel:
    """A forward model: stresses (Pa) of material tests as outputs, the constants of a material as parameters.

    Parameters
    ----------
    energy
        Kind of the material, see `forward.materials`.
    values
        Its constants; without the constant D1, an energy that has one is that of an incompressible material.
    tests
        What is measured.
    parameters
        Names of the constants that vary; the others keep their values.
    fibres
        Directions of one or two families of fibres, where the material has them: components along the stretch x, along
        what is prescribed across (in simple shear, x moves along the first, more so along the second), and along y.

    Raises
    ------
    ValueError
        If constants are missing or unknown, or a test would shear the specimen.
    """

    differentiable = True
    displacements = 0

    def __init__(
        self,
        energy: str,
        values: dict[str, float],
        tests: Sequence[MaterialTest],
        parameters: Sequence[str],
        fibres: Sequence[tuple[float, float, float]] = (),
    ) -> None:
        units = tuple(tuple((np.array(fibre) / np.linalg.norm(fibre)).tolist()) for fibre in fibres)
        objection = next(filter(None, (unfit(energy, test.mode, fibres) for test in tests)), None)
        if objection is not None:
            raise ValueError(objection)
        known = constants(MATERIALS[energy])
        given = dict.fromkeys([*values, *parameters])
        unknown, missing = set(given) - set(known), set(known) - set(given) - {"D1"}
        if unknown or missing:
            message = f"constants of '{energy}': {', '.join(sorted(given))}, expected: {', '.join(known)}"
            raise ValueError(message)
        self.parameters = tuple(parameters)
        self._names = tuple(name for name in known if name in given)
        self._energy = energy
        self._free = "D1" not in known or "D1" in given  # faces move as they like, and where to has to be found
        self._values = np.array([values.get(name, np.nan) for name in self._names])
        self._varied = [self._names.index(name) for name in parameters]
        self._tests = tuple(tests)
        self._readings = [
            reading(energy, test.mode, self._names, units, test.component, test.stress == "cauchy") for test in tests
        ]
        many = {test.label for test in tests if len(test.at) > 1}
        self.outputs = tuple(
            f"{test.label}[{i}]" if test.label in many else test.label for test in tests for i in range(len(test.at))
        )

    def stresses(self, points: FloatArray) -> FloatArray:
        """Return the stresses (n, m) at parameters (n, d), NaN where there is none (a Gent chain at its end)."""
        return np.concatenate([values for values, _ in self._evaluate(points, derivatives=False)], axis=1)

    def stresses_and_derivatives(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the stresses (n, m) and their derivatives (n, m, d) at parameters (n, d)."""
        values, slopes = zip(*self._evaluate(points, derivatives=True), strict=True)
        return np.concatenate(values, axis=1), np.concatenate(slopes, axis=1)

    def _evaluate(self, points: FloatArray, *, derivatives: bool) -> list[tuple[FloatArray, FloatArray]]:
        points = np.asarray(points, dtype=float)
        theta = np.tile(self._values[:, None, None], (1, len(points), 1))
        theta[self._varied] = points.T[:, :, None]
        found = []
        for test, read in zip(self._tests, self._readings, strict=True):
            x, across = np.array(test.at), np.array(test.across if test.across is not None else 1.0)
            stress, slopes = read(x, across, theta, derivatives)
            found.append((stress, np.moveaxis(slopes[self._varied], 0, 2) if derivatives else slopes))
        return found

    def solve(
        self,
        parameters: FloatArray,
        start: FloatArray | None = None,
        reference: Reference | None = None,
        iterations: int | None = None,
    ) -> FunctionSolution:
        """Return the stresses (m,) at `parameters` (d,).

        Raises
        ------
        InadmissibleError
            Where the constants are of no material, or an incompressible one has no energy in a test.
        SolveError
            Where a test of a compressible one has no stress.
        """
        return FunctionModel(self._one, self.parameters, self.outputs, self._jacobian).solve(parameters)

    def _one(self, parameters: FloatArray) -> FloatArray:
        here = dict(zip(self._names, self._values, strict=True))
        said = objection(self._energy, here | dict(zip(self.parameters, map(float, parameters), strict=True)))
        if said is not None:
            raise InadmissibleError(said)
        values = np.asarray(self.stresses(parameters[None, :])[0])
        if np.isfinite(values).all():
            return values
        name = self.outputs[int(np.flatnonzero(~np.isfinite(values))[0])]
        if self._free:
            message = f"no stress in the test {name}: the material has no energy, or no equilibrium, there"
            raise SolveError(message)
        message = f"no stress in the test {name}: the material has no energy there"
        raise InadmissibleError(message)

    def _jacobian(self, parameters: FloatArray) -> FloatArray:
        return np.asarray(self.stresses_and_derivatives(parameters[None, :])[1][0])

    def gather(self, rows: FloatArray) -> FloatArray:
        """Return the (empty) rows as they are."""
        return rows

    def scatter(self, rows: FloatArray) -> FloatArray:
        """Return the (empty) rows as they are."""
        return rows


# --- closed forms --------------------------------------------------------------------------------------------------


class _Kinematics(NamedTuple):
    """Stretches of a mode with x prescribed, z prescribed across and y free; y where the volume does not change."""

    stretches: Callable[[Any, Any, Any, Any], tuple[Any, Any, Any]]  # of sympy, x, z, y
    incompressible: Callable[[Any, Any], Any] | None  # of x, z; nothing is free where there is none
    share: int = 1  # prescribed stretches that are x
    alike: tuple[tuple[int, int], ...] = ()  # directions in which the specimen is stretched alike, and so must be made


_MODES: dict[str, _Kinematics] = {
    "uniaxial": _Kinematics(lambda ops, x, z, y: (x, y, y), lambda x, z: x ** (-0.5), alike=((1, 2),)),
    "equibiaxial": _Kinematics(lambda ops, x, z, y: (x, x, y), lambda x, z: x ** (-2.0), share=2, alike=((0, 1),)),
    "biaxial": _Kinematics(lambda ops, x, z, y: (x, z, y), lambda x, z: 1 / (x * z)),
    "pure-shear": _Kinematics(lambda ops, x, z, y: (x, z, y), lambda x, z: 1 / (x * z)),  # z = 1
    # λ₁ − 1/λ₁ = γ; the volume does not change, and no face is free.
    "simple-shear": _Kinematics(
        lambda ops, x, z, y: (ops.sqrt(1 + x**2 / 4) + x / 2, ops.sqrt(1 + x**2 / 4) - x / 2, 1), None
    ),
}

Reading = Callable[[FloatArray, FloatArray, FloatArray, bool], tuple[FloatArray, FloatArray]]


def unfit(energy: str, mode: Mode, fibres: Sequence[tuple[float, float, float]]) -> str | None:
    """Say why fibres do not fit a material and a mode, or nothing if they do.

    Where a face is free, the material must be alike on both sides of each plane of the mode (reflections leave the
    families of fibres as they are, up to their sign), and in the directions that are stretched alike.
    """
    if ("I4" in measures(energy)) != bool(fibres):
        return f"material '{energy}': {'expected fibres' if not fibres else 'has no fibres'}"
    if mode == "simple-shear" or not fibres:
        return None
    families = np.array(fibres)
    families = families / np.linalg.norm(families, axis=1)[:, None]
    changes = [np.eye(3) - 2 * np.diag(axis) for axis in np.eye(3)]
    for i, j in _MODES[mode].alike:
        swap = np.eye(3)
        swap[[i, j]] = swap[[j, i]]
        changes.append(swap)
    if all(np.isclose(np.abs(families @ change @ families.T).max(axis=0), 1).all() for change in changes):
        return None
    return f"fibres that a test '{mode}' would shear, or stretch unlike: expected them along axes, or a mirrored pair"


@cache
def reading(
    energy: str,
    mode: Mode,
    names: tuple[str, ...],
    fibres: tuple[tuple[float, float, float], ...] = (),
    component: Component = "P1",
    cauchy: bool = False,
) -> Reading:
    """Return (x (k,), z (k,), θ (c, n, 1), derivatives) → stresses (n, k) and dσ/dθ (c, n, k) of a mode.

    Parameters
    ----------
    energy
        Kind of the material.
    names
        The c constants θ; without D1 an energy that has it is read at J = 1.
    fibres
        Unit vectors along the families of fibres.
    component, cauchy
        Which stress, as of `MaterialTest`.
    """
    import sympy

    kinematics = _MODES[mode]
    x = sympy.Symbol("x", real=True, positive=None if mode == "simple-shear" else True)
    z, y = sympy.symbols("z y", positive=True)
    theta = dict(zip(names, sympy.symbols(names, real=True), strict=True))
    confined = kinematics.incompressible is None
    incompressible = "D1" in constants(MATERIALS[energy]) and "D1" not in names
    values = theta if not incompressible else theta | {"D1": sympy.Integer(0)}
    a, b, c = stretches = kinematics.stretches(sympy, x, z, y)
    J = sympy.Integer(1) if incompressible or confined else a * b * c
    squared = tuple(
        (f + x * g) ** 2 + g**2 + h**2 if confined else (a * f) ** 2 + (b * g) ** 2 + (c * h) ** 2 for f, g, h in fibres
    )
    W = MATERIALS[energy](_operators(), *measured(energy, stretches, J, squared).values(), **values)
    if incompressible and kinematics.incompressible is not None:
        W = W.subs(y, _exact(kinematics.incompressible(x, z)))
    along, across = W.diff(x) / kinematics.share, W.diff(z)
    if cauchy and not confined:
        along, across = along * x / J, across * z / J
    P = {"P1": along, "P2": across, "P1-P2": along - across}[component]
    if mode == "pure-shear":
        W, P = W.subs(z, 1), P.subs(z, 1)

    def compiled(expressions: Sequence[Any]) -> Callable[..., Sequence[Any]]:
        symbols = [x, z, y, *theta.values()]
        function: Callable[..., Sequence[Any]] = sympy.lambdify(symbols, list(expressions), modules="numpy", cse=True)
        return function

    free = not incompressible and not confined
    # Beyond where an energy ends, its derivatives may be numbers.
    defined, value, slope = compiled([W]), compiled([P]), compiled([P, *(P.diff(s) for s in theta.values())])
    if free:
        g = W.diff(y)
        balance = compiled([g, g.diff(y)])
        others = compiled([P.diff(y), g.diff(y), *(g.diff(s) for s in theta.values())])

    def read(
        at: FloatArray, across: FloatArray, constants_: FloatArray, derivatives: bool
    ) -> tuple[FloatArray, FloatArray]:
        shape = np.broadcast_shapes(at.shape, constants_.shape[1:])
        lateral = np.ones(shape)
        with np.errstate(all="ignore"):
            if not confined:
                assert kinematics.incompressible is not None
                lateral = np.broadcast_to(kinematics.incompressible(at, across), shape)
            if free:
                lateral = _lateral(lambda y: balance(at, across, y, *constants_), lateral)
            arguments = (at, across, lateral, *constants_)
            results = np.array([np.broadcast_to(r, shape) for r in (slope if derivatives else value)(*arguments)])
            results = np.where(np.isfinite(defined(*arguments)[0]), results, np.nan)
            stress, by_constant = results[0], results[1:]
            if free and derivatives:
                P_y, g_y, *g_theta = others(*arguments)
                by_constant = by_constant - np.array([np.broadcast_to(P_y / g_y * g_t, shape) for g_t in g_theta])
        return stress, by_constant

    return read


def _operators() -> SimpleNamespace:
    import sympy

    def positive(x: Any) -> Any:
        return sympy.Piecewise((x, x > 0), (0, True))

    return SimpleNamespace(ln=sympy.log, exp=sympy.exp, sqrt=sympy.sqrt, positive=positive)


def _exact(expression: Any) -> Any:
    """Powers with exponents such as −1/2 as exact numbers, so that SymPy can combine them."""
    import sympy

    return sympy.nsimplify(expression)


def _lateral(balance: Callable[[FloatArray], Sequence[Any]], start: FloatArray) -> FloatArray:
    """Solve ∂W/∂y = 0 by Newton's method in ln y, in steps of at most a factor of two; NaN where it does not settle."""
    y = np.array(start)
    for _ in range(ITERATIONS):
        g, g_y = balance(y)
        # At the minimum of W(ln y) the slope of y g is y² g_y + y g; away from it |·| keeps the direction downhill.
        curvature = np.abs(y * y * g_y + y * g)
        step = np.clip(-y * g / curvature, -np.log(2), np.log(2))
        y = y * np.exp(step)
        if np.nanmax(np.abs(step), initial=0.0) < ROUNDED:
            break
    return np.where(np.abs(step) < 1e-8, y, np.nan)
