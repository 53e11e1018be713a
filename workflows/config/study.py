"""A study: a written-down constructor call of a model, its random parameters and a method."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

from pydantic import Field, TypeAdapter, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from forward.model import Finding, ModelError
from forward.registry import OfKind, dotted
from forward.scalars import Mistake, Scalar
from forward.settings import UNKNOWN_KIND, Settings, cut, nearest, one_line, shown
from forward.spec import MODELS, ModelSpec
from uq.evaluation.evaluate import BLOCKS
from uq.inputs.distributions import Distribution, Normal
from uq.inputs.random_parameters import Inputs
from uq.methods.method import MESH, METHODS, Method
from workflows.config.priors import findings_of_draws, mistakes_of_materials
from workflows.config.report import Report, located

if TYPE_CHECKING:
    from workflows.studies.inversion import InversionStudy
    from workflows.studies.selection import Comparison
    from workflows.studies.synthesis import Synthesis

    AnyStudy: TypeAlias = "Study | Comparison | InversionStudy | Synthesis"

WITHOUT_EFFECT = {"parallel", "report"}  # blocks that results do not depend on
NEGLIGIBLE = 1e-9  # a tail of this probability may lie outside the admissible values


DEEPEST = 32  # levels of lists and tables in a study
LISTED = 50  # mistakes that are shown


class StudyError(Exception):
    """A study that cannot be run; each argument is one line: the place, what was given and what was expected."""

    def __init__(self, *mistakes: str) -> None:
        more = [f"and {len(mistakes) - LISTED} more mistakes"] if len(mistakes) > LISTED else []
        super().__init__(*map(one_line, mistakes[:LISTED]), *more)

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
        A body, or a model of another program.
    parameters
        Distributions by the paths of the numbers of the model that they override; may be left out where the model has
        random fields, whose coefficients are parameters by themselves.
    correlations
        Correlations between them.
    method
        What is computed and how.
    parallel
        Use of ranks.
    report
        Sections of one's own in the report.
    """

    model: Annotated[ModelSpec, OfKind(MODELS, "hyperelastic")]
    parameters: dict[str, Distribution] = Field(default={})
    correlations: tuple[Correlation, ...] = ()
    method: Annotated[Method, OfKind(METHODS)]
    parallel: Parallel = Parallel()
    report: Report | None = None

    @property
    def inputs(self) -> Inputs:
        """The random parameters: those that are given, and then the standard normal coefficients of random fields."""
        return Inputs(self._marginals, tuple((*c.between, c.value) for c in self.correlations))

    @property
    def _marginals(self) -> dict[str, Distribution]:
        return self.parameters | dict.fromkeys(self.model.coefficients, Normal(mean=0.0, std=1.0))

    @cached_property
    def spec(self) -> ModelSpec:
        """The model, in the form that suits all values of its parameters."""
        return self.model.over(ranges(self.parameters))

    @property
    def models(self) -> dict[str, ModelSpec]:
        """The models that the method may ask for beside that one, by name."""
        return self.method.models(self.spec)

    @property
    def meshes(self) -> tuple[ModelSpec, ...]:
        """The model, and the same on the finer meshes that a multilevel method may use."""
        return self.spec, *(model for name, model in self.models.items() if name.startswith(MESH))

    @property
    def planned(self) -> int:
        """Number of solves, the largest where a tolerance may end the study earlier, the least of a multilevel one."""
        return self.method.planned(len(self._marginals))

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What is to be said of the study before anything is solved."""
        materials = self.spec.materials(self.inputs.names)
        of_draws = () if materials is None else findings_of_draws(self.inputs.within(materials))
        return (*self.model.findings_over(ranges(self.parameters)), *of_draws)

    @model_validator(mode="after")
    def _check(self) -> Study:
        refused("Study", list(self._mistakes()))
        return self

    def _mistakes(self) -> Iterator[Mistake]:
        unfit = list(self.method.unfit(self.spec))
        yield from unfit
        if not unfit:
            yield from self._mistakes_of_models()
        yield from self._mistakes_of_parameters()
        not_sampled = list(self.spec.mistakes_of_samples())
        yield from not_sampled
        if self.parallel.ranks_per_model > 1 and not self.spec.shareable:
            message = f"a model of kind '{self.model.kind}' is not shared by ranks, expected 1"
            yield ("parallel", "ranks_per_model"), message, self.parallel.ranks_per_model
        inputs = Inputs(self._marginals)
        try:
            inputs = self.inputs
        except ValueError as error:
            yield ("correlations",), str(error), [c.model_dump() for c in self.correlations]
        else:
            materials = self.spec.materials(inputs.names)
            if materials is not None:
                yield from mistakes_of_materials(inputs.within(materials), materials)
        if not not_sampled:
            yield from self.method.mistakes(inputs, self.spec)

    def _mistakes_of_models(self) -> Iterator[Mistake]:
        try:
            _ = self.models
        except ValidationError as error:
            message = f"the finest mesh cannot be: {error.errors()[0]['msg']}"
            yield ("method", "levels"), message, getattr(self.method, "levels", None)
        except ModelError as error:
            yield ("method", "kind"), str(error), self.method.kind

    def _mistakes_of_parameters(self) -> Iterator[Mistake]:
        spec = self.spec
        if not self._marginals:
            or_field = ", or one of model.fields" if spec.meshed else ""
            yield ("parameters",), f"no parameter is random, expected at least one{or_field}", {}
        materials = spec.materials(self.parameters)
        constants = () if materials is None else materials.names
        yield from mistakes_of_parameters(spec.scalars, self.parameters, constants)


def ranges(parameters: Mapping[str, Distribution]) -> dict[str, tuple[float, float]]:
    """Return the ranges of parameters, by their paths."""
    return {path: distribution.range for path, distribution in parameters.items()}


def refused(title: str, mistakes: Sequence[Mistake]) -> None:
    """Raise what pydantic raises, if there are mistakes."""
    if mistakes:
        raise ValidationError.from_exception_data(
            title,
            [
                InitErrorDetails(type=PydanticCustomError("study", "{message}", {"message": m}), loc=place, input=given)
                for place, m, given in mistakes
            ],
        )


def mistakes_of_factor(prior: Distribution | None, *place: str) -> Iterator[Mistake]:
    """Find a prior of the factor on standard deviations of errors that reaches what is no standard deviation."""
    if prior is None:
        return
    lowest = prior.support[0] if prior.support is not None else prior.at(NEGLIGIBLE)
    if lowest < 0:
        message = f"reaches {lowest:.4g}, expected a factor on standard deviations, which is positive"
        yield place, message, prior.model_dump()


def mistakes_of_parameters(
    scalars: Mapping[str, Scalar], parameters: Mapping[str, Distribution], constants: Collection[str] = ()
) -> Iterator[Mistake]:
    """Find parameters that are no numbers of a model, or that reach where it is impossible.

    Constants of materials are left out: they are judged together, by `workflows.config.priors`.
    """
    for path, distribution in parameters.items():
        if path not in scalars:
            yield ("parameters",), f"not a number of the model; {nearest(path, tuple(scalars))}", path
            continue
        if path in constants:
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


def parse(document: Mapping[str, Any], overrides: Sequence[str] = (), folder: Path = Path()) -> AnyStudy:
    """Check a document and make a study of it.

    Parameters
    ----------
    document
        The blocks of the study, as read from TOML.
    overrides
        Assignments such as ``method.samples=512`` that come on top; values are TOML, or else plain text.
    folder
        Where tables of data, meshes and modules of kinds are that it names.

    Raises
    ------
    StudyError
        With every mistake found.
    ModelError
        If a kind is a dotted path to a module that is there twice.
    """
    blocks = dict(document)
    for assignment in overrides:
        _override(blocks, assignment)
    if _deeper_than(blocks, DEEPEST):
        message = f"lists and tables are nested too deeply, expected at most {DEEPEST} levels"
        raise StudyError(message)
    modules = list(dict.fromkeys(dotted(blocks)))
    if modules:
        from forward.external.own_modules import make_visible

        make_visible(modules, [folder.resolve(), Path.cwd()], "kind")
    try:
        blocks = located(_located(blocks, folder), folder)
        kind = blocks["method"].get("kind") if isinstance(blocks.get("method"), Mapping) else None
        if kind in ("invert", "synthesize"):
            from workflows.studies.inversion import made

            return made(blocks, folder)
        if kind == "select":
            from workflows.studies import selection

            return selection.made(blocks, folder)
        return Study.model_validate(blocks)
    except ValidationError as error:
        raise StudyError(*lines(error)) from None


def _deeper_than(tree: Any, most: int) -> bool:
    """Whether lists and tables are nested in more levels than these."""
    level = [tree]
    for _ in range(most):
        level = [item for one in level for item in (one.values() if isinstance(one, dict) else one)]
        level = [item for item in level if isinstance(item, dict | list)]
    return bool(level)


def _located(blocks: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Say in full where a mesh and the results of another study are, which a study names from where it stands itself.

    Results may be in the working directory too.
    """
    method, model = blocks.get("method"), blocks.get("model")
    source = method.get("source") if isinstance(method, Mapping) else None
    if isinstance(source, str) and isinstance(method, Mapping):
        place = next((path for path in (folder / source, Path(source)) if path.exists()), folder / source)
        blocks = blocks | {"method": {**method, "source": str(place.resolve())}}
    body = model.get("body") if isinstance(model, Mapping) else None
    file = body.get("file") if isinstance(body, Mapping) else None
    if not isinstance(file, str) or not isinstance(model, Mapping) or not isinstance(body, Mapping):
        return blocks
    return blocks | {"model": {**model, "body": {**body, "file": str((folder / file).resolve())}}}


