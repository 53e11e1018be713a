"""Strain energies of hyperelastic materials: one plain function each.

A function takes the operators `ops` (``ln``, ``log1p``, ``exp``, ``expm1``, ``sinh``, ``sqrt``; ``positive``: the
larger of x and 0; ``near``: one of two expressions, depending on whether |z| is below a limit), measures of deformation
by name, and its constants as keyword-only arguments. UFL reads it for finite elements, a `forward.graph` for closed
forms. The names of the keyword-only arguments *are* the names of the parameters in studies and results; their
annotations give the units and the values for which the energy is defined. Which constants together are stable at rest
is stated in `forward.materials.admissible`. All energies are in J/m³ and vanish, with their stress, in the undeformed
body.

Measures vanish in the undeformed body, and `forward.materials.kinematics` computes them from ∇u without subtracting
numbers near one. Energies are written without such differences too: they keep their digits however small the strains.

    i1, i2      Ī1 − 3 and Ī2 − 3, with Ī1 = J^(−2/3) I1, Ī2 = J^(−4/3) I2
    j           J − 1
    l1, l2, l3  ln λ̄_i, with λ̄_i = J^(−1/3) λ_i; their sum is zero
    i4          the tuple of I4_f − 1 of the families f of fibres
    trace       tr E, with E = (C − I)/2
    square      E:E

An energy that has a constant called D1 splits into an isochoric part (the energy with D1 = 0, a function of i1, i2, l1,
l2, l3 and the fibres) and the volumetric part D1(J−1)². Other volumetric parts are stated explicitly
(`forward.materials.material.with_volume`).
"""

from __future__ import annotations

from typing import Annotated, Any

from annotated_types import Ge, Gt, Unit

from forward.materials.kinematics import atanh_rest

Number = Annotated[Any, Unit("Pa")]
NonNegative = Annotated[Any, Ge(0), Unit("Pa")]
Ratio = Annotated[Any, Unit("1")]
PositiveRatio = Annotated[Any, Gt(0), Unit("1")]


def mooney_rivlin(ops: Any, i1: Any, i2: Any, j: Any, *, C1: Number, C2: Number, D1: Number) -> Any:
    """Compressible Mooney–Rivlin: W = C1(Ī1−3) + C2(Ī2−3) + D1(J−1)².

    Ī1 = J^(−2/3) I1, Ī2 = J^(−4/3) I2; C1, C2, D1 in Pa. Small strain: μ = 2(C1+C2), κ = 2 D1.
    Source: R. S. Rivlin, Phil. Trans. R. Soc. A 241 (1948) 379–397.
    """
    return C1 * i1 + C2 * i2 + D1 * j**2


def neo_hookean(ops: Any, i1: Any, j: Any, *, C1: Number, D1: Number) -> Any:
    """Neo-Hookean with isochoric split: W = C1(Ī1−3) + D1(J−1)².

    C1, D1 in Pa. Small strain: μ = 2 C1, κ = 2 D1.
    """
    return C1 * i1 + D1 * j**2


def neo_hookean_coupled(ops: Any, i1: Any, j: Any, *, mu: Number, lmbda: Number) -> Any:
    """Coupled compressible neo-Hookean: W = μ/2 (I1−3) − μ ln J + λ/2 (ln J)².

    mu, lmbda: the Lamé constants in Pa. Written with I1 = J^(2/3) Ī1, and with the purely volumetric part of
    (I1−3)/2 − ln J: for y = J^⅓ and z = (y−1)/(y+1), by ln y = 2 artanh z, that is
    3/2 (y²−1) − 3 ln y = 3/2 (y−1)² (y+3)/(y+1) − 6 (artanh z − z).
    Source: J. Bonet, R. D. Wood, Nonlinear Continuum Mechanics for Finite Element Analysis (2008), eq. 6.27.
    """
    y = (1 + j) ** (1 / 3)
    h = j / (1 + y + y**2)  # y − 1
    volume = 3 / 2 * h**2 * (y + 3) / (y + 1) - 6 * atanh_rest(ops, h / (2 + h))
    return mu / 2 * y**2 * i1 + mu * volume + lmbda / 2 * ops.log1p(j) ** 2


def yeoh(ops: Any, i1: Any, j: Any, *, C10: Number, C20: Number, C30: Number, D1: Number) -> Any:
    """Yeoh: W = C10(Ī1−3) + C20(Ī1−3)² + C30(Ī1−3)³ + D1(J−1)².

    C10, C20, C30, D1 in Pa; C20 is negative for materials that soften before they stiffen. Small strain: μ = 2 C10,
    κ = 2 D1.
    Source: O. H. Yeoh, Rubber Chem. Technol. 66 (1993) 754–771.
    """
    return C10 * i1 + C20 * i1**2 + C30 * i1**3 + D1 * j**2


