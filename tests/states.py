"""Functions with states: displacement fields without a body, for what estimates and findings say of fields."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from forward.pointwise import FunctionModel, FunctionSolution


class Everywhere:
    """Displacements, one after the other."""

    def __init__(self, displacements):
        self.displacements = displacements

    def gather(self, rows):
        return rows

    def scatter(self, rows):
        return rows


@dataclass(frozen=True)
class WithState(FunctionModel):
    """A function model with a state (U,) of displacements, a function of the parameters, real or complex."""

    states: Callable[[Any], Any] = None

    @property
    def space(self):
        return Everywhere(len(self.states(np.ones(len(self.parameters)))))

    def solve(self, parameters, guess=None):
        return SolutionWithState(self, parameters, super().solve(parameters).outputs)


class SolutionWithState(FunctionSolution):
    """Its state at one parameter vector, with derivatives by complex steps."""

    @property
    def state(self):
        return np.real(self.model.states(self.parameters))

    def state_tangent(self, direction):
        rows = np.atleast_2d(direction)
        slopes = np.array([np.imag(self.model.states(self.parameters + 1e-30j * row)) / 1e-30 for row in rows])
        return slopes.reshape(*np.shape(direction)[:-1], -1)