def load(path: Path, overrides: Sequence[str] = ()) -> AnyStudy:
    """Read a study from a TOML file; overrides and errors as of `parse`."""
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8-sig"))  # editors on Windows begin files with a mark
    except RecursionError:
        message = f"{path}: lists or tables are nested too deeply"
        raise StudyError(message) from None
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


def schema() -> dict[str, Any]:
    """Return the JSON Schema of a study file, by which editors complete and check it."""
    from workflows.studies.inversion import Inversion
    from workflows.studies.output_inversion import OutputInversion
    from workflows.studies.selection import DataFile, Selection
    from workflows.studies.specimen_selection import DisplacementFile, SpecimenSelection
    from workflows.studies.synthesis import Synthesis

    adapter: TypeAdapter[Any] = TypeAdapter(
        Study | Selection | SpecimenSelection | Inversion | OutputInversion | Synthesis
    )
    found = adapter.json_schema(ref_template="#/$defs/{model}")
    # A file may name a table in place of the data themselves.
    for name, file in (("Selection", DataFile), ("SpecimenSelection", DisplacementFile)):
        table = TypeAdapter(file).json_schema(ref_template="#/$defs/{model}")
        found["$defs"] |= table.pop("$defs", {}) | {file.__name__: table}
        data = found["$defs"][name]["properties"]
        data["data"] = {"anyOf": [data["data"], {"$ref": f"#/$defs/{file.__name__}"}]}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "A study of tissuq"} | found


