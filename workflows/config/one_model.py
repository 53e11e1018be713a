"""The blocks of studies of one model: the model, what is random or unknown of it, and what follows from both."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import Field

from forward.scalars import Mistake
from forward.settings import Settings
from uq.inputs.distributions import Distribution
from uq.inputs.random_parameters import Inputs
from workflows.config.blocks import Correlation
from workflows.config.priors import inputs_of, mistakes_of_priors, ranges

if TYPE_CHECKING:
    from forward.spec import ModelSpec
    from uq.inputs.draws import Draws


class OneModel(Settings):
    """A model with random or unknown parameters.

    Attributes
    ----------
    restricted
        Whether parameters without a material have no probability: as of priors. If not, such samples fail.
    """

    restricted: ClassVar[bool] = False

    model: Any
    parameters: dict[str, Distribution] = Field(default={})
    correlations: tuple[Correlation, ...] = ()

    @property
    def draws(self) -> Draws | None:
        """Draws of numbers of the model, if there is a source of them."""
        return None

    @property
    def given(self) -> Mapping[str, Distribution]:
        """The distributions by the paths of the numbers that they replace, those of draws too."""
        return {**self.parameters, **(self.draws.marginals if self.draws is not None else {})}

    @cached_property
    def spec(self) -> ModelSpec:
        """The model, in the form that suits all values of its parameters."""
        found: ModelSpec = self.model.over(ranges(self.given))
        return found

    @property
    def specs(self) -> tuple[ModelSpec, ...]:
        """Models that are in memory at the same time."""
        return (self.spec,)

    @property
    def random_fields(self) -> tuple[Any, ...]:
        """The random fields of all bodies of the model."""
        return tuple(field for body in self.model.bodies for field in body.fields)

    @property
    def nodal(self) -> list[int]:
        """Numbers of those whose values at the vertices are what is unknown."""
        return [i for i, field in enumerate(self.random_fields) if field.basis == "nodes"]

    @property
    def field(self) -> bool:
        """Whether values of a field at the vertices are what is unknown."""
        return bool(self.nodal)

    @cached_property
    def inputs(self) -> Inputs:
        """The parameters: those that are given, draws, and the standard normal coefficients of random fields.

        None for a field of nodal values.
        """
        coefficients = () if self.field else self.model.coefficients
        materials = self.model.materials(self.given) if self.restricted else None
        return inputs_of(self.parameters, self.correlations, coefficients, materials, self.draws)

    def mistakes_of_parameters(self) -> Iterator[Mistake]:
        """Find parameters that do not fit the model or each other."""
        yield from mistakes_of_priors(self.model, self.parameters, self.correlations, lambda: self.inputs, self.draws)
