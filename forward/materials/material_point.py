"""Material-point tests: the stress of a homogeneously deformed specimen, from the energies of the finite elements.

A test prescribes one stretch (or shear) x, and perhaps another one z across; free faces leave the lateral stretch y.
With the energy W(x, z, y) of the specimen per volume, the nominal stresses that do work on x and on z are

    P1 = (1/k) dW(x, z, y(x, z))/dx,   P2 = dW(x, z, y(x, z))/dz,

with k = 2 where two equal stretches are prescribed. An incompressible specimen has y from J = 1; a compressible one has
∂W/∂y = 0, and then dW/dx = ∂W/∂x. Cauchy stresses are P1 x/J and P2 z/J. Fibres lie such that no shear is needed for
that. A `forward.graph` of the energy is differentiated, so that stresses and their derivatives with respect to the
constants are closed forms (of y, which Newton's method finds where it is not known): G. A. Holzapfel, Nonlinear Solid
Mechanics (2000), chapter 6; R. W. Ogden, Non-Linear Elastic Deformations (1984).

All test modes are one system of equations with different unknowns, hence one file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import islice, repeat
from types import SimpleNamespace
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from annotated_types import Gt
from pydantic import Field, model_validator

from forward.graph import SELECT, Graph, Scalar, Tape
from forward.materials.admissible import objection
from forward.materials.kinematics import dilation_of
from forward.materials.material import (
    Energy,
    constants,
    energy_of,
    incompressible,
    isochoric,
    measured,
    measures,
)
from forward.model import FloatArray, Guess, InadmissibleError, Solution, SolveError, Work
from forward.pointwise import ExplicitSolution
from forward.settings import Settings

Mode = Literal["uniaxial", "equibiaxial", "biaxial", "pure-shear", "simple-shear"]
Component = Literal["P1", "P2", "P1-P2"]
HELD: tuple[Mode, ...] = ("biaxial", "pure-shear")  # modes with a load across
Fibre = tuple[float, float, float]
Positive = Annotated[float, Gt(0)]
ITERATIONS = 60  # of Newton's method for the lateral stretch
ROUNDED = 1e-13  # relative change of the lateral stretch that ends it


class MaterialTest(Settings):
    """One homogeneous test of a material: what is prescribed, and which stress is measured.

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
        Which stress is measured: "P1", along `at`; in "biaxial" and "pure-shear" also "P2", across, and their
        difference "P1-P2", which for Cauchy stresses does not depend on the pressure.
    name
        Name of the test in output names; by default its mode, with the component unless that is P1.
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
            raise ValueError(f"at: stretch {min(self.at):g}, expected positive ones (1 is undeformed)")
        if (self.across is not None) != (self.mode == "biaxial"):
            raise ValueError("across: is only for mode = 'biaxial'")
        if self.component != "P1" and self.mode not in HELD:
            raise ValueError(f"component: {self.component} of a test '{self.mode}', expected P1: nothing acts across")
        if self.across is not None and len(self.across) != len(self.at):
            raise ValueError(f"across: {len(self.across)} stretches, expected as many as in at: {len(self.at)}")
        return self


def named(test: str, component: Component) -> str:
    """Return the name of a test, with that of the measured stress unless it is the first one."""
    return test if component == "P1" else f"{test} {component}"


def stresses_of(tests: Sequence[MaterialTest]) -> tuple[str, ...]:
    """Return the names of the stresses of tests, numbered where a test has several."""
    many = {test.label for test in tests if len(test.at) > 1}
    return tuple(
        f"{test.label}.{i}" if test.label in many else test.label for test in tests for i in range(1, len(test.at) + 1)
    )


