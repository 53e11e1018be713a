"""A model of one's own: a slender cantilever under its own weight, by Euler and Bernoulli's formula."""

WIDTH, HEIGHT = 0.02, 0.01  # m


def beam(p):
    """Deflection of the tip (m) and weight (N) from Young's modulus (Pa), weight per length (N/m) and length (m)."""
    E, q, L = p
    return [q * L**4 / (8 * E * WIDTH * HEIGHT**3 / 12), q * L]


def slopes(p):
    """Derivatives of both by all three: a row for each output. A model may do without."""
    E, q, L = p
    tip, _ = beam(p)
    return [[-tip / E, tip / q, 4 * tip / L], [0.0, L, q]]