def document(study: AnyStudy) -> dict[str, Any]:
    """Return the blocks of a study, complete with defaults: `parse(document(study)) == study`."""
    return study.model_dump(mode="json", exclude_none=True)


def dump(study: AnyStudy) -> str:
    """Write a study as TOML, complete with defaults."""
    import tomli_w

    return tomli_w.dumps(document(study))


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """List what changed between two documents, one line for each place.

    Blocks that results do not depend on do not count, nor where a mesh is, as long as it is the same.
    """
    before, after = (dict(_leaves({k: v for k, v in d.items() if k not in WITHOUT_EFFECT})) for d in (old, new))
    if before.get(_MESH) == after.get(_MESH) is not None:
        after |= {"model.body.file": before["model.body.file"]}
    places = [*before, *(place for place in after if place not in before)]
    return [
        f"{place}: {before.get(place, 'absent')} → {after.get(place, 'absent')}"
        for place in places
        if before.get(place) != after.get(place)
    ]


_MESH = "model.body.contents.digest"


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
    if not equals or not key.strip():
        message = f"--set {assignment}: expected KEY=VALUE, such as method.samples=512"
        raise StudyError(message)
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    except RecursionError:
        message = f"--set {cut(assignment, _WORD)}: lists or tables are nested too deeply"
        raise StudyError(message) from None
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


