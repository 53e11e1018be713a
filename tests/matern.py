"""What is known of Matérn fields in closed form, and their precision (`forward.bodies.random_fields`)."""

from math import gamma, pi

import numpy as np

from forward.bodies.random_fields import _factorise, inverse_length


def inflation(matern, length, smoothness=2):
    """Variance (N,) of the SPDE before it is set to one, over Γ(ν) / (Γ(α) (4π)^{3/2} κ^{2ν}) in unbounded space.

    Source: F. Lindgren, H. Rue, J. Lindström, J. R. Stat. Soc. B 73 (2011) 423–498.
    """
    kappa, nu = inverse_length(length, smoothness), smoothness - 1.5
    return matern.raw_std**2 / (gamma(nu) / (gamma(smoothness) * (4 * pi) ** 1.5 * kappa ** (2 * nu)))


def correlation(distance, length, smoothness):
    """Matérn correlation (κr)^ν K_ν(κr) / (2^{ν−1} Γ(ν)) at distances (m), in closed form for ν = 1/2 and 5/2."""
    x = inverse_length(length, smoothness) * np.asarray(distance)
    return np.exp(-x) * (1 if smoothness == 2 else 1 + x + x**2 / 3)


def precision(matern, x, smoothness):
    """Multiply the inverse of the covariance with (N,) or (N, k)."""
    y = matern._operator @ (x.T * matern.raw_std).T
    mass = _factorise(matern._matrix)
    for _ in range(smoothness - 1):
        y = matern._operator @ mass.solve(y)
    return (y.T * matern.raw_std).T
