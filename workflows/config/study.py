"""Studies from files and back: reading, overriding, writing, comparing."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Union

from pydantic import TypeAdapter, ValidationError

from forward.registry import dotted
from forward.settings import cut
from uq.methods.method import METHODS
from workflows.config.blocks import ALL_CANDIDATES, AVERAGED, KEPT, located
from workflows.config.mistakes import StudyError, lines
from workflows.config.one_model import Sourced
from workflows.config.tables import EACH, at, changed, deeper_than, leaves
from workflows.studies.study import SAMPLING, STUDIES, UNNAMED, WITHOUT_EFFECT, StudyKind

_REFERENCE = "#/$defs/{model}"  # where a JSON Schema has its blocks
DEEPEST = 32  # levels of lists and tables in a study
LARGEST, LARGEST_INTEGER = 1e60, 2**63 - 1  # numbers of a study, and the smallest is one over the first
MOST_LINES = 50
REDUCED = "reduced"  # the kind of a model that is a file
_OPTIONS = "model.config"  # of another program's model, of which nothing is known
# A part of a dotted key: in quotes, or without dots.
QUOTED = re.compile(r"""(?:^|\.)(?:"([^"]*)"|'([^']*)'|([^."']+))""")
# Files that count by their contents, not their path.
_FILES = {
    "model.body.contents.digest": "model.body.file",
    "model.digest": "model.file",
    "method.reduced.digest": "method.reduced.file",
    "parameters.from.digest": "parameters.from.file",
}


def parse(document: Mapping[str, Any], overrides: Sequence[str] = (), folder: Path = Path()) -> StudyKind:
    """Check a document and make a study of it.

    Parameters
    ----------
    document
        The blocks of the study, as read from TOML.
    overrides
        Assignments such as ``method.samples=512``, applied last; values are TOML, or else plain text.
    folder
        Where the data tables, meshes and modules that it names are.

    Raises
    ------
    StudyError
        With every mistake found.
    ModelError
        If a kind or a function is in a module that exists twice.
    """
    blocks = dict(document)
    for assignment in overrides:
        _override(blocks, assignment)
    if deeper_than(blocks, DEEPEST):
        raise StudyError(f"lists and tables are nested too deeply, expected at most {DEEPEST} levels")
    beyond = [f"{place}: {why}" for place, value in leaves(blocks) for why in _beyond(place, value)]
    if beyond:
        raise StudyError(*beyond[:MOST_LINES])
    _visible(dotted(blocks), folder, "kind")
    try:
        blocks = _located(blocks, folder)
        kind, drawn_from = str(at(blocks, "method", "kind")), at(blocks, "parameters", "from", "model")
        usual = AVERAGED if drawn_from in ALL_CANDIDATES else SAMPLING
        another = kind not in METHODS.own and kind in STUDIES
        found: StudyKind = STUDIES[kind if another else usual].made(blocks, folder)
    except ValidationError as error:
        apart = [kind for kind in STUDIES.own if kind not in UNNAMED]
        raise StudyError(*lines(error, apart=apart)) from None
    _visible(found.modules, folder, "model.function")
    return found


def _visible(modules: Iterable[str], folder: Path, place: str) -> None:
    """Let modules be found beside the study and in the working directory, after all others."""
    names = list(dict.fromkeys(modules))
    if names:
        from forward.external.own_modules import make_visible

        make_visible(names, [folder.resolve(), Path.cwd()], place)


def _beyond(place: str, value: Any) -> Iterator[str]:
    """Say of a number, or of those in a list, that it cannot be calculated with: its square may be none."""
    if place.startswith(_OPTIONS):
        return
    match value:
        case [*items]:
            for item in items:
                yield from _beyond(place, item)
        case int() if abs(value) > LARGEST_INTEGER:
            yield f"an integer of {value.bit_length()} bits, expected at most 63"
        case float() if 0 < abs(value) < math.inf and not 1 / LARGEST <= abs(value) <= LARGEST:
            size = "large" if abs(value) > 1 else "small"
            yield f"{value:g} is too {size}, expected 0 or {1 / LARGEST:g} to {LARGEST:g}"


