"""A model of one's own: the deflection of a cantilever under its own weight, by the formula of a slender beam."""

import numpy as np

HEIGHT, WIDTH = 0.01, 0.02  # m


def beam(p):
    """Tip deflection (m) and weight (N) from Young's modulus (Pa), weight per length (N/m) and length (m)."""
    E, q, L = p
    return [q * L**4 / (8 * E * WIDTH * HEIGHT**3 / 12), q * L]


def slopes(p):
    E, q, L = p
    tip = beam(p)[0]
    return [[-tip / E, tip / q, 4 * tip / L], [0.0, L, q]]


def product(p):
    return p[0] * p[1] * p[2]


def brittle(p):
    if p[1] > 1:
        message = "the beam broke"
        raise RuntimeError(message)
    return beam(p)


def short(p):
    return p[:1]


def flat(p):
    return np.zeros((2, 2))


NUMBER = 3.0
