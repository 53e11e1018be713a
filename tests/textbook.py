"""Energies as they stand in textbooks, in the digits of mpmath: I1 − 3, J − 1 and so on are differences."""

import mpmath
import numpy as np

STEP = mpmath.mpf("1e-20")  # of central differences, in 60 digits: twenty and more are right


def energy(block, F):
    """Energy density of a block `material` at a deformation gradient, a matrix of mpmath."""
    kind = block["kind"]
    v = {name: mpmath.mpf(value) for name, value in block.items() if name not in {"kind", "fibres"}}
    C = F.T * F
    J = mpmath.det(F)
    I1 = C[0, 0] + C[1, 1] + C[2, 2]
    squared = C * C
    I2 = (I1**2 - squared[0, 0] - squared[1, 1] - squared[2, 2]) / 2
    i1, i2 = I1 / mpmath.cbrt(J) ** 2 - 3, I2 / mpmath.cbrt(J) ** 4 - 3
    volume = v.get("D1", 0) * (J - 1) ** 2
    match kind:
        case "mooney-rivlin":
            return v["C1"] * i1 + v["C2"] * i2 + volume
        case "neo-hookean":
            return v["C1"] * i1 + volume
        case "neo-hookean-coupled":
            return v["mu"] / 2 * (I1 - 3) - v["mu"] * mpmath.log(J) + v["lmbda"] / 2 * mpmath.log(J) ** 2
        case "yeoh":
            return v["C10"] * i1 + v["C20"] * i1**2 + v["C30"] * i1**3 + volume
        case "gent":
            return -v["mu"] * v["Jm"] / 2 * mpmath.log(1 - i1 / v["Jm"]) + volume
        case "demiray":
            return v["a"] / (2 * v["b"]) * (mpmath.exp(v["b"] * i1) - 1) + volume
        case "saint-venant-kirchhoff":
            return v["lmbda"] / 8 * (I1 - 3) ** 2 + v["mu"] / 4 * (I1**2 - 2 * I2 - 2 * I1 + 3)
        case "blatz-ko":
            return v["mu"] / 2 * (I2 / J**2 + 2 * J - 5)
        case "ogden":
            stretches = [mpmath.sqrt(square) / mpmath.cbrt(J) for square in mpmath.eigsy(C)[0]]
            terms = ((v[f"mu{k}"], v[f"alpha{k}"]) for k in "123")
            return volume + sum(mu / alpha * sum(l**alpha - 1 for l in stretches) for mu, alpha in terms)
        case "holzapfel-gasser-ogden":
            longer = [max((a.T * C * a)[0] - 1, 0) for a in map(mpmath.matrix, block["fibres"])]
            fibres = sum(mpmath.exp(v["k2"] * x**2) - 1 for x in longer)
            return v["c"] / 2 * i1 + v["k1"] / (2 * v["k2"]) * fibres + volume
    raise ValueError(kind)


def nominal_stress(block, F):
    """P = ∂W/∂F by central differences, a matrix of mpmath."""
    P = mpmath.matrix(3, 3)
    for i in range(3):
        for j in range(3):
            step = mpmath.matrix(3, 3)
            step[i, j] = STEP
            P[i, j] = (energy(block, F + step) - energy(block, F - step)) / (2 * STEP)
    return P


def of_numbers(block, F):
    """Energy density, nominal stress P (3, 3), von Mises stress and J at numbers F (3, 3) as they are written."""
    with mpmath.workdps(60):
        F = mpmath.matrix([[mpmath.mpf(str(f)) for f in row] for row in np.asarray(F).tolist()])
        J, P = mpmath.det(F), nominal_stress(block, F)
        cauchy = P * F.T / J
        deviator = cauchy - (cauchy[0, 0] + cauchy[1, 1] + cauchy[2, 2]) / 3 * mpmath.eye(3)
        mises = mpmath.sqrt(1.5 * sum(x**2 for x in deviator))
        return float(energy(block, F)), np.array(P.tolist(), dtype=float), float(mises), float(J)