_APART = ["select", "invert", "synthesize"]  # kinds of studies whose files have other blocks
# What pydantic puts into the places of mistakes beside keys: the members of a union, in words of TOML.
_MEMBERS = {
    "str": "a text",
    "float": "a number",
    "int": "a whole number",
    "bool": "true or false",
    "tuple": "a list",
    "list": "a list",
    "dict": "a table",
}
_MEMBER = re.compile(rf"({'|'.join(_MEMBERS)})(\[.*\])?$")
_INNER = re.compile(
    r"\[key\]$|(function-|tagged-union|literal|constrained|lax-or|nullable|is-instance|model|chain|json)\S*\["
)


def lines(error: ValidationError, place: str = "") -> list[str]:
    """Say the mistakes of a block at a place: where, what was given, what was expected."""
    items = error.errors(include_url=False)
    members: dict[str, list[str]] = {}  # what would have been right, by where
    deeper = set[str]()
    for item in items:
        where, member, rest = _around_member(item["loc"], place)
        if member is not None:
            members.setdefault(where, []).append(member)
            deeper |= {where} if rest else set()
    found = []
    for item in items:
        where, member, rest = _around_member(item["loc"], place)
        if member is None or rest:
            found.append(_line(item, _place(item["loc"], place)))
        elif where not in deeper:
            words = list(dict.fromkeys(members[where]))
            found.append(f"{where}: expected {' or '.join(words)}; given {shown(item['input'])}")
    return list(dict.fromkeys(map(one_line, found)))


def _around_member(steps: Sequence[str | int], place: str) -> tuple[str, str | None, bool]:
    """Return where a union on the way to a mistake stands, the member that it is in, and whether it is inside that."""
    for i, step in enumerate(steps):
        match = _MEMBER.match(step) if isinstance(step, str) else None
        if match is not None:
            return _place(steps[:i], place), _MEMBERS[match[1]], i + 1 < len(steps)
    return _place(steps, place), None, False


def _place(steps: Sequence[str | int], place: str) -> str:
    for step in steps:
        if isinstance(step, int):
            place += f"[{step}]"
        elif (step not in _TAGS or place == "candidates") and not _INNER.match(step) and not _MEMBER.match(step):
            place += f".{cut(step, _WORD)}" if place else cut(step, _WORD)
    return place


def _line(item: Any, place: str) -> str:
    message, given = item["msg"], item["input"]
    if item["type"] in {"missing", "unknown_key"}:
        return f"{place}: {message}"
    if item["type"] == UNKNOWN_KIND and place == "method.kind" and "." not in given:
        message = f"unknown kind; {nearest(given, [*item['ctx']['known'], *_APART])}"
    message = f"{place}: {message[:1].lower()}{message[1:]}"
    if isinstance(given, Mapping) and not message.endswith(
        ("a table, { key = value }", "a word")
    ):  # a whole block, of which the message names the part
        return message
    return f"{message}; given {shown(given)}"


_WORD = 60  # letters of a key in a message


def _kinds() -> set[str]:
    """Return the kinds of blocks, which pydantic puts into the places of errors."""
    from typing import get_args

    from forward.bodies import geometry, inclusions
    from forward.observables import outputs

    unions = (geometry.Body, inclusions.Inclusion, outputs.Output, Distribution)
    members = [member for union in unions for member in get_args(get_args(union)[0])]
    return {member.model_fields["kind"].default for member in members}


_TAGS = _kinds() | {"sampling"}  # and the field of `Entry` whose keys stand in its own block