class HomogeneousModel:
    """A forward model: stresses (Pa) of material tests as outputs, the constants of a material as parameters.

    Parameters
    ----------
    energy
        Kind of the material, see `forward.materials.energies`.
    values
        Its constants; without the volumetric ones (D1), the material is incompressible.
    tests
        What is measured.
    parameters
        Names of the constants that vary, or their paths in a model; the others keep their values.
    fibres
        Directions of one or two families of fibres, if the material has them: components along the stretch x, along the
        direction across (in simple shear, x moves along the first, more so along the second), and along y.

    What of these does not fit together is refused by `forward.material_tests.MaterialTests`.
    """

    differentiable = True
    space = None
    together = 64  # points at once: calls of array functions take longer than a few points in them

    def __init__(
        self,
        energy: str,
        values: dict[str, float],
        tests: Sequence[MaterialTest],
        parameters: Sequence[str],
        fibres: Sequence[Fibre] = (),
    ) -> None:
        units = tuple(tuple((np.array(fibre) / np.linalg.norm(fibre)).tolist()) for fibre in fibres)
        varied = [path.rpartition(".")[2] for path in parameters]
        given = {*values, *varied}
        self.parameters = tuple(parameters)
        self._names = tuple(name for name in constants(energy) if name in given)
        self._energy = energy
        self._free = not incompressible(energy, given)  # free faces, whose displacement has to be found
        self._values = np.array([values.get(name, np.nan) for name in self._names])
        self._varied = [self._names.index(name) for name in varied]
        self._tests = tuple(tests)
        self._readings = [
            reading(energy, test.mode, self._names, units, test.component, test.stress == "cauchy") for test in tests
        ]
        self.outputs = stresses_of(tests)

    def stresses(self, points: FloatArray) -> FloatArray:
        """Return the stresses (n, m) at parameters (n, d), NaN where undefined (fully extended Gent chains)."""
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

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> Solution:
        """Return the stresses (m,) at `parameters` (d,).

        Raises
        ------
        InadmissibleError
            If the constants are inadmissible, or the energy of an incompressible material is undefined in a test.
        SolveError
            If there is no stress in a test of a compressible material.
        """
        (found,) = self.solve_many(parameters[None], [guess])
        if isinstance(found, SolveError):
            raise found
        return found

    def solve_many(
        self, points: FloatArray, guesses: Iterable[Guess | None] | None = None
    ) -> Iterator[Solution | SolveError]:
        """Yield the stresses at each of points (n, d), or why there are none; derivatives too where a guess asks."""
        known = iter(guesses or repeat(None))
        for some in (points[i : i + self.together] for i in range(0, len(points), self.together)):
            asked = list(islice(known, len(some)))
            if any(guess is not None and guess.derivatives for guess in asked):
                stresses, slopes = self.stresses_and_derivatives(some)
            else:
                stresses, slopes = self.stresses(some), None
            for i, point in enumerate(some):
                refused = self._refused(point, stresses[i])
                yield refused or _Stresses(self, point, stresses[i], None if slopes is None else slopes[i])

    def _refused(self, parameters: FloatArray, stresses: FloatArray) -> SolveError | None:
        """Return why there is no answer where constants (d,) have stresses (m,), some of which may be undefined."""
        here = self._values.copy()
        here[self._varied] = parameters
        said = objection(self._energy, dict(zip(self._names, here.tolist(), strict=True)))
        if said is not None:
            return InadmissibleError(said)
        if np.isfinite(stresses).all():
            return None
        name = self.outputs[int(np.flatnonzero(~np.isfinite(stresses))[0])]
        if self._free:
            return SolveError(f"no stress in the test {name}: the material has no energy, or no equilibrium, there")
        return InadmissibleError(f"no stress in the test {name}: the material has no energy there")


@dataclass(frozen=True, eq=False)
class _Stresses(ExplicitSolution):
    """Stresses (m,) at parameters (d,), with their derivatives (m, d) if these were asked for with them."""

    model: HomogeneousModel
    parameters: FloatArray
    outputs: FloatArray
    slopes: FloatArray | None
    work: Work = field(default_factory=Work)

    @property
    def jacobian(self) -> FloatArray:
        """Derivatives (m, d) of the outputs."""
        if self.slopes is not None:
            return self.slopes
        return np.asarray(self.model.stresses_and_derivatives(self.parameters[None, :])[1][0])


# --- closed forms --------------------------------------------------------------------------------------------------


class _Kinematics(NamedTuple):
    """Stretches of a mode with x prescribed, z prescribed across and y free; y where the volume does not change.

    All stretches stand less one, so that small ones keep their digits; in simple shear, x is the amount of shear.
    """

    stretches: Callable[[Any, Any, Any, Any], tuple[Any, Any, Any]]  # of ops, x, z, y
    incompressible: Callable[[Any, Any, Any], Any] | None  # of ops, x, z; nothing is free where there is none
    share: int = 1  # prescribed stretches that are x
    alike: tuple[tuple[int, int], ...] = ()  # directions in which the specimen is stretched alike, and so must be made


