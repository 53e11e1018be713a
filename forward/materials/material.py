"""What an energy is, what it consists of, and the list of energies.

An energy is a plain function, of this program (`forward.materials.energies`, which says how it is written) or from a
module beside a study or an installed package (``kind = "my_tissue.fung"``):

    def fung(ops, i1, j, *, c: Annotated[float, Gt(0), Unit("Pa")], b: Annotated[float, Gt(0)], D1: Number):
        "Isotropic Fung: W = c/(2b) (exp(b(Ī1−3)) − 1) + D1(J−1)²."
        return c / (2 * b) * ops.expm1(b * i1) + D1 * j**2
"""

from __future__ import annotations

import cmath
import inspect
from collections.abc import Callable, Mapping
from functools import cache
from types import SimpleNamespace
from typing import Any, get_type_hints

from forward.materials.kinematics import dilation_of, expm1_of, log1p_of, of_stretches
from forward.registry import Kinds

Energy = Callable[..., Any]
KNOWN = ("i1", "i2", "j", "l1", "l2", "l3", "i4", "trace", "square")  # measures of a deformation
QUADRATIC = "D1"  # the constant of a volumetric part D1(J−1)²
TINY = 1e-30  # step of a derivative by complex numbers
REST = 1e-6  # of the moduli: energy and stress of the undeformed body that count as zero


class Split:
    """An energy that is the sum of an isochoric and a volumetric part; made by `with_volume`."""

    def __init__(self, shape: Energy, volume: Energy) -> None:
        self.shape, self.volume = shape, volume
        self.__doc__ = shape.__doc__

    def __call__(self, ops: Any, *measures: Any, **values: Any) -> Any:
        """Return the sum; the last measure is J − 1."""
        *of_shape, j = measures
        parts = ((self.shape, of_shape), (self.volume, (j,)))
        both = [part(ops, *at, **{name: values[name] for name in constants(part)}) for part, at in parts]
        return both[0] + both[1]


def with_volume(volume: Energy) -> Callable[[Energy], Energy]:
    """State the volumetric part U(J) of an energy, which can then have a mixed form: a decorator.

    Parameters
    ----------
    volume
        U as a function of `ops` and j = J − 1, with its own constants, which become constants of the energy too: ``def
        log_volume(ops, j, *, kappa: Number): return kappa / 2 * ops.log1p(j) ** 2``. It is convex near J = 1, where it
        and its slope vanish, and positive elsewhere. The decorated function is the isochoric part, a function of i1,
        i2, l1, l2, l3 and the fibres.

    Raises
    ------
    TypeError
        If one of the two depends on something else.
    """
    if measures(volume) != ("j",):
        raise TypeError(f"the volumetric part is a function of {', '.join(measures(volume))}, expected j alone")

    def decorated(shape: Energy) -> Energy:
        if {"j", "trace", "square"} & {*measures(shape)} or constants(shape).keys() & constants(volume).keys():
            raise TypeError("the isochoric part has a measure of the volume, or a constant of the volumetric part")
        return Split(shape, volume)

    return decorated


def _parts(energy: Energy) -> tuple[Energy, Energy | None]:
    """The isochoric part of an energy and the volumetric one; one that is not stated in parts, and None."""
    return (energy.shape, energy.volume) if isinstance(energy, Split) else (energy, None)


def measures(energy: str | Energy) -> tuple[str, ...]:
    """Return the names of the measures on which an energy, or that of a kind of material, depends, in order."""
    return _measures(energy_of(energy))


@cache
def _measures(energy: Energy) -> tuple[str, ...]:
    shape, volume = _parts(energy)
    _, *names = (name for name, p in inspect.signature(shape).parameters.items() if p.kind is not p.KEYWORD_ONLY)
    return tuple(names) if volume is None else (*names, "j")


def measured(
    energy: str | Energy, ops: Any, less_one: tuple[Any, Any, Any], dilation: Any, fibres: tuple[Any, ...] = ()
) -> dict[str, Any]:
    """Return the measures of an energy from principal stretches less one, J − 1, and the I4 − 1 of fibres."""
    known = of_stretches(ops, less_one, dilation, fibres)
    return {name: known[name] for name in measures(energy)}


def constants(energy: str | Energy) -> dict[str, Any]:
    """Return the names of the constants of an energy, each with its annotation (admissible values and unit)."""
    return {**_constants(energy_of(energy))}