def _located(blocks: Any, folder: Path) -> dict[str, Any]:
    """Give the full paths of a mesh, a reduced model, draws, another study and its results, and own sections.

    They are in the study's folder; what is not a mesh, nor sections, may be in the working directory too.
    """

    def beside(file: Any) -> Any:
        """A file beside a study or in the working directory, or each of several by name."""
        match file:
            case str():
                place = next((path for path in (folder / file, Path(file)) if path.exists()), folder / file)
                return str(place.resolve())
            case {**files}:
                return {name: beside(one) for name, one in files.items()}
            case _:
                return file

    def in_block(given: Any) -> Any:
        return {"file": given} if isinstance(given, str) else given

    def of_draws(block: Any) -> Any:
        """In the directory of results that were begun with them, draws are kept."""
        kept = at(block, "digest") and (folder / KEPT).exists()
        return changed(block, ("file",), lambda file: str((folder / KEPT).resolve()) if kept else beside(file))

    def of_model(model: Any) -> Any:
        if at(model, "kind") == REDUCED:
            return changed(model, ("file",), beside)
        mesh = ("body", "file")
        return changed(model, mesh, lambda file: str((folder / file).resolve()) if isinstance(file, str) else file)

    for way, change in (
        (("report",), lambda block: located(block, folder)),
        (("method", "source"), beside),
        (("method", "study"), beside),
        (("method", "reduced"), in_block),
        (("method", "reduced", "file"), beside),
        (("parameters", "from"), in_block),
        (("parameters", "from"), of_draws),
        (("method", "cheap", EACH), of_model),
        (("method", "cheap", EACH, "model"), of_model),
        (("model",), of_model),
    ):
        blocks = changed(blocks, way, change)
    return dict(blocks)


def load(path: Path, overrides: Sequence[str] = ()) -> StudyKind:
    """Read a study from a TOML file; overrides and errors as in `parse`."""
    return parse(_document(path), overrides, path.parent)


def kind_of(path: Path) -> str:
    """Return the kind of the method of a study in a TOML file; empty without one."""
    return str(at(_document(path), "method", "kind") or "")


def _document(path: Path) -> dict[str, Any]:
    """Read the blocks of a TOML file."""
    try:
        # Editors on Windows begin files with a byte order mark.
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except RecursionError:
        raise StudyError(f"{path}: lists or tables are nested too deeply") from None
    except tomllib.TOMLDecodeError as error:
        raise StudyError(f"{path}: not valid TOML: {error}") from None
    except UnicodeDecodeError:
        raise StudyError(f"{path}: not a text file in UTF-8") from None
    except ValueError:  # of tomllib, or of a name that is no name
        message = f"{path}: cannot be read: a number of thousands of digits, or a name with a null character"
        raise StudyError(message) from None
    except OSError as error:
        raise StudyError(f"{path}: cannot be read: {error.strerror}") from None


