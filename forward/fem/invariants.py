"""Strain energies in UFL forms: their arguments, the stress, and derivatives by the state.

Energies of principal stretches are long expressions of two invariants (`kinematics.Shape`). UFL would propagate each
derivative by the state through these expressions, in nine components. So the invariants in such an energy are replaced
by two symbols: its derivatives by these are scalars, and the chain rule is applied here. `inserted` puts the invariants
back before compilation. (The stiffness of Ogden's energy then compiles in seconds rather than minutes.)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import ufl

from forward.fem.dolfinx import spaces, version
from forward.materials import kinematics
from forward.materials.material import Energy, constants, measures, volumetric

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
    choose=lambda z, positive, negative: ufl.conditional(ufl.gt(z, 0.0), positive, negative),
    near=lambda z, limit, inside, outside: ufl.conditional(ufl.lt(abs(z), limit), inside, outside),
)
OPS.log1p, OPS.expm1 = kinematics.log1p_of(OPS), kinematics.expm1_of(OPS)
# Second derivatives are accurate without the series of these.
_PLAIN = SimpleNamespace(**vars(OPS) | {"log1p": lambda x: ufl.ln(1 + x), "expm1": lambda x: ufl.exp(x) - 1})
POINTS = 8


class Invariants:
    """The arguments of a strain energy on a mesh.

    Parameters
    ----------
    energy
        Kind of the material.
    mesh
        Mesh of the body.
    u
        Displacements, in UFL.
    displacement_of
        Displacements of the direction of derivatives.
    fibres
        Unit vectors along the families of fibres, in UFL.
    small
        Where strains are small, the state and a direction of it.

    Attributes
    ----------
    F
        Deformation gradient.
    spatial
        F and J of the body that loads act on and Cauchy stresses are of: where strains are small, the undeformed one.
    deformation
        Parts of the deformation.
    measures
        Arguments of the energy by name, as variables of forms (or functions of variables).
    """

    def __init__(
        self,
        energy: str,
        mesh: Any,
        u: Any,
        displacement_of: Callable[[Any], Any],
        fibres: Sequence[Any] = (),
        small: tuple[Any, Any] | None = None,
    ) -> None:
        gradient, identity = ufl.grad(u), ufl.Identity(3)
        self.F, self._small = identity + gradient, small
        there = self.F if small is None else spaces.constant(mesh, np.eye(3))
        self.spatial = there, ufl.det(there)
        self.deformation = at = kinematics.deformation(OPS, gradient, identity)
        self._energy, self._undeformed = energy, spaces.constant(mesh, 0.0)
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
                name: tuple(map(ufl.variable, value)) if name == "i4" else ufl.variable(value)
                for name, value in found.items()
            }

    def stress(self, density: Any) -> Any:
        """P = ∂W/∂F (Pa) of a density of the measures."""
        slopes = {name: ufl.diff(density, found) for name, found in self._variables.items() if name != "i4"}
        of_fibres = [ufl.diff(density, longer) for longer in self._variables.get("i4", ())]
        fibres = list(zip(self._fibres, of_fibres, strict=True)) if of_fibres else []
        P = kinematics.nominal_stress(OPS, self.F, self.deformation, slopes, fibres)
        return self.to_first_order(sum((slopes[name] * self._shape.slopes[name] for name in self._symbols), P))

    def stored(self, density: Any) -> Any:
        """Return a density of the measures, to second order about rest where strains are small: P : ∇u/2."""
        return density if self._small is None else ufl.inner(self.stress(density), self.F - ufl.Identity(3)) / 2

    def to_first_order(self, expression: Any) -> Any:
        """Return an expression of the state, to first order about rest where strains are small."""
        if self._small is None:
            return expression
        (state, along), expand = self._small, ufl.algorithms.expand_derivatives
        zero = {state: ufl.zero(state.ufl_shape)}
        slope = expand(self.inserted(self.derivative_of(expression, state, along)))
        return ufl.replace(expand(self.inserted(expression)), zero) + ufl.replace(slope, zero | {along: state})

    def volume(self, factor: Any, values: Mapping[str, Any]) -> tuple[Any, Any]:
        """Return the bulk modulus κ (Pa) and g(J) of the volumetric part U = κ/2 g², used in the mixed form.

        For D1 (J−1)², g is J−1. For a stated U, Taylor's theorem with the remainder in integral form gives U = κ/2 g²
        with κ = U''(1) and

            g = (J−1) √(2/κ ∫₀¹ (1−t) U''(1 + t(J−1)) dt),

        which is smooth, free of cancellation at J = 1, and has the sign of J−1. The integral uses `POINTS` Gauss
        points, exact to 1e-12 for J from ½ to 2 if U has no singularity but J = 0.
        """
        j = self.measures.get("j", self.deformation.dilation)
        volume = volumetric(self._energy)
        assert volume is not None, "only energies that split have a mixed form"
        own = {name: values[name] for name in constants(volume)}
        if "D1" in own:
            return 2 * factor * own["D1"], j
        places, weights = np.polynomial.legendre.leggauss(POINTS)  # type: ignore[no-untyped-call]
        curvatures = [_curvature(volume, t * j, own) for t in (1 + places) / 2]
        modulus = _curvature(volume, self._undeformed, own)
        mean = sum(float(w * (1 - t)) * c for w, t, c in zip(weights, (1 + places) / 2, curvatures, strict=True))
        return factor * modulus, j * ufl.sqrt(mean / modulus)

    def derivative(self, form: Any, state: Any, direction: Any) -> Any:
        """Gâteaux derivative of a form by the state along a direction."""
        if not self._symbols:
            return ufl.derivative(form, state, direction)
        changed = [
            integral.reconstruct(self.derivative_of(integral.integrand(), state, direction))
            for integral in form.integrals()
        ]
        return ufl.Form(changed)

    def derivative_of(self, integrand: Any, state: Any, direction: Any) -> Any:
        """Gâteaux derivative of an expression by the state along a direction."""
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


def _curvature(volume: Energy, j: Any, values: Mapping[str, Any]) -> Any:
    """U''(J) of a volumetric part at J − 1 = j."""
    at = ufl.variable(j)
    U = volume(_PLAIN, at, **values)
    return ufl.algorithms.expand_derivatives(ufl.diff(ufl.diff(U, at), at))