@cache
def _constants(energy: Energy) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for part in filter(None, _parts(energy)):
        hints = get_type_hints(part, include_extras=True)
        parameters = inspect.signature(part).parameters.items()
        found |= {name: hints.get(name, Any) for name, p in parameters if p.kind is p.KEYWORD_ONLY}
    return found


def _quadratic(ops: Any, j: Any, *, D1: Any) -> Any:
    return D1 * j**2


def volumetric(energy: str | Energy) -> Energy | None:
    """Return the volumetric part of an energy, or None if it has none."""
    _, volume = _parts(energy_of(energy))
    return _quadratic if volume is None and QUADRATIC in constants(energy) else volume


def isochoric(energy: str | Energy) -> Energy:
    """Return an energy without its volumetric part, as a function of all its measures and constants."""
    shape, volume = _parts(energy_of(energy))
    if volume is None:
        return lambda ops, *measures, **values: shape(ops, *measures, **(values | {QUADRATIC: 0}))
    return lambda ops, *measures, **values: shape(ops, *measures[:-1], **{c: values[c] for c in constants(shape)})


def splits(energy: str | Energy) -> bool:
    """Whether an energy, or that of a kind of material, splits into an isochoric and a volumetric part."""
    return volumetric(energy) is not None


def of_volume(energy: str | Energy) -> tuple[str, ...]:
    """Return the constants of the volumetric part of an energy; without them the material is incompressible."""
    volume = volumetric(energy)
    return () if volume is None else tuple(constants(volume))


def incompressible(energy: str | Energy, names: Any) -> bool:
    """Whether a material with these constants is incompressible: the volumetric ones are missing."""
    return splits(energy) and not {*of_volume(energy)} & {*names}


def small_strain_moduli(energy: str | Energy, values: Mapping[str, Any]) -> tuple[Any, Any]:
    """Shear and bulk modulus of the undeformed body without fibres, which carry only tension.

    Pure shear with stretches exp(h), exp(−h), 1 has W = 2μh² + …, so that μ = W''(h)/4 at h = 0. A dilation with all
    stretches λ has W = κ(3(λ−1))²/2 + …, so that κ = W''(λ)/9 at λ = 1. First derivatives are complex steps, which are
    exact to rounding; the second one adds a central difference of order 4.

    Parameters
    ----------
    energy
        An energy, or a kind of material.
    values
        Its constants, numbers or arrays (n,); without those of the volume, κ is infinite.

    Returns
    -------
    tuple
        μ and κ in Pa, to ten digits.
    """
    energy = energy_of(energy)
    rigid = incompressible(energy, values)
    W = isochoric(energy) if rigid else energy
    ops = _complex(values)
    shear = _curvature(lambda h: _slope(W, energy, values, (ops.expm1(h), ops.expm1(-h), 0.0)))
    return shear / 4, float("inf") if rigid else _curvature(lambda h: _slope(W, energy, values, (h, h, h))) / 9


def unfit_at_rest(energy: str | Energy, values: Mapping[str, float]) -> str | None:
    """Say what is wrong with an energy of these constants in the undeformed body, or None if nothing is."""
    energy = energy_of(energy)
    W = isochoric(energy) if incompressible(energy, values) else energy
    try:
        known = measured(energy, _NUMBERS, (0.0, 0.0, 0.0), 0.0)
        at_rest = complex(W(_NUMBERS, *known.values(), **values)).real
        pressure = float(_slope(W, energy, values, (complex(0.0, TINY),) * 3)) / 3
        size = max(abs(modulus) for modulus in small_strain_moduli(energy, values) if modulus != float("inf"))
    except Exception as error:
        return f"the energy cannot be evaluated: {error}; it must use the operators that it is given"
    if not abs(at_rest) <= REST * size:
        return f"the energy of the undeformed body is {at_rest:.3g} J/m³, expected 0: its measures vanish there"
    if not abs(pressure) <= REST * size:
        return f"the undeformed body has a pressure of {-pressure:.3g} Pa, expected 0"
    return None


def _slope(W: Energy, energy: Energy, values: Mapping[str, Any], less_one: tuple[Any, Any, Any]) -> Any:
    """Derivative of an energy along a path of principal stretches less one, of which the complex part is `TINY`."""
    ops = _complex(values)
    known = measured(energy, ops, less_one, dilation_of(less_one))
    found = W(ops, *known.values(), **values) / TINY
    return found.imag


