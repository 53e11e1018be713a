"""Starter studies: what `tissuq init` prints, from the files in `starters`."""

from __future__ import annotations

from pathlib import Path

from forward.settings import nearest
from workflows.config.mistakes import StudyError

FOLDER = Path(__file__).parent / "starters"
HEADS = {"select": "tests", "invert": "specimen", "synthesize": "specimen"}  # what comes before the method; else a body
KINDS = tuple(sorted(path.stem for path in (FOLDER / "methods").glob("*.toml")))


def starter(kind: str) -> str:
    """Return a commented study of a kind of method that runs as it is; for "list", the names of all kinds, one a line.

    A StudyError says that there is no such kind.
    """
    if kind == "list":
        return "".join(f"{name}\n" for name in KINDS)
    if kind not in KINDS:
        raise StudyError(f"init {kind}: unknown kind of study; {nearest(kind, KINDS)}")
    head, method = (FOLDER / name for name in (f"heads/{HEADS.get(kind, 'body')}.toml", f"methods/{kind}.toml"))
    text = head.read_text(encoding="utf-8")
    if kind == "reduce":  # a reduced model has no pressures among its unknowns
        text = text.replace(
            '# formulation = "mixed"  # or "displacement";', 'formulation = "displacement"  # not "mixed";'
        )
    return text + method.read_text(encoding="utf-8")
