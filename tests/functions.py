"""Functions that are models, good and bad."""

import numpy as np

from configs.own_model import beam, slopes

__all__ = ["beam", "slopes"]


def product(p):
    return p[0] * p[1] * p[2]


def brittle(p):
    if p[1] > 1:
        message = "the beam broke"
        raise RuntimeError(message)
    return beam(p)


def cube(p):
    return p[0] ** 3


def short(p):
    return p[:1]


def flat(p):
    return np.zeros((2, 2))


NUMBER = 3.0
