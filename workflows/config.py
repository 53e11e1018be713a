"""A study: a written-down constructor call of a model, its random parameters and a method."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from forward.hyperelastic import Hyperelastic
from forward.settings import Settings, nearest
from uq.compare import TIGHTER, Compare, Given, Sampling
from uq.derivative_based import DerivativeBased
from uq.distributions import Distribution, Normal
from uq.evaluate import BLOCKS
from uq.inputs import Inputs, Restricted
from uq.linearisation import LocalSensitivity
from uq.multilevel import MultilevelMonteCarlo
from uq.multilevel_chaos import MultilevelChaos
from uq.sobol import Sobol

if TYPE_CHECKING:
    from workflows.selection import Selection

Method = Annotated[
    Sampling | MultilevelMonteCarlo | LocalSensitivity | Sobol | DerivativeBased | Compare, Field(discriminator="kind")
]
NEGLIGIBLE = 1e-9  # a tail of this probability may lie outside the admissible values


class StudyError(Exception):
    """A study that cannot be run; each argument is one line: the place, what was given and what was expected."""

    def __str__(self) -> str:
        """All mistakes, a line each."""
        return "\n".join(self.args)


class Correlation(Settings):
    """Correlation of two parameters in the Gaussian copula."""

    between: tuple[str, str]
    value: Annotated[float, Field(gt=-1, lt=1)]


class Parallel(Settings):
    """How ranks are used; it does not change results (except by rounding, where ranks share a model or blocks change).

    Parameters
    ----------
    ranks_per_model
        Ranks that share one model; the others work on other samples.
    blocks
        Most blocks that an evaluation is cut into: more groups of ranks than these have nothing to do, and a block
        that is interrupted is begun again.
    """

    ranks_per_model: Annotated[int, Field(ge=1)] = 1
    blocks: Annotated[int, Field(ge=1, le=1_000_000)] = BLOCKS


class Study(Settings):
    """What to compute.

    Parameters
    ----------
    model
        The body.
    parameters
        Distributions by the paths of the numbers of the model that they override; may be left out where the model has
        random fields, whose coefficients are parameters by themselves.
    correlations
        Correlations between them.
    method
        What is computed and how.
    parallel
        Use of ranks.
    """

    model: Hyperelastic
    parameters: dict[str, Distribution] = Field(default={})
    correlations: tuple[Correlation, ...] = ()
    method: Method
    parallel: Parallel = Parallel()

    @property
    def inputs(self) -> Inputs:
        """The random parameters: those that are given, and then the standard normal coefficients of random fields."""
        standard = Normal(mean=0.0, std=1.0)
        marginals = self.parameters | dict.fromkeys(self.model.coefficients, standard)
        return Inputs(marginals, tuple((*c.between, c.value) for c in self.correlations))

    @property
    def meshes(self) -> tuple[Hyperelastic, ...]:
        """The model, and the same on the finer meshes that a multilevel method may use."""
        levels = self.method.levels if isinstance(self.method, MultilevelMonteCarlo) else 1
        return self.model, *(self.model.refined(level) for level in range(1, levels))

    @property
    def models(self) -> tuple[Hyperelastic, ...]:
        """The models that the method may ask for, in the order of their numbers."""
        if not isinstance(self.method, Compare):
            return self.meshes
        solver = self.model.solver
        tolerances = {name: TIGHTER * getattr(solver, name) for name in ("tolerance", "derivative_tolerance")}
        tight, textbook = (solver.model_copy(update=change) for change in (tolerances, {"kind": "newton"}))
        others = [self.model.model_copy(update={"solver": changed}) for changed in (tight, textbook)]
        return self.model, *others, *([self.model.refined(1)] if self.method.mesh_error else [])

    @property
    def planned(self) -> int:
        """Number of solves, the largest where a tolerance may end the study earlier, the least of a multilevel one."""
        return self.method.planned(len(self.parameters) + len(self.model.coefficients))

    @model_validator(mode="after")
    def _check(self) -> Study:
        mistakes = list(self._mistakes())
        if mistakes:
            raise ValidationError.from_exception_data(
                "Study",
                [
                    InitErrorDetails(
                        type=PydanticCustomError("study", "{message}", {"message": m}), loc=place, input=given
                    )
                    for place, m, given in mistakes
                ],
            )
        return self

    def _mistakes(self) -> Iterator[tuple[tuple[str | int, ...], str, Any]]:
        try:
            _ = self.models
        except ValidationError as error:
            message = f"the finest mesh cannot be: {error.errors()[0]['msg']}"
            yield ("method", "levels"), message, getattr(self.method, "levels", None)
        yield from self._mistakes_of_parameters()
        try:
            inputs = self.inputs
        except ValueError as error:
            yield ("correlations",), str(error), [c.model_dump() for c in self.correlations]
        else:
            objection = self.method.objection(inputs) if isinstance(self.method, Restricted) else None
            if objection is not None:
                yield ("correlations",), objection, [c.model_dump() for c in self.correlations]
            stranger = self.method.unknown(inputs) if isinstance(self.method, Sobol) else None
            if stranger is not None:
                yield ("method", "groups"), stranger, self.method.model_dump()["groups"]
        if isinstance(self.method, MultilevelChaos):
            shortage = self.method.shortage(len(self.parameters) + len(self.model.coefficients))
            if shortage is not None:
                yield ("method", "samples"), shortage, self.method.samples
        if isinstance(self.method, Compare):
            yield from self._compare_mistakes(self.method)

    def _mistakes_of_parameters(self) -> Iterator[tuple[tuple[str | int, ...], str, Any]]:
        scalars = self.model.scalars
        if not self.parameters and not self.model.fields:
            yield ("parameters",), "no parameter is random, expected at least one, or one of model.fields", {}
        if self.model.fields and isinstance(self.method, MultilevelMonteCarlo):
            message = "random fields have other coefficients on every mesh, expected a method with one mesh"
            yield ("model", "fields"), message, self.method.kind
        for i, field in enumerate(self.model.fields):
            if field.basis == "nodes":
                message = "values at the vertices are not independent, expected 'modes' or 'noise'"
                yield ("model", "fields", i, "basis"), message, field.basis
        for path, distribution in self.parameters.items():
            if path not in scalars:
                yield ("parameters",), f"not a number of the model; {nearest(path, tuple(scalars))}", path
                continue
            ends = distribution.support
            if ends is None:
                ends = (distribution.at(NEGLIGIBLE), distribution.at(1 - NEGLIGIBLE))
            for end in ends:
                objection = scalars[path].objection(end)
                if objection is not None:
                    message = f"reaches {end:.4g}, where the model is impossible ({objection})"
                    yield ("parameters", path), message, distribution.model_dump()
                    break

    def _compare_mistakes(self, method: Compare) -> Iterator[tuple[tuple[str | int, ...], str, Any]]:
        for i, entry in enumerate(method.methods):
            shortage = entry.shortage(len(self.parameters) + len(self.model.coefficients))
            if shortage is not None:
                yield ("method", "methods", i, "budgets"), shortage, list(entry.budgets)
        if isinstance(method.reference, Given):
            given, outputs = method.reference.values, [output.name for output in self.model.outputs]
            if set(given) != set(outputs):
                message = f"expected values of every output: {', '.join(outputs)}"
                yield ("method", "reference", "values"), message, list(given)


def parse(document: Mapping[str, Any], overrides: Sequence[str] = (), folder: Path = Path()) -> Study | Selection:
    """Check a document and make a study of it.

    Parameters
    ----------
    document
        The blocks of the study, as read from TOML.
    overrides
        Assignments such as ``method.samples=512`` that come on top; values are TOML, or else plain text.
    folder
        Where tables of data are that it names.

    Raises
    ------
    StudyError
        With every mistake found.
    """
    blocks = dict(document)
    for assignment in overrides:
        _override(blocks, assignment)
    try:
        if isinstance(blocks.get("method"), Mapping) and blocks["method"].get("kind") == "select":
            from workflows.selection import Selection, expanded

            return Selection.model_validate(expanded(blocks, folder))
        return Study.model_validate(blocks)
    except ValidationError as error:
        raise StudyError(*dict.fromkeys(line(item) for item in error.errors(include_url=False))) from None


def load(path: Path, overrides: Sequence[str] = ()) -> Study | Selection:
    """Read a study from a TOML file; overrides and errors as of `parse`."""
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        message = f"{path}: not valid TOML: {error}"
        raise StudyError(message) from None
    except UnicodeDecodeError:
        message = f"{path}: not a text file in UTF-8"
        raise StudyError(message) from None
    except OSError as error:
        message = f"{path}: cannot be read: {error.strerror}"
        raise StudyError(message) from None
    return parse(document, overrides, path.parent)


def document(study: Study | Selection) -> dict[str, Any]:
    """Return the blocks of a study, complete with defaults: `parse(document(study)) == study`."""
    return study.model_dump(mode="json", exclude_none=True)


def dump(study: Study | Selection) -> str:
    """Write a study as TOML, complete with defaults."""
    import tomli_w

    return tomli_w.dumps(document(study))


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """List what changed between two documents, one line for each place; how ranks are used does not count."""
    before, after = (dict(_leaves({k: v for k, v in d.items() if k != "parallel"})) for d in (old, new))
    places = [*before, *(place for place in after if place not in before)]
    return [
        f"{place}: {before.get(place, 'absent')} → {after.get(place, 'absent')}"
        for place in places
        if before.get(place) != after.get(place)
    ]


def _leaves(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _leaves(item, f"{place}.{key}" if place else key)
    elif isinstance(value, list) and any(isinstance(item, Mapping) for item in value):
        for i, item in enumerate(value):
            yield from _leaves(item, f"{place}[{i}]")
    else:
        yield place, value


def _override(blocks: dict[str, Any], assignment: str) -> None:
    key, equals, text = assignment.partition("=")
    if not equals:
        message = f"--set {assignment}: expected KEY=VALUE, such as method.samples=512"
        raise StudyError(message)
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    here: Any = blocks
    *way, last = _path(key.strip(), blocks)
    for step in way:
        if isinstance(here, list):
            here = _named(here, step, key)
            continue
        if not isinstance(here.get(step, {}), dict | list):
            message = f"--set {key}: '{step}' is a value, not a block"
            raise StudyError(message)
        copied = here.get(step, {})
        here[step] = copied.copy()
        here = here[step]
    if isinstance(here, list):
        message = f"--set {key}: expected the name of an element and one of its keys"
        raise StudyError(message)
    here[last] = value


def _path(key: str, blocks: Mapping[str, Any]) -> list[str]:
    """Split a dotted key; the keys of `parameters` hold dots themselves."""
    if key.startswith("parameters."):
        rest = key.removeprefix("parameters.")
        for path in blocks.get("parameters", {}):
            if rest == path or rest.startswith(f"{path}."):
                tail = rest.removeprefix(path).removeprefix(".")
                return ["parameters", path, *(tail.split(".") if tail else [])]
        return ["parameters", rest]
    return key.split(".")


def _named(items: list[Any], name: str, key: str) -> dict[str, Any]:
    for i, item in enumerate(items):
        if isinstance(item, dict) and name in (*map(item.get, ("name", "kind", "on", "of")), str(i)):
            items[i] = item.copy()
            return items[i]  # type: ignore[no-any-return]
    message = f"--set {key}: no element is called '{name}'"
    raise StudyError(message)


def line(item: Any, place: str = "") -> str:
    """Say one mistake in a block at a place: where, what was given, what was expected."""
    for step in item["loc"]:
        if isinstance(step, int):
            place += f"[{step}]"
        elif step not in _TAGS or place == "candidates":
            place += f".{step}" if place else step
    message = item["msg"]
    if item["type"] == "missing":
        return f"{place}: missing"
    if item["type"] == "unknown_key":
        return f"{place}: {message}"
    given = repr(item["input"])
    shown = given if len(given) <= 80 else given[:77] + "..."
    return f"{place}: {message[0].lower()}{message[1:]}; given {shown}"


def _kinds() -> set[str]:
    """Return the kinds of blocks, which pydantic puts into the places of errors."""
    from typing import get_args

    from forward import geometry, loads, outputs
    from forward.materials import MATERIALS

    unions = (geometry.Body, loads.Load, outputs.Output, Distribution, Method)
    members = [member for union in unions for member in get_args(get_args(union)[0])]
    return set(MATERIALS) | {member.model_fields["kind"].default for member in (*members, Given)}


_TAGS = _kinds() | {"sampling"}  # and the field of `Entry` whose keys stand in its own block
