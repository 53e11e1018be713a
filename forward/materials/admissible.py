"""Which constants are admissible: those with which the material is stable at rest.

The undeformed body resists every small strain if its shear modulus μ and its bulk modulus κ are positive (G. A.
Holzapfel, Nonlinear Solid Mechanics (2000), section 6.1). That is asked of the constants together, not of each: C2 of a
Mooney–Rivlin material may be negative as long as C1 + C2 is not, and so may be a term of an Ogden material, or C20 of a
Yeoh material. Besides, constants have ranges outside which the energy makes no sense (`forward.materials.energies`: the
chains of a Gent material have a positive length). Stability at large strains is found by the solve.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any, NamedTuple, get_args

import numpy as np
from annotated_types import Ge, Gt
from numpy.typing import NDArray

from forward.materials.material import Energy, constants, energy_of, incompressible, small_strain_moduli, unfit_at_rest
from forward.model import FloatArray, InadmissibleError

Values = Mapping[str, Any]  # of constants by name: numbers, or arrays (n,)


class _AtRest(NamedTuple):
    """A modulus of the undeformed body, in words and as a function of the constants."""

    words: str
    of: Callable[[Values], Any]


_SHEAR: dict[str, _AtRest] = {
    "mooney-rivlin": _AtRest("2 (C1 + C2)", lambda v: 2 * (v["C1"] + v["C2"])),
    "neo-hookean": _AtRest("2 C1", lambda v: 2 * v["C1"]),
    "neo-hookean-coupled": _AtRest("mu", lambda v: v["mu"]),
    "yeoh": _AtRest("2 C10", lambda v: 2 * v["C10"]),
    "gent": _AtRest("mu", lambda v: v["mu"]),
    "demiray": _AtRest("a", lambda v: v["a"]),
    "saint-venant-kirchhoff": _AtRest("mu", lambda v: v["mu"]),
    "blatz-ko": _AtRest("mu", lambda v: v["mu"]),
    "ogden": _AtRest(
        "(mu1 alpha1 + mu2 alpha2 + mu3 alpha3)/2",
        lambda v: (v["mu1"] * v["alpha1"] + v["mu2"] * v["alpha2"] + v["mu3"] * v["alpha3"]) / 2,
    ),
    "holzapfel-gasser-ogden": _AtRest("c", lambda v: v["c"]),
}
_LAME = _AtRest("lmbda + 2/3 mu", lambda v: v["lmbda"] + 2 / 3 * v["mu"])
_BULK: dict[str, _AtRest] = {
    "neo-hookean-coupled": _LAME,
    "saint-venant-kirchhoff": _LAME,
    "blatz-ko": _AtRest("5/3 mu", lambda v: 5 / 3 * v["mu"]),
}
_VOLUME = _AtRest("2 D1", lambda v: 2 * v["D1"])  # of the program's own that split


def moduli(energy: str, values: Values) -> tuple[Any, Any]:
    """Return the shear and the bulk modulus (Pa) at rest of a kind of material.

    κ is infinite if the volumetric constants are left out. For energies from outside the program the moduli are found
    by numerical derivatives.
    """
    if energy not in _SHEAR:
        return small_strain_moduli(energy, values)
    bulk = _BULK.get(energy, _VOLUME)
    return _SHEAR[energy].of(values), np.inf if incompressible(energy, values) else bulk.of(values)


def objection(energy: str, values: Mapping[str, float]) -> str | None:
    """Say why these constants are inadmissible; None if they are admissible."""
    for limit in _limits(energy_of(energy)):
        if limit.name in values and not limit.holds(values[limit.name]):
            return f"{limit.name} = {values[limit.name]:.6g}, expected {limit.words}"
    own = energy in _SHEAR
    unfit = None if own else unfit_at_rest(energy, values)
    if unfit is not None:
        return unfit
    formulas = (f" = {_SHEAR[energy].words}", f" = {_BULK.get(energy, _VOLUME).words}") if own else ("", "")
    for symbol, modulus, formula in zip("μκ", moduli(energy, values), formulas, strict=True):
        if not modulus > 0:
            return f"not stable at rest: {symbol}{formula} = {modulus:.6g} Pa, expected more than 0"
    return None


def admissible(energy: str, values: Values) -> NDArray[np.bool_]:
    """Return which constants, numbers or arrays (n,), are admissible (n,)."""
    shear, bulk = moduli(energy, values)
    good = (np.asarray(shear) > 0) & (np.asarray(bulk) > 0)
    for limit in _limits(energy_of(energy)):
        if limit.name in values:
            good = good & limit.holds(values[limit.name])
    return np.asarray(good)


class _Limit(NamedTuple):
    """The range in which an energy is defined for a constant."""

    name: str
    least: float
    reached: bool  # whether the constant may be that

    def holds(self, value: Any) -> Any:
        return np.asarray(value) >= self.least if self.reached else np.asarray(value) > self.least

    @property
    def words(self) -> str:
        return f"{'at least' if self.reached else 'more than'} {self.least:g}"


@cache
def _limits(energy: Energy) -> tuple[_Limit, ...]:
    found = []
    for name, hint in constants(energy).items():
        for limit in get_args(hint):
            match limit:
                case Gt(gt=least):
                    found.append(_Limit(name, float(str(least)), reached=False))
                case Ge(ge=least):
                    found.append(_Limit(name, float(str(least)), reached=True))
                case _:  # a unit
                    pass
    return tuple(found)


@dataclass(frozen=True)
class Materials:
    """The materials of a model as functions of its parameters.

    Parameters
    ----------
    energy
        Kind of all of them.
    constants
        For each place of a material in the model: values of its constants, or names of the corresponding parameters.
    """

    energy: str
    constants: Mapping[str, Mapping[str, float | str]]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters that are material constants."""
        return tuple(dict.fromkeys(name for of in self.varied.values() for name in of.values()))

    @cached_property
    def varied(self) -> dict[str, dict[str, str]]:
        """For each place the constants that are parameters, with the names of these."""
        return {
            place: {constant: name for constant, name in own.items() if isinstance(name, str)}
            for place, own in self.constants.items()
        }

    def objection(self, values: Mapping[str, float]) -> str | None:
        """Say where and why parameters are inadmissible; None if they are admissible."""
        return next((f"{place}: {said}" for place, said in self.objections(values)), None)

    def objections(self, values: Mapping[str, float]) -> Iterator[tuple[str, str]]:
        """Say for each place with inadmissible parameters why they are."""
        for place, own in self._at(values):
            said = objection(self.energy, own)
            if said is not None:
                yield place, said

    def admissible(self, values: Mapping[str, FloatArray]) -> NDArray[np.bool_]:
        """Return which parameters, arrays (n,) by name, are admissible (n,)."""
        found = [admissible(self.energy, own) for _, own in self._at(values)]
        return np.asarray(np.all(np.broadcast_arrays(*found), axis=0))  # a place may have no parameters

    def _at(self, values: Values) -> Iterator[tuple[str, dict[str, Any]]]:
        for place, own in self.constants.items():
            yield place, {**own, **{constant: values[name] for constant, name in self.varied[place].items()}}


class Admission:
    """Which parameters a body has a model for; paths that are no numbers of it are coefficients of random fields."""

    def __init__(self, spec: Any, parameters: tuple[str, ...]) -> None:
        self._scalars, self._materials, self._parameters = spec.scalars, spec.materials(parameters), parameters

    def require(self, values: FloatArray) -> None:
        """Refuse parameters (d,) for which there is no model.

        Raises
        ------
        InadmissibleError
            With the number and the reason.
        """
        given = dict(zip(self._parameters, np.asarray(values, dtype=float).tolist(), strict=True))
        for path, value in given.items():
            scalar = self._scalars.get(path)
            if scalar is not None:
                objection = scalar.objection(value)
            else:
                objection = None if math.isfinite(value) else "input should be a finite number"
            if objection is not None:
                raise InadmissibleError(f"{path} = {value:.6g} is not admissible: {objection}")
        objection = self._materials.objection(given)
        if objection is not None:
            raise InadmissibleError(objection)
