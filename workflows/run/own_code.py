"""What is written down of a Python model's modules beside its results, so that results of two versions never mix."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from forward.external.models import PythonModel
from forward.external.own_modules import Loaded, Sources, other_code
from workflows.config.study import Study, StudyError
from workflows.results.directory import write_text

if TYPE_CHECKING:
    from workflows.config.study import AnyStudy

FILE = "sources.json"


def python(study: AnyStudy) -> PythonModel | None:
    """Return the model of a study if it is a Python function."""
    return study.model if isinstance(study, Study) and isinstance(study.model, PythonModel) else None


def digest(study: AnyStudy) -> str | None:
    """Return a hash of the modules of a Python model."""
    model = python(study)
    return None if model is None else model.sources.digest


def refuse_other(directory: Path, study: AnyStudy) -> None:
    """Compare the modules of a Python model with those that the results in a directory follow from.

    Raises
    ------
    StudyError
        If one has changed; the message names it.
    """
    model, before = python(study), _kept(directory)
    if model is None or before is None:
        return
    if not (directory / "summary.json").exists() and not any(directory.glob("evaluations/*.h5")):
        (directory / FILE).unlink()  # nothing was computed yet
        return
    change = before.change(model.sources)
    if change is not None:
        message = f"{directory}: {other_code(change)}"
        raise StudyError(message)


def keep(directory: Path, study: AnyStudy, loaded: Loaded | None) -> None:
    """Write down the modules of a Python model, with those that were loaded in the course of a run."""
    model = python(study)
    if model is not None and loaded is not None:
        found = (_kept(directory) or model.sources).with_files(loaded())
        write_text(directory / FILE, json.dumps(found.document(), indent=2, ensure_ascii=False) + "\n")


def _kept(directory: Path) -> Sources | None:
    try:
        return Sources.of(json.loads((directory / FILE).read_text(encoding="utf-8")))
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError, AttributeError):
        message = f"{directory / FILE}: damaged: what code is behind the results is not known; choose another --out"
        raise StudyError(message) from None
