"""Cheap models that a method may ask besides that of the study: each says what it is, and what a solve of it costs."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from forward.model import ModelError
from forward.registry import Kinds, OfKind, named
from forward.scalars import Mistake
from forward.settings import Settings
from forward.spec import MODELS, ModelSpec
from uq.methods.method import seconds_per_solve

UNBALANCED = 1e-4  # part of the forces that a reduced model may leave: it errs by far more, and need only follow
ROUGH = 1e-2  # part of the forces that a linear model may leave, for the same reason
OF_LINEAR = 0.3  # cost of such a solve over that of the body (`python -m benchmarks linear`)
CORRECTIONS = 8  # of a solve from the tangent to the tolerance, by which few of them are cheaper


class CheapModel(Settings):
    """A model with the parameters and the outputs of the study's.

    Parameters
    ----------
    name
        Its name in results.
    cost
        Processor time of a solve over that of a solve of the study's model, by which numbers of samples are chosen. By
        default it is predicted from the numbers of unknowns; other models need it.
    """

    name: str = ""
    cost: Annotated[float, Field(gt=0)] | None = None

    if TYPE_CHECKING:

        @property
        def kind(self) -> str:
            """Its kind, as in the study."""

    @property
    def label(self) -> str:
        """Its name in results, by default its kind."""
        return self.name or self.kind

    @abstractmethod
    def of(self, spec: ModelSpec) -> ModelSpec | None:
        """Return the model, given that of the study; None if it is that one, stopped early.

        Raises `ModelError` or `pydantic.ValidationError` if there is no such model.
        """

    @property
    def stopped_after(self) -> int | None:
        """Iterations of the solver after which it is stopped; None if it is not."""
        return None

    def predicted(self, unknowns: int, own: int) -> float | None:
        """Cost of a solve over that of the study's model, from its unknowns and its own; None if it is unknown."""
        if self.cost is not None or not unknowns or not own:
            return self.cost
        return seconds_per_solve(own) / seconds_per_solve(unknowns)

    def mistakes(self, spec: ModelSpec) -> Iterator[Mistake]:
        """Find what does not fit the model of the study; places are those in the block."""
        other = self.of(spec)
        if other is not None:
            wanted, returned = ([one.name for one in model.returned] for model in (spec, other))
            if returned != wanted:
                yield ("model", "outputs"), f"expected those of the study's model: {', '.join(wanted)}", returned
        if self.predicted(spec.unknowns, 0 if other is None else other.unknowns) is None:
            yield ("cost",), "cannot be predicted, expected the time of a solve over that of the study's model", None


class Coarser(CheapModel):
    """The same body with larger cells, or simpler ones.

    Parameters
    ----------
    coarser
        How many times as long cells are along each edge (numbers of cells are rounded up); those of a file must have
        been divided, by a power of two.
    degree
        Degree of its elements; by default that of the body.
    """

    kind: Literal["mesh"] = "mesh"
    coarser: Annotated[float, Field(ge=1)] = 2.0
    degree: Literal[1, 2] | None = None

    @property
    def label(self) -> str:
        cells = "" if self.coarser == 1 else f"cells × {self.coarser:g}"
        degree = "" if self.degree is None else f"degree {self.degree}"
        return self.name or ", ".join(filter(None, (cells, degree))) or self.kind

    def of(self, spec: ModelSpec) -> ModelSpec:
        found = spec.coarser(self.coarser, self.degree)
        if found.unknowns >= spec.unknowns:
            raise ModelError(f"{self.label}: {found.unknowns:,} unknowns, expected fewer than {spec.unknowns:,}")
        return found


class FewIterations(CheapModel):
    """The study's own model, stopped after a few iterations from the tangent at the mean parameters.

    Parameters
    ----------
    iterations
        Their number.
    """

    kind: Literal["iterations"] = "iterations"
    iterations: Annotated[int, Field(ge=1)] = 1

    @property
    def label(self) -> str:
        return self.name or f"{self.iterations} iteration{'s' if self.iterations > 1 else ''}"

    @property
    def stopped_after(self) -> int:
        return self.iterations

    def of(self, spec: ModelSpec) -> None:
        """Return none: it is the model of the study."""

    def predicted(self, unknowns: int, own: int) -> float | None:
        return min(1.0, self.iterations / CORRECTIONS) if self.cost is None else self.cost

    def mistakes(self, spec: ModelSpec) -> Iterator[Mistake]:
        if not spec.iterative:
            yield ("kind",), f"a model of kind '{spec.kind}' has no iterations of a solver", self.kind


class Linear(CheapModel):
    """The same body with small strains: its corrections go to a rough tolerance, with one factor for all samples."""

    kind: Literal["linear"] = "linear"

    def of(self, spec: ModelSpec) -> ModelSpec:
        return spec.linearised().solved_to(ROUGH)

    def predicted(self, unknowns: int, own: int) -> float:
        return self.cost or OF_LINEAR


class ReducedModel(CheapModel):
    """A reduced model of the body, without tests of stability and in lockstep.

    Parameters
    ----------
    file
        What `tissuq reduce` has made, with the random parameters of the study among its own.
    larger
        Take the nested larger model in it, which follows the body more closely; both may be named.
    """

    kind: Literal["reduced"] = "reduced"
    file: str
    larger: bool = False

    @property
    def label(self) -> str:
        return self.name or ("larger reduced" if self.larger else "reduced")

    def of(self, spec: ModelSpec) -> ModelSpec:
        made: ModelSpec = named("forward.reduced.spec:Reduced")(
            file=self.file, larger=self.larger, accept_unstable=True, unbalanced=UNBALANCED, within=True
        )
        return made

    def predicted(self, unknowns: int, own: int) -> float | None:
        if self.cost is not None or not unknowns:
            return self.cost
        made = named("forward.reduced.spec:Reduced")(file=self.file, larger=self.larger)
        return float(made.seconds_together / seconds_per_solve(unknowns))


class OtherModel(CheapModel):
    """Any other model, with the same parameters and outputs by name.

    Parameters
    ----------
    model
        Its block, as that of a study.
    """

    kind: Literal["model"] = "model"
    model: Annotated[ModelSpec, OfKind(MODELS, "hyperelastic")]

    @property
    def label(self) -> str:
        return self.name or self.model.kind

    def of(self, spec: ModelSpec) -> ModelSpec:
        return self.model


CHEAP = Kinds(
    "cheap-model",
    {
        "mesh": "uq.methods.low_fidelity:Coarser",
        "iterations": "uq.methods.low_fidelity:FewIterations",
        "linear": "uq.methods.low_fidelity:Linear",
        "reduced": "uq.methods.low_fidelity:ReducedModel",
        "model": "uq.methods.low_fidelity:OtherModel",
    },
    CheapModel,
)
