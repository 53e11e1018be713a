"""Outputs of a body as those of its reduced model."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forward.fem.model import HyperelasticModel
from forward.model import FloatArray, ModelError
from forward.observables.functionals import Integral
from forward.reduced.data import Output
from forward.reduced.integrands import Sampler, of_density
from forward.reduced.reduced_equations import LENGTH

NEAR_PEAK = 0.75  # of the largest stress of any snapshot, from which on points may have the largest


class Outputs:
    """The outputs of a body that is being reduced; integrands take numbers of it by their paths.

    Attributes
    ----------
    tests
        Fields (k, U_local) on which the work of all forces is an output.
    densities
        What is integrated over the body, and the functionals.
    """

    def __init__(self, model: HyperelasticModel, names: tuple[str, ...]) -> None:
        self._model, self._names = model, names
        self._equations = model.equations
        self._numbers = np.array([model.parameters.index(name) for name in names], dtype=np.int64)
        self.densities: list[tuple[Sampler, Integral]] = []
        self._of_output: dict[str, Sampler] = {}  # those that are not integrated by the rule of the body
        self._known: list[dict[str, Any]] = []  # what is known of each output before there are fields
        tests: list[FloatArray] = []
        for one, functional in self._pairs:
            known: dict[str, Any] = {}
            match getattr(functional, "reduced_as", None):
                case "work":
                    known["which"] = len(tests)
                    tests.append(functional.w)
                case "peak":
                    sampler = self._of_output[one.name] = self._sampler(functional.stress, self._equations.dx)
                    known["density"] = sampler.integrand.tape
                case "integral":
                    sampler = self._sampler(functional.density, functional.measure)
                    known |= {"size": functional.size, "density": sampler.integrand.tape}
                    if sampler.integrand.boundary is None:
                        known["which"] = len(self.densities)
                        self.densities.append((sampler, functional))
                    else:
                        self._of_output[one.name] = sampler
                case "largest":
                    known["which"] = LENGTH if one.component == "magnitude" else "xyz".index(one.component)
                case "linear":
                    pass
                case _:
                    raise ModelError(f"the output '{one.name}' cannot be reduced")
            self._known.append(known)
        self.tests = np.array(tests).reshape(-1, self._equations.size)

    @property
    def _pairs(self) -> Iterator[tuple[Any, Any]]:
        return zip(self._model.spec.outputs, self._model.functionals, strict=True)

    def _sampler(self, density: Any, measure: Any) -> Sampler:
        return Sampler(self._equations, of_density(self._equations, density, measure, self._names))

    def made(
        self, rows: FloatArray, states: FloatArray, parameters: FloatArray, kept: NDArray[np.bool_] | None
    ) -> tuple[Output, ...]:
        """Return them for coordinate fields (N, U_local) and snapshots (s, U_local) at parameters (s, d).

        `kept` says which cells are kept in full; None for none.
        """
        found: list[Output] = []
        for (one, functional), known in zip(self._pairs, self._known, strict=True):
            row, points = None, None
            if functional.reduced_as == "linear":
                row = rows @ functional.gradient()
            elif one.name in self._of_output:
                sampler, peak = self._of_output[one.name], functional.reduced_as == "peak"
                points = sampler.points(rows, self._near_peak(sampler, states, parameters, kept) if peak else None)
            found.append(Output(one.name, one.unit, functional.reduced_as, row=row, points=points, **known))
        return tuple(found)

    def places(self, state: FloatArray, parameters: FloatArray) -> NDArray[np.int64]:
        """Return where the body in a state (U_local,) at parameters (d,) has its largest values.

        Returns
        -------
        numpy.ndarray
            For each output (m,) the number of a node or of a quadrature point; −1 for those that are no largest value.
        """
        self._equations.set_to(parameters, state)
        return np.array([one.place() if one.reduced_as in {"largest", "peak"} else -1 for _, one in self._pairs])

    def _near_peak(
        self, sampler: Sampler, states: FloatArray, parameters: FloatArray, kept: NDArray[np.bool_] | None
    ) -> NDArray[np.int64]:
        """Number the points that are near the largest value in any snapshot, and those in cells kept in full."""
        near = np.zeros(sampler.count, dtype=bool)
        if kept is not None:
            near |= np.repeat(kept, sampler.count // len(kept))
        everywhere = sampler.points(np.zeros((0, states.shape[1])))
        kernel = sampler.kernel(len(self._numbers))
        for state, point in zip(states, parameters, strict=True):
            inputs = sampler.inputs(sampler.components(state), everywhere, point)
            values = kernel(inputs, point[self._numbers])[0]
            near |= values >= NEAR_PEAK * values.max()
        return np.flatnonzero(near)