_MODES: dict[str, _Kinematics] = {
    "uniaxial": _Kinematics(
        lambda ops, x, z, y: (x, y, y),
        lambda ops, x, z: -x / (ops.sqrt(1 + x) * (1 + ops.sqrt(1 + x))),
        alike=((1, 2),),
    ),
    "equibiaxial": _Kinematics(
        lambda ops, x, z, y: (x, x, y), lambda ops, x, z: -x * (2 + x) / (1 + x) ** 2, share=2, alike=((0, 1),)
    ),
    "biaxial": _Kinematics(lambda ops, x, z, y: (x, z, y), lambda ops, x, z: -(x + z + x * z) / ((1 + x) * (1 + z))),
    "pure-shear": _Kinematics(lambda ops, x, z, y: (x, z, y), lambda ops, x, z: -(x + z + x * z) / ((1 + x) * (1 + z))),
    # λ₁ − 1/λ₁ = γ; the volume does not change, and no face is free.
    "simple-shear": _Kinematics(lambda ops, x, z, y: (_sheared(ops, x) + x / 2, _sheared(ops, x) - x / 2, 0), None),
}


def _sheared(ops: Any, gamma: Any) -> Any:
    """√(1 + γ²/4) − 1."""
    return gamma**2 / 4 / (1 + ops.sqrt(1 + gamma**2 / 4))


Reading = Callable[[FloatArray, FloatArray, FloatArray, bool], tuple[FloatArray, FloatArray]]


def unfit(energy: str, mode: Mode, fibres: Sequence[Fibre]) -> str | None:
    """Say why fibres do not fit a material and a mode, or None if they do.

    If a face is free, the material must be symmetric about each plane of the mode (reflections leave the families of
    fibres unchanged, up to sign), and the same in directions that are stretched equally.
    """
    if ("i4" in measures(energy)) != bool(fibres):
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
    return f"fibres that a '{mode}' test would shear or stretch unequally: expected them along axes, or a mirrored pair"


@cache
def reading(
    energy: str,
    mode: Mode,
    names: tuple[str, ...],
    fibres: tuple[Fibre, ...] = (),
    component: Component = "P1",
    cauchy: bool = False,
) -> Reading:
    """Return (x (k,), z (k,), θ (c, n, 1), derivatives) → stresses (n, k) and dσ/dθ (c, n, k) of a mode.

    Parameters
    ----------
    energy
        Kind of the material.
    names
        The c constants θ; without those of the volumetric part, an energy that has one is evaluated at J = 1.
    fibres
        Unit vectors along the families of fibres.
    component, cauchy
        Which stress, as in `MaterialTest`.
    """
    kinematics = _MODES[mode]
    confined = kinematics.incompressible is None
    kept = incompressible(energy, names)  # the volume
    free = not kept and not confined
    forms = _forms(energy_of(energy), mode, names, fibres)
    share = {"P1": (1, 0), "P2": (0, 1), "P1-P2": (1, -1)}[component]

    def shares(x: FloatArray, z: FloatArray, y: FloatArray) -> tuple[Any, Any, Any]:
        """Factors on the nominal stresses along x and z, and the relative slope of both along y."""
        along, across = share[0] / kinematics.share, share[1]
        if not cauchy or confined:
            return along, across, 0.0
        J = 1.0 if kept else 1 + dilation_of(kinematics.stretches(np, x, z, y))
        both = 2 if mode == "uniaxial" else 1  # number of free directions
        return along * (1 + x) / J, across * (1 + z) / J, 0.0 if kept else -both / (1 + y)

    def read(
        at: FloatArray, across: FloatArray, constants_: FloatArray, derivatives: bool
    ) -> tuple[FloatArray, FloatArray]:
        shape = np.broadcast_shapes(at.shape, constants_.shape[1:])
        x, z = (at, across - 1) if confined else (at - 1, across - 1)
        y = np.zeros(shape)
        with np.errstate(all="ignore"):
            if kinematics.incompressible is not None:
                y = np.broadcast_to(kinematics.incompressible(np, x, z), shape)
            if free:
                y = _lateral(lambda y: forms.balance([x, z, y, *constants_]), y)
            here = [x, z, y, *constants_]
            W, by_x, by_z, *rest = (forms.whole if derivatives else forms.first)(here)
            a, b, slope = shares(x, z, y)
            stress = a * by_x + b * by_z
            # Beyond the limit of an energy, its derivatives may still be finite.
            stress = np.where(np.isfinite(np.broadcast_to(W, shape)), stress, np.nan)
            if not derivatives:
                return stress, np.zeros((0, *shape))
            mixed = np.array([np.broadcast_to(one, shape) for one in rest])
            (*of_x, by_xy), (*of_z, by_zy), (*of_y, by_yy) = np.split(mixed, 3)
            found = [a * one + b * other for one, other in zip(of_x, of_z, strict=True)]
            if free:
                by_lateral = a * by_xy + b * by_zy + slope * stress
                found = [one - by_lateral * side / by_yy for one, side in zip(found, of_y, strict=True)]
            by_constant = np.array(found).reshape(len(names), *shape)
        return stress, np.where(np.isfinite(stress), by_constant, np.nan)

    return read


