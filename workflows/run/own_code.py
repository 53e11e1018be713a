"""The record of a user's modules beside the results, so that results of two versions never mix."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from forward.external.own_modules import Loaded, Sources, other_code, search, sources
from forward.machine import write_text
from forward.registry import dotted, installed
from workflows.config.mistakes import StudyError
from workflows.config.study import document
from workflows.run.version import version

if TYPE_CHECKING:
    from workflows.studies.study import StudyKind

FILE = "sources.json"


def modules(study: StudyKind) -> tuple[str, ...]:
    """Return the user's modules that a study names: those of its model, and of kinds from outside the program."""
    return tuple(dict.fromkeys([*study.modules, *_of_kinds(study)]))


def _of_kinds(study: StudyKind) -> list[str]:
    """Modules of kinds: dotted paths, and those that installed packages declare."""
    blocks = document(study)
    return list(dict.fromkeys([*dotted(blocks), *installed(blocks)]))


def _sources(study: StudyKind) -> Sources:
    return sources(study.modules, _of_kinds(study))


def digest(study: StudyKind) -> str | None:
    """Return a hash of these modules and of what they import, if there are any."""
    return _sources(study).digest if modules(study) else None


def identity(study: StudyKind) -> str:
    """Return everything that evaluations depend on: the study, the source of these modules, and the version."""
    source = digest(study)
    return json.dumps([study.identity() | ({} if source is None else {"source": source}), version()])


def refuse_other(directory: Path, study: StudyKind) -> None:
    """Compare the user's modules with those of the results in a directory; a StudyError names one that has changed."""
    before = _kept(directory)
    if before is None or not modules(study):
        return
    if not (directory / "summary.json").exists() and not any(directory.glob("evaluations/*.block")):
        (directory / FILE).unlink(missing_ok=True)  # nothing was computed yet
        return
    change = before.change(_sources(study))
    if change is not None:
        raise StudyError(f"{directory}: {other_code(change)}")


def keep(directory: Path, study: StudyKind, loaded: Loaded | None) -> None:
    """Record the user's modules, with those that were loaded during a run."""
    if loaded is not None and modules(study):
        known = _kept(directory) or _sources(study)
        known = replace(known, files=loaded() | known.files)
        write_text(directory / FILE, json.dumps(asdict(known), indent=2, ensure_ascii=False) + "\n")


def make_visible(directory: Path) -> None:
    """Let Python find the modules behind the results in a directory, where they were when these were computed."""
    known = _kept(directory)
    if known is not None:
        search(folder for folder in known.folders if folder.is_dir())


def listed(study: StudyKind) -> list[str]:
    """Say which kinds of a study are the user's own, and where they come from."""
    names = _of_kinds(study)
    if not names:
        return []
    files = sources((), names).files
    code = [f"{name} ({path})" for name, (path, _) in files.items()]
    return [f"own code    {', '.join([*code, *(name for name in names if name not in files)])}"]


def _kept(directory: Path) -> Sources | None:
    try:
        return Sources.of(json.loads((directory / FILE).read_text(encoding="utf-8")))
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError, AttributeError):
        message = f"{directory / FILE}: damaged: the code behind the results is unknown; choose another --out"
        raise StudyError(message) from None
