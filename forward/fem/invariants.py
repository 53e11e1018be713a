"""Strain energies in forms of UFL: what they are functions of, the stress, and derivatives by the state.

Energies of principal stretches are long expressions of two invariants (`kinematics.Shape`). UFL would carry each of
their derivatives by the state through the whole of them, nine components wide; so in such an energy two symbols stand
for the invariants, its derivatives by these are numbers, and the chain rule is written here. `inserted` puts the
invariants in their place, in what is compiled. (A stiffness of Ogden's energy takes C compilers seconds rather than
minutes.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import ufl

from forward.fem.dolfinx import spaces, version
from forward.materials import kinematics
from forward.materials.energies import measures

OPS = SimpleNamespace(
    ln=ufl.ln,
    exp=ufl.exp,
    sqrt=ufl.sqrt,
    tanh=ufl.tanh,
    sin=ufl.sin,
    cos=ufl.cos,
    atan2=version.atan2,
    sinh=ufl.sinh,
    tr=ufl.tr,
    det=ufl.det,
    inv=ufl.inv,
    inner=ufl.inner,
    outer=ufl.outer,
    positive=lambda x: ufl.max_value(x, 0.0),
    near=lambda z, limit, inside, outside: ufl.conditional(ufl.lt(abs(z), limit), inside, outside),
)
OPS.log1p, OPS.expm1 = kinematics.log1p_of(OPS), kinematics.expm1_of(OPS)


class Invariants:
    """What a strain energy is a function of, on a mesh.

    Parameters
    ----------
    energy
        Kind of the material.
    mesh
        Mesh of the body.
    u
        Displacements, in UFL.
    displacement_of
        Displacements of a direction in which derivatives are taken.
    fibres
        Unit vectors along the families of fibres, in UFL.

    Attributes
    ----------
    F
        Deformation gradient.
    deformation
        Parts of the deformation.
    measures
        Arguments of the energy by their names, as variables of forms (or functions of such).
    """

    def __init__(
        self, energy: str, mesh: Any, u: Any, displacement_of: Callable[[Any], Any], fibres: Sequence[Any] = ()
    ) -> None:
        gradient, identity = ufl.grad(u), ufl.Identity(3)
        self.F = kinematics.deformation_gradient(gradient, identity)
        self.deformation = at = kinematics.deformation(OPS, gradient, identity)
        self._displacement_of = displacement_of
        self._fibres = fibres
        self._symbols: dict[str, Any] = {}
        names = measures(energy)
        if "l1" in names:
            self._shape = kinematics.shape(OPS, self.F, at, identity)
            self._symbols = {name: spaces.constant(mesh, 0.0) for name in self._shape.slopes}
            by_name = {name: ufl.variable(symbol) for name, symbol in self._symbols.items()}
            strains = kinematics.principal_strains(OPS, **by_name)
            logarithms = kinematics.isochoric([OPS.log1p(strain) / 2 for strain in strains])
            by_name["j"] = ufl.variable(at.dilation)
            self._variables = by_name
            self.measures = dict(zip(("l1", "l2", "l3"), logarithms, strict=True)) | {"j": by_name["j"]}
        else:
            found = {name: kinematics.measure(OPS, name, at, fibres) for name in names}
            self.measures = self._variables = {
                name: tuple(map(ufl.variable, value)) if isinstance(value, tuple) else ufl.variable(value)
                for name, value in found.items()
            }

    def stress(self, density: Any) -> Any:
        """P = ∂W/∂F (Pa) of a density of the measures."""
        slopes = {name: ufl.diff(density, found) for name, found in self._variables.items() if name != "i4"}
        of_fibres = [ufl.diff(density, longer) for longer in self._variables.get("i4", ())]
        fibres = list(zip(self._fibres, of_fibres, strict=True)) if of_fibres else []
        P = kinematics.nominal_stress(OPS, self.F, self.deformation, slopes, fibres)
        return sum((slopes[name] * self._shape.slopes[name] for name in self._symbols), P)

    def derivative(self, form: Any, state: Any, direction: Any) -> Any:
        """Gâteaux derivative of a form, or of an expression, by the state along a direction."""
        if not self._symbols:
            return ufl.derivative(form, state, direction)
        if not isinstance(form, ufl.Form):
            return self._derivative_of(form, state, direction)
        changed = [
            integral.reconstruct(self._derivative_of(integral.integrand(), state, direction))
            for integral in form.integrals()
        ]
        return ufl.Form(changed)

    def _derivative_of(self, integrand: Any, state: Any, direction: Any) -> Any:
        change = ufl.grad(self._displacement_of(direction))
        terms = [
            ufl.diff(integrand, self._variables[name]) * ufl.inner(self._shape.slopes[name], change)
            for name in self._symbols
        ]
        return sum(terms, ufl.derivative(integrand, state, direction))

    def inserted(self, form: Any) -> Any:
        """Return a form, or an expression, with the invariants in place of their symbols."""
        if not self._symbols:
            return form
        found = ufl.algorithms.expand_derivatives(form)
        return ufl.replace(found, {symbol: getattr(self._shape, name) for name, symbol in self._symbols.items()})
