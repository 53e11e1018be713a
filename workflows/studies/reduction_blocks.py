"""The method `reduce`: what a reduced model is made of, and how accurate it is to be."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from forward.registry import named
from forward.scalars import Mistake
from forward.settings import Settings
from uq.methods.method import Method

if TYPE_CHECKING:
    import xarray as xr

    from forward.spec import ModelSpec
    from uq.evaluation.request import Evaluate
    from uq.inputs.random_parameters import Inputs

FILE = "reduced.npz"


class Blocks(Settings):
    """Blocks of a body with modes of their own, joined at their interfaces.

    Parameters
    ----------
    cut
        Numbers of blocks along the axes; or "regions", which are the blocks then.
    full
        Places in blocks that are kept in full, where a tool may press that no snapshot has seen.
    """

    cut: (
        tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]]
        | Literal["regions"]
    )
    full: tuple[tuple[float, float, float], ...] = ()


class Reduce(Method):
    """Make a reduced model of a body.

    Parameters
    ----------
    case
        Which load case of a specimen is reduced, with those parameters that act in it.
    snapshots
        Solves of which it is made. Half of them fill the distribution evenly; the others are, round by round, those of
        many candidates at which the estimated error of any output is largest.
    rounds
        In how many rounds those are drawn.
    modes
        Number of modes; by default as many as `truncation` needs.
    more
        How many modes of states the nested larger model has besides, which tells errors and corrects gradients.
    blocks
        Into which blocks the body is cut, with modes of their own; by default modes are those of the whole body.
    truncation
        What the modes may leave of the snapshots: root mean square in the norm of the stiffness, relative.
    cubature
        What the points may miss of the forces of the snapshots, relative.
    derivatives
        Whether states are differentiated and adjoints solved for at the snapshots, which takes a factorisation each.
        Estimates of errors need them; a control variate beside the body (`multifidelity`) does without.
    unseen
        Further solves, at random samples, on which its errors are measured.
    seed
        Of all points.
    """

    kind: Literal["reduce"] = "reduce"
    case: str | None = None
    snapshots: Annotated[int, Field(ge=4)] = 96
    rounds: Annotated[int, Field(ge=0)] = 3
    modes: Annotated[int, Field(ge=1)] | None = None
    more: Annotated[int, Field(ge=1)] = 120
    blocks: Blocks | None = None
    truncation: Annotated[float, Field(gt=0, lt=1)] = 2e-3
    cubature: Annotated[float, Field(gt=0, lt=1)] = 1e-3
    derivatives: bool = True
    unseen: Annotated[int, Field(ge=0)] = 32
    seed: Annotated[int, Field(ge=0)] = 0

    def planned(self, dimension: int) -> int:
        return self.snapshots + self.unseen + 1

    def run(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        """Refuse: states are needed, which an evaluation does not return."""
        raise ValueError("method.kind = 'reduce' is run by a study of its own")

    def unfit(self, spec: ModelSpec) -> Iterator[Mistake]:
        if spec.kind != "hyperelastic":
            yield ("model", "kind"), "only a body can be reduced, expected 'hyperelastic'", spec.kind
            return
        if self.case is not None:
            yield ("method", "case"), "a body has no load cases, expected none", self.case
        for said in named("forward.reduced.spec:mistakes")(spec):
            yield ("model",), said, spec.kind
