"""The blocks of studies of one model: the model, and what is random or unknown of it, also by draws."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import BeforeValidator, Field, field_validator, model_serializer, model_validator

from forward.findings import Finding
from forward.settings import Settings, Sized, nearest, written_out
from uq.inputs.distributions import Distribution
from uq.inputs.random_parameters import Inputs
from workflows.config.blocks import ALL_CANDIDATES, BESIDE, KEPT, Correlation, Parallel
from workflows.config.priors import (
    LEAST,
    impossible_draws,
    inputs_of,
    mistakes_of_materials,
    mistakes_of_parameters,
    ranges,
)
from workflows.config.tables import at

if TYPE_CHECKING:
    from forward.scalars import Mistake, Scalar
    from forward.spec import ModelSpec
    from uq.inputs.draws import Draws


Priors = Annotated[
    dict[str, Distribution], BeforeValidator(written_out, json_schema_input_type=dict[str, Distribution | Sized])
]
"""Distributions by path; x = { size = 64, kind = "normal", ... } are those of x.0 to x.63."""


class OneModel(Settings):
    """A model with random or unknown parameters."""

    # Whether parameters without a material have no probability: as of priors. If not, such samples fail.
    restricted: ClassVar[bool] = False

    model: Any
    parameters: Priors = Field(default={})
    correlations: tuple[Correlation, ...] = ()

    if TYPE_CHECKING:  # of every study
        parallel: Parallel

        def units_of(self, label: str) -> dict[str, str]:
            """SI units of numbers of the model, by their paths."""

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
        """Find parameters or draws that do not fit the model or each other."""
        spec, draws = self.model, self.draws
        yield from mistakes_of_parameters(spec, self.parameters)
        for name, share, objection in () if draws is None else impossible_draws(spec, draws, self.parameters):
            if name in spec.unavailable:
                yield ("parameters", "from"), spec.unavailable[name], name
            if share > 1 - LEAST:
                said = f"{100 * share:.3g} % of the draws of '{name}' are where the model is impossible ({objection})"
                yield ("parameters", "from"), said, name
        try:
            found = self.inputs
        except ValueError as error:
            yield ("correlations",), str(error), [c.model_dump() for c in self.correlations]
        else:
            materials = spec.materials(found.names)
            if materials is not None:
                yield from mistakes_of_materials(found.within(materials), materials)


# --- draws among the parameters --------------------------------------------------------------------------------------


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
        these are taken, and what was uncertain beside the parameters can be, as ``"uncertain.PATH"``.
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

    @property
    def whole(self) -> bool:
        """Whether all candidates of a comparison are meant."""
        return self.model in ALL_CANDIDATES

    @property
    def read(self) -> Source:
        """The same with the hash of the file as it is; a ValueError says that it has changed, or is none."""
        from workflows.results.posteriors import Left

        found = Left(self.file).digest if self.whole else self.drawn.digest
        if self.digest and found != self.digest:
            raise ValueError(f"{self.file} has changed since the study was begun: hash {self.digest} → {found}")
        return self.model_copy(update={"digest": found})

    @cached_property
    def drawn(self) -> Draws:
        """The draws, by their names in the source; a ValueError says what is wrong with it."""
        from workflows.results.posteriors import read

        return read(self.file, self.group, self.model)

    def mapped(self, scalars: Mapping[str, Scalar]) -> dict[str, str]:
        """Return names in it by paths of numbers of the model; those that do not fit are left out."""
        drawn = self.drawn.names
        if self.names:
            return {path: name for path, name in self.names.items() if path in scalars and name in drawn}
        found = {}
        for name in drawn:
            ends = [path for path in scalars if path == name or path.endswith(f".{name}")]
            if name in scalars or len(ends) == 1:
                found[name if name in scalars else ends[0]] = name
        return found

    @property
    def material(self) -> dict[str, Any]:
        """The block of the material that was calibrated, as far as it is known."""
        from workflows.results.posteriors import Left

        left = Left(self.file)
        return left.material(self.model) if left.path.is_dir() else {}

    def draws_of(self, scalars: Mapping[str, Scalar]) -> Draws | None:
        """Return the draws by paths of numbers of the model; None if there are none.

        A ValueError says that they are no distribution: too few, constant, or linearly dependent.
        """
        from uq.inputs.draws import Draws

        found, drawn = self.mapped(scalars), self.drawn
        if not found:
            return None
        columns = [drawn.names.index(name) for name in found.values()]
        chosen = Draws(tuple(found), drawn.values[:, columns], drawn.weights, drawn.effective, drawn.digest)
        objection = chosen.objection()
        if objection is not None:
            raise ValueError(objection)
        return chosen

    def mistakes(self, model: ModelSpec, own: Sequence[str]) -> Iterator[Mistake]:
        """Find what does not fit the model, and numbers that have a distribution of their own too."""
        wrong = list(self._mismatches(model, own))
        yield from wrong
        if not wrong:
            try:
                self.draws_of(model.scalars)
            except ValueError as error:
                yield ("parameters", "from"), str(error), self.file

    def _mismatches(self, model: ModelSpec, own: Sequence[str]) -> Iterator[Mistake]:
        drawn, place, scalars = self.drawn.names, ("parameters", "from"), model.scalars
        found = self.mapped(scalars)
        for path, name in self.names.items():
            if path not in scalars:
                yield (*place, "names"), f"'{path}' is not a number of the model; {nearest(path, tuple(scalars))}", path
            if name not in drawn:
                yield (*place, "names"), f"'{name}' is not in {self.file}; {nearest(name, list(drawn))}", name
        for name in drawn if not self.names else ():
            if name not in found.values() and not name.startswith(BESIDE):
                ends = [path for path in scalars if path.endswith(f".{name}")]
                near = f"expected one of: {', '.join(ends)}" if ends else nearest(name, tuple(scalars))
                message = (
                    f"'{name}' of {self.file} is not a number of the model; {near}; with names = {{ PATH = NAME }} "
                    "only the names in it are taken"
                )
                yield place, message, name
        for path in found:
            if path in own:
                message = f"has a distribution, and is in {self.file} too, expected only one of them"
                yield ("parameters", path), message, path
        block, mine = self.material, getattr(model, "material", None)
        if block and mine is not None and block.get("kind") != mine.kind and not self.names:
            message = f"constants are of the material '{block.get('kind')}' in {self.file}, expected it in the model"
            yield ("model", "material", "kind"), message, mine.kind

    def findings(self, model: ModelSpec, inputs: Inputs) -> Iterator[Finding]:
        """Find what the draws say before anything is solved."""
        from uq.estimators.input_sample_error import findings_of_source

        yield from findings_of_source(inputs)
        of_draws = () if inputs.draws is None else impossible_draws(model, inputs.draws, inputs.names)
        for name, share, objection in of_draws:
            if share > 0:  # these samples fail
                values = {"share": 100 * share, "name": name, "objection": objection}
                yield Finding("draws-impossible", "warning", values)
        beside = [name.removeprefix(BESIDE) for name in self.drawn.names if name.startswith(BESIDE)]
        there = [name for name in beside if name in model.scalars and name not in inputs.names]
        if there:
            yield Finding("uncertain-in-source", "note", {"source": self.file, "names": ", ".join(there)})
        block, mine = self.material, getattr(model, "material", None)
        if block and mine is not None:
            here = {name: v for name, v in mine.model_dump().items() if name in block and name not in self.drawn.names}
            other = [
                f"{name} = {here[name]:g}, there {v:g}"
                for name, v in block.items()
                if name in here and isinstance(v, int | float) and here[name] != v
            ]
            if other:
                yield Finding("constants-changed", "warning", {"source": self.file, "changed": "; ".join(other)})


class Sourced(OneModel):
    """A study of one model whose file may name draws among its parameters.

    Parameters
    ----------
    source
        Draws of further numbers; in a file it is ``parameters.from``.
    """

    source: Source | None = None

    @cached_property
    def draws(self) -> Draws | None:
        return None if self.source is None else self.source.draws_of(self.model.scalars)

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
        if self.source is None or self.source.whole:
            return {}
        from workflows.results.posteriors import to_file

        return {KEPT: to_file(self.source.drawn)}

    @field_validator("source")
    @classmethod
    def _read(cls, source: Source | None) -> Source | None:
        return None if source is None else source.read

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
        source = at(value, "parameters", "from")
        if source is None:
            return value
        rest = {path: block for path, block in value["parameters"].items() if path != "from"}
        return value | {"parameters": rest, "source": source}