def schema() -> dict[str, Any]:
    """Return the JSON Schema of a study file, with which editors complete and check it."""
    forms = [STUDIES[kind] for kind in STUDIES.names if kind != AVERAGED]
    any_form: Any = Union[*forms]
    found = TypeAdapter(any_form).json_schema(ref_template=_REFERENCE)
    for form in forms:  # a file may name a table instead of containing the data
        for of_file in form.data_in_file:
            table, name = TypeAdapter(of_file).json_schema(ref_template=_REFERENCE), of_file.__name__
            found["$defs"] |= table.pop("$defs", {}) | {name: table}
            data = found["$defs"][form.__name__]["properties"]
            data["data"] = {"anyOf": [data["data"], {"$ref": _REFERENCE.format(model=name)}]}
    for form in forms:  # draws stand among the parameters that they are of
        if issubclass(form, Sourced):
            properties = found["$defs"][form.__name__]["properties"]
            source = properties.pop("source")
            properties["parameters"] |= {"properties": {"from": {"anyOf": [{"type": "string"}, source]}}}
    # A tolerance for all errors stands in place of a method.
    sampled = found["$defs"][STUDIES[SAMPLING].__name__]
    sampled["required"].remove("method")
    tolerance = {"properties": {"accuracy": {"required": ["tolerance"]}}, "required": ["accuracy"]}
    sampled["anyOf"] = [{"required": ["method"]}, tolerance]
    # Nothing is known about the blocks of a kind of study that is a dotted path.
    dots = {"type": "object", "properties": {"kind": {"type": "string", "pattern": r"\."}}, "required": ["kind"]}
    known = sorted(STUDIES[SAMPLING].model_fields)
    other = {"properties": {"method": dots}, "required": ["method"], "not": {"propertyNames": {"enum": known}}}
    found["anyOf"].append({"type": "object", **other})
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "A study of tissuq"} | found


def document(study: StudyKind) -> dict[str, Any]:
    """Return the blocks of a study, complete with defaults: `parse(document(study)) == study`."""
    blocks = study.model_dump(mode="json", exclude_none=True)
    return dict(sorted(blocks.items(), key=lambda item: item[0] in WITHOUT_EFFECT))


def dump(study: StudyKind) -> str:
    """Write a study as TOML, complete with defaults."""
    import tomli_w

    return tomli_w.dumps(document(study))


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """List what changed between two documents, one line for each place.

    Blocks on which results do not depend do not count, nor empty lists, nor the path of a mesh, as long as the mesh is
    the same.
    """
    both = [leaves({key: block for key, block in one.items() if key not in WITHOUT_EFFECT}) for one in (old, new)]
    before, after = ({place: value for place, value in found if value != []} for found in both)
    for digest, file in _FILES.items():
        for place in [one for one in before if one == digest or one.startswith(f"{digest}.")]:
            if before[place] == after.get(place):
                own = file + place.removeprefix(digest)  # of one file, or of one of several
                after |= {own: before[own]}
    places = [*before, *(place for place in after if place not in before)]
    return [
        f"{place}: {before.get(place, 'absent')} → {after.get(place, 'absent')}"
        for place in places
        if before.get(place) != after.get(place)
    ]


def _override(blocks: dict[str, Any], assignment: str) -> None:
    key, equals, text = assignment.partition("=")
    if not equals or not key.strip():
        raise StudyError(f"--set {assignment}: expected KEY=VALUE, such as method.samples=512")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    except ValueError:
        raise StudyError(f"--set {cut(assignment, 60)}: a number of thousands of digits") from None
    except RecursionError:
        raise StudyError(f"--set {cut(assignment, 60)}: lists or tables are nested too deeply") from None
    here: Any = blocks
    *way, last = _path(key.strip(), blocks)
    for step in way:
        if isinstance(here, list):
            here = _named(here, step, key)
            continue
        inner = here.get(step, {})
        if not isinstance(inner, dict | list):
            raise StudyError(f"--set {key}: '{step}' is a value, not a block")
        here[step] = inner.copy()
        here = here[step]
    if isinstance(here, list):
        raise StudyError(f"--set {key}: expected the name of an element and one of its keys")
    here[last] = value


def _path(key: str, blocks: Mapping[str, Any]) -> list[str]:
    """Split a dotted key; those of `parameters` hold dots themselves, and what is in quotes is one key, as in TOML."""
    parts = [quoted or single or bare for quoted, single, bare in QUOTED.findall(key)]
    if len(parts) > 1 and re.search(r"""["']""", key):
        return parts
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
            items[i] = found = item.copy()
            return found
    raise StudyError(f"--set {key}: no element is called '{name}'")
