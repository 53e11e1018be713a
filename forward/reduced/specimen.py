"""Reduced models of the load cases of a specimen, as one model of what is observed of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

from forward.combine import Joined
from forward.model import FloatArray, Guess, Stability, Work
from forward.pointwise import ExplicitSolution, OfOne

if TYPE_CHECKING:
    from forward.fem.space import Observation
    from forward.fem.specimen import SpecimenModel
    from forward.reduced.model import ReducedModel, ReducedSolution


def observed_by(specimen: SpecimenModel, models: tuple[ReducedModel, ...]) -> Joined:
    """Return reduced models of the load cases with parameters and outputs of a specimen; collective over its ranks."""
    found = []
    for one, body, model in zip(specimen.models, specimen.bodies, models, strict=True):
        assert body.rows is not None
        equations, fields = body.equations, body.space.scatter(model.data.fields[: model.level.count])
        seen = equations.total((body.rows.matrix(equations) @ fields.T).T).T
        found.append(replace(one, model=ObservedModel(model, body.outputs, seen, body.rows)))
    return Joined(tuple(found), specimen.outputs, specimen.labels)


@dataclass(frozen=True, eq=False)
class ObservedModel(OfOne):
    """A reduced model of a load case, with what is observed of it as outputs.

    Parameters
    ----------
    model
        The one of the body.
    names
        Of what is observed.
    seen
        What is observed (n, N) of its coordinate fields.
    rows
        Which outputs of the body are observed besides.
    """

    model: ReducedModel
    names: tuple[str, ...]
    seen: FloatArray
    rows: Observation

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of what is observed."""
        return self.names

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> ObservedSolution:
        """Find the equilibrium at `parameters` (d,)."""
        found = self.model.reduced(parameters)
        return ObservedSolution(self, found, found.work, found.stability)


@dataclass(frozen=True, eq=False)
class ObservedSolution(ExplicitSolution):
    """What is observed of an equilibrium of a reduced model."""

    model: ObservedModel
    solution: ReducedSolution
    work: Work
    stability: Stability

    @cached_property
    def outputs(self) -> FloatArray:
        """What is observed (n,)."""
        one, model = self.solution, self.model
        found = model.rows.with_outputs(model.seen @ one.c, lambda: one.outputs)
        found.flags.writeable = False
        return found

    @cached_property
    def jacobian(self) -> FloatArray:
        """Derivatives (n, d) of the outputs."""
        one, model = self.solution, self.model
        return model.rows.with_outputs((model.seen @ one.slopes).T, lambda: one.jacobian.T).T
