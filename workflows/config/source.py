"""The block `parameters.from`: numbers of the model whose distribution is known by draws, as from a calibration."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any

from pydantic import Field, model_serializer, model_validator

from forward.registry import named
from forward.settings import Settings

if TYPE_CHECKING:
    from forward.spec import ModelSpec
    from uq.inputs.distributions import Distribution
    from uq.inputs.draws import Draws

KEPT = "draws.npz"  # beside study.toml: the draws as they were read
AVERAGED = "averaged"  # all candidates, by their probabilities
STACKED = "stacked"  # all candidates, by the weights with which they predict left-out data best
READER = "workflows.studies.posteriors"  # reads files of draws, once a study names one


def averages(blocks: Mapping[str, Any]) -> bool:
    """Whether the source that stands among the parameters of a study means all candidates of a comparison."""
    parameters = blocks.get("parameters")
    source = parameters.get("from") if isinstance(parameters, Mapping) else None
    return isinstance(source, Mapping) and source.get("model") in (AVERAGED, STACKED)


class Source(Settings):
    """Draws of numbers of the model, which take the place of distributions.

    Parameters
    ----------
    file
        The results directory of a study of kind ``select`` or ``invert``, or a table of draws: CSV with a column for
        each number, or netCDF with a group ``posterior`` (ArviZ) or a variable for each.
    group
        The group of data of ``select``, or the data set of ``invert``; may be left out if there is only one.
    model
        The candidate of ``select``: its name, "best", the most probable one, or "averaged", all of them by
        their probabilities, or "stacked", by the weights with which their mixture predicts left-out data best.
    names
        Names in the source by the paths of numbers of the model, where they differ. Without it every name of the source
        is looked for among the paths: as it is, or as the end of a path, if only one ends so. With it, only
        these are taken.
    digest
        Hash of the file, filled in when it is read: an interrupted study is not continued with other draws.
    """

    file: str = Field(min_length=1)
    group: str | None = None
    model: str | None = None
    names: dict[str, str] = Field(default={})
    digest: str = ""

    @model_validator(mode="before")
    @classmethod
    def _of_text(cls, value: Any) -> Any:
        return {"file": value} if isinstance(value, str) else value

    @model_validator(mode="after")
    def _read(self) -> Source:
        whole = self.model in (AVERAGED, STACKED)
        found: str = named(f"{READER}:Left")(self.file).digest if whole else self.drawn.digest
        if self.digest and found != self.digest:
            raise ValueError(f"{self.file} has changed since the study was begun: hash {self.digest} → {found}")
        object.__setattr__(self, "digest", found)
        return self

    @cached_property
    def drawn(self) -> Draws:
        """The draws, by their names in the source; a ValueError says what is wrong with it."""
        found: Draws = named(f"{READER}:read")(self.file, self.group, self.model)
        return found


class Sourced(Settings):
    """A study whose file may name draws among its parameters.

    Parameters
    ----------
    source
        Draws of further numbers; in a file it is ``parameters.from``.
    """

    source: Source | None = None

    if TYPE_CHECKING:  # fields of these studies

        @property
        def model(self) -> ModelSpec:
            """The model."""

        @property
        def parameters(self) -> dict[str, Distribution]:
            """Distributions by paths."""

    @cached_property
    def draws(self) -> Draws | None:
        """Draws of numbers of the model, if there is a source of them."""
        if self.source is None:
            return None
        found: Draws | None = named(f"{READER}:draws_of")(self.source, self.model.scalars)
        return found

    @property
    def given(self) -> dict[str, Distribution]:
        """The distributions by the paths of the numbers that they replace, those of draws too."""
        return {**self.parameters, **(self.draws.marginals if self.draws is not None else {})}

    @property
    def by_contents(self) -> dict[str, Any]:
        """The blocks that name files, by the contents of these in place of their paths."""
        found: dict[str, Any] = {"model": self.model.identity()}
        if self.source is None:
            return found
        own = {path: one.model_dump(mode="json") for path, one in self.parameters.items()}
        return found | {"parameters": {"from": self.source.digest, **own}}

    @property
    def beside(self) -> Mapping[str, bytes]:
        """The draws, as they were read."""
        if self.source is None or self.source.model in (AVERAGED, STACKED):
            return {}
        return {KEPT: named(f"{READER}:to_file")(self.source.drawn)}

    @model_serializer(mode="wrap")
    def _source_among_parameters(self, handler: Any) -> dict[str, Any]:
        """Write the source where files have it."""
        found: dict[str, Any] = handler(self)
        source = found.pop("source", None)
        return found if source is None else found | {"parameters": {"from": source, **found["parameters"]}}

    @model_validator(mode="before")
    @classmethod
    def _take_source(cls, value: Any) -> Any:
        """Take the source from among the parameters."""
        parameters = value.get("parameters") if isinstance(value, dict) else None
        if not isinstance(parameters, dict) or "from" not in parameters:
            return value
        rest = {path: block for path, block in parameters.items() if path != "from"}
        return value | {"parameters": rest, "source": parameters["from"]}