class _Forms(NamedTuple):
    """The energy W of a mode as functions of its stretches less one and the constants, (x, z, y, *θ)."""

    first: Tape  # W, ∂W/∂x and ∂W/∂z
    balance: Tape  # ∂W/∂y and ∂²W/∂y²
    whole: Tape  # the first, then the derivatives of ∂W/∂x by all θ and y, then of ∂W/∂z and of ∂W/∂y


@cache
def _forms(energy: Energy, mode: Mode, names: tuple[str, ...], fibres: tuple[Fibre, ...]) -> _Forms:
    graph, kinematics = Graph(3 + len(names)), _MODES[mode]
    ops = SimpleNamespace(
        **{name: partial(graph.formula, name) for name in ("ln", "log1p", "exp", "expm1", "sinh", "sqrt")},
        positive=lambda x: graph.formula(SELECT, 0, x, x, 0),
        near=lambda z, limit, inside, outside: graph.formula(SELECT, z**2, limit**2, inside, outside),
    )
    x, z, y, *theta = (Scalar(graph, i) for i in range(graph.inputs))
    kept, confined = incompressible(energy, names), kinematics.incompressible is None
    across = kinematics.incompressible(ops, x, z) if kept and kinematics.incompressible is not None else y
    e, f, g = stretches = kinematics.stretches(ops, x, z, across)
    longer = tuple(
        2 * x * a * b + x**2 * b**2 if confined else e * (2 + e) * a**2 + f * (2 + f) * b**2 + g * (2 + g) * c**2
        for a, b, c in fibres
    )
    at = measured(energy, ops, stretches, 0.0 if kept or confined else dilation_of(stretches), longer)
    values = dict(zip(names, theta, strict=True))
    W = graph.node((isochoric(energy) if kept else energy)(ops, *at.values(), **values))
    slopes = [graph.tangent([W], way)[0] for way in range(3)]
    along = [graph.tangent(slopes, way) for way in (*range(3, graph.inputs), 2)]
    mixed = [row[way] for way in range(3) for row in along]
    first = [W, *slopes[:2]]
    return _Forms(graph.tape(first), graph.tape([slopes[2], mixed[-1]]), graph.tape([*first, *mixed]))


def _lateral(balance: Callable[[FloatArray], Sequence[Any]], start: FloatArray) -> FloatArray:
    """Solve ∂W/∂y = 0 by Newton's method in ln(1 + y), in steps of at most a factor of two; NaN if that fails."""
    y = np.array(start)
    step, moving = np.zeros(y.shape), np.ones(y.shape, dtype=bool)
    for _ in range(ITERATIONS):
        g, g_y = balance(y)
        # At the minimum of W the slope of (1+y) g is (1+y)² g_y + (1+y) g; away from it |·| keeps the step downhill.
        curvature = np.abs((1 + y) ** 2 * g_y + (1 + y) * g)
        step = np.where(moving, np.clip(-(1 + y) * g / curvature, -np.log(2), np.log(2)), step)
        y = np.where(moving, y + (1 + y) * np.expm1(step), y)  # each ends for itself, whichever are beside it
        moving &= np.abs(step) >= ROUNDED
        if not moving.any():
            break
    return np.where(np.abs(step) < 1e-8, y, np.nan)