def _curvature(slope: Callable[[complex], Any], h: float = 1e-3) -> Any:
    def at(x: float) -> Any:
        return slope(complex(x, TINY))

    return (8 * (at(h) - at(-h)) - at(2 * h) + at(-2 * h)) / (12 * h)


_NUMBERS = SimpleNamespace(
    ln=cmath.log,
    exp=cmath.exp,
    sinh=cmath.sinh,
    sqrt=cmath.sqrt,
    positive=lambda x: x if complex(x).real > 0 else 0.0,
    near=lambda z, limit, inside, outside: inside if abs(z) < limit else outside,
)
_NUMBERS.log1p, _NUMBERS.expm1 = log1p_of(_NUMBERS), expm1_of(_NUMBERS)


def _complex(values: Mapping[str, Any]) -> SimpleNamespace:
    """Operators of complex numbers, or of arrays where some of the constants are."""
    return _NUMBERS if all(isinstance(value, int | float) for value in values.values()) else _arrays()


@cache
def _arrays() -> SimpleNamespace:
    import numpy as np

    ops = SimpleNamespace(
        ln=np.log,
        exp=np.exp,
        sinh=np.sinh,
        sqrt=lambda x: np.sqrt(np.asarray(x, dtype=complex)),
        positive=lambda x: np.where(np.real(x) > 0, x, 0.0),
        near=lambda z, limit, inside, outside: np.where(np.abs(z) < limit, inside, outside),
    )
    ops.log1p, ops.expm1 = log1p_of(ops), expm1_of(ops)
    return ops


# --- kinds -----------------------------------------------------------------------------------------------------------


def _objection(found: Any) -> str | None:
    """Say why something is not an energy, or None if it is one."""
    shape, volume = _parts(found)
    if volume is not None:
        return _objection(shape) or _objection(volume)
    if not inspect.isfunction(found):
        return "expected a function"
    try:
        given, names = measures(found), constants(found)
    except (NameError, TypeError, ValueError) as error:
        return f"its signature cannot be read: {error}"
    kinds = {p.kind for p in inspect.signature(found).parameters.values()}
    if inspect.Parameter.VAR_KEYWORD in kinds or not names:
        return "expected its constants as keyword-only arguments: (ops, i1, j, *, c, D1)"
    strange = [name for name in given if name not in KNOWN]
    if strange or not given:
        return f"'{', '.join(strange)}' is no measure of a deformation, expected some of: {', '.join(KNOWN)}"
    if len({"l1", "l2", "l3"} & {*given}) > 0 and (given[:3] != ("l1", "l2", "l3") or given[3:] not in {(), ("j",)}):
        return "expected the measures (l1, l2, l3) or (l1, l2, l3, j), in this order, where there is one of l1, l2, l3"
    return _of_quadratic(found) if QUADRATIC in names else None


def _of_quadratic(energy: Energy) -> str | None:
    """Say so if the part with D1 is not D1(J−1)²; otherwise None."""
    at: dict[str, Any] = dict.fromkeys(KNOWN, 0.1) | {"l2": 0.05, "l3": -0.15, "i4": (0.1,)}
    given = [at[name] for name in measures(energy)]
    try:
        ends = [energy(_NUMBERS, *given, **(dict.fromkeys(constants(energy), 1.0) | {"D1": D1})) for D1 in (0.0, 1.0)]
    except Exception as error:
        return f"it cannot be evaluated: {error}; it must use the operators that it is given"
    expected = at["j"] ** 2 if "j" in measures(energy) else None
    if expected is None or not abs(ends[1] - ends[0] - expected) <= 1e-9:
        return "D1 is the constant of a part D1(J−1)²: give another name to that of another"
    return None


MATERIALS = Kinds(
    "material",
    {
        kind: f"forward.materials.energies:{kind.replace('-', '_')}"
        for kind in (
            "mooney-rivlin",
            "neo-hookean",
            "neo-hookean-coupled",
            "yeoh",
            "gent",
            "demiray",
            "saint-venant-kirchhoff",
            "blatz-ko",
            "ogden",
            "holzapfel-gasser-ogden",
        )
    },
    objection=_objection,
)


def energy_of(energy: str | Energy) -> Energy:
    """Return the energy of a kind of material, or the energy itself."""
    found: Energy = MATERIALS[energy] if isinstance(energy, str) else energy
    return found