def gent(ops: Any, i1: Any, j: Any, *, mu: Number, Jm: PositiveRatio, D1: Number) -> Any:
    """Gent: W = −(μ Jm/2) ln(1 − (Ī1−3)/Jm) + D1(J−1)².

    mu, D1 in Pa; Jm is the upper limit of Ī1−3, at which the chains are fully extended; beyond it the energy is
    undefined (finite elements find NaN). Small strain: μ = mu, κ = 2 D1.
    Source: A. N. Gent, Rubber Chem. Technol. 69 (1996) 59–61.
    """
    # −½ ln x is −ln √x = 2 artanh((1 − √x)/(1 + √x)), whose derivatives too are no numbers where x < 0: those of ln x
    # are finite.
    used = i1 / Jm
    z = used / (1 + ops.sqrt(1 - used)) ** 2
    return 2 * mu * Jm * (z + atanh_rest(ops, z)) + D1 * j**2


def demiray(ops: Any, i1: Any, j: Any, *, a: Number, b: PositiveRatio, D1: Number) -> Any:
    """Demiray (isotropic Fung): W = a/(2b) (exp(b(Ī1−3)) − 1) + D1(J−1)².

    a, D1 in Pa; b is dimensionless. Small strain: μ = a, κ = 2 D1.
    Source: H. Demiray, J. Biomech. 5 (1972) 309–311.
    """
    return a / (2 * b) * ops.expm1(b * i1) + D1 * j**2


def saint_venant_kirchhoff(ops: Any, trace: Any, square: Any, *, lmbda: Number, mu: Number) -> Any:
    """Saint Venant–Kirchhoff: W = λ/2 (tr E)² + μ E:E with E = (C − I)/2.

    lmbda, mu: the Lamé constants in Pa.
    For large rotations with small strains only: under compression it softens until it collapses without resistance.
    Source: G. A. Holzapfel, Nonlinear Solid Mechanics (2000), section 6.5.
    """
    return lmbda / 2 * trace**2 + mu * square


def blatz_ko(ops: Any, i2: Any, j: Any, *, mu: Number) -> Any:
    """Blatz–Ko foam: W = μ/2 (I2/J² + 2J − 5).

    mu in Pa. Small strain: μ = mu, κ = 5/3 mu, that is Poisson's ratio 1/4. Written with I2 = J^(4/3) Ī2, and with the
    part due to a change of volume alone: for y = J^⅓, 3/y² + 2y³ − 5 = (y−1)² (2y³ + 4y² + 6y + 3)/y².
    Source: P. J. Blatz, W. L. Ko, Trans. Soc. Rheol. 6 (1962) 223–251.
    """
    y = (1 + j) ** (1 / 3)
    h = j / (1 + y + y**2)  # y − 1
    return mu / 2 * (i2 + h**2 * (2 * y**3 + 4 * y**2 + 6 * y + 3)) / y**2


def ogden(
    ops: Any,
    l1: Any,
    l2: Any,
    l3: Any,
    j: Any,
    *,
    mu1: Number,
    alpha1: Ratio,
    mu2: Number,
    alpha2: Ratio,
    mu3: Number,
    alpha3: Ratio,
    D1: Number,
) -> Any:
    """Ogden with three terms: W = Σ_k μ_k/α_k (λ̄₁^α_k + λ̄₂^α_k + λ̄₃^α_k − 3) + D1(J−1)².

    λ̄_i = J^(−1/3) λ_i; mu1, mu2, mu3, D1 in Pa; the exponents are dimensionless and not zero, and μ_k α_k > 0 for each
    term makes the energy convex. Small strain: μ = ½ Σ μ_k α_k, κ = 2 D1. Since the logarithms l_i of λ̄_i have no sum,
    with y = exp(−α l₃/2) a term is 4y sinh²(α (l₁−l₂)/4) + (y−1)² (2y+1)/y², a sum of squares.
    Source: R. W. Ogden, Proc. R. Soc. Lond. A 326 (1972) 565–584.
    """
    total = D1 * j**2
    for mu, alpha in ((mu1, alpha1), (mu2, alpha2), (mu3, alpha3)):
        h = ops.expm1(-alpha * l3 / 2)
        y = 1 + h
        total += mu / alpha * (4 * y * ops.sinh(alpha * (l1 - l2) / 4) ** 2 + h**2 * (2 * y + 1) / y**2)
    return total


def holzapfel_gasser_ogden(
    ops: Any, i1: Any, j: Any, i4: Any, *, c: Number, k1: NonNegative, k2: PositiveRatio, D1: Number
) -> Any:
    """Holzapfel–Gasser–Ogden: W = c/2 (Ī1−3) + Σ_f k1/(2 k2) (exp(k2 ⟨I4_f−1⟩²) − 1) + D1(J−1)².

    One or two families f of fibres along a_f in the undeformed body, I4_f = a_f·C a_f; ⟨x⟩ = max(x, 0): shortened
    fibres carry no load. I4 is not made isochoric, since fibres would then swell a compressible body. c, k1, D1 in Pa;
    k2 is dimensionless. Small strain: μ = c, κ = 2 D1 of the matrix; a fibre stretched by 1 + e adds the tension 4 k1
    e. Source: G. A. Holzapfel, T. C. Gasser, R. W. Ogden, J. Elasticity 61 (2000) 1–48; I4 as in D. R. Nolan et al., J.
    Mech. Behav. Biomed. Mater. 39 (2014) 48–60.
    """
    fibres = sum(ops.expm1(k2 * ops.positive(longer) ** 2) for longer in i4)
    return c / 2 * i1 + k1 / (2 * k2) * fibres + D1 * j**2
