"""The block `predict` of an inversion: what else is to be known of what was measured."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from forward.settings import Settings
from forward.specimen import LoadCase, Observed

LEAST = 8  # solves of an expansion


class Predict(Settings):
    """Outputs that the posterior predicts: under other loads, at other places, of another kind.

    Parameters
    ----------
    cases
        Of a specimen: load cases in which something is predicted, with what acts in them and `outputs`. One that has
        the name of a measured load case and nothing that acts is that load case. By default the measured ones.
    observed
        Of a specimen: places at which displacements are predicted, as `model.observed` has them.
    model
        Of other models: settings that replace those of the model, such as { loads = [...], outputs = [...] }; all of
        the outputs are predicted. By default the model as it is.
    samples
        Solves for the posterior, and as many for the prior: those of an expansion over draws of few parameters (by
        default 32); of a field, pairs of draws (8 pairs), without which it is not seen what derivatives leave out.
    """

    cases: tuple[LoadCase, ...] = ()
    observed: tuple[Observed, ...] = ()
    model: dict[str, Any] = Field(default={})
    samples: Annotated[int, Field(ge=0)] | None = None

    def solves(self, *, field: bool) -> int:
        """Number of solves beside the first, for the posterior as for the prior."""
        if self.samples is None:
            return 16 if field else 32
        return self.samples
