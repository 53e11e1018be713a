"""Which files of data a study means: by names, folders and patterns."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from glob import iglob
from itertools import count
from pathlib import Path

from inverse.data.table import DataError

TABLES = (".csv", ".txt")
MESHES = (".vtu", ".vtp", ".vtk", ".xdmf", ".msh", ".inp", ".med", ".stl", ".ply")
SCANS = (".toml",)  # that say what files belong together


def files(patterns: Sequence[str], folders: Sequence[Path]) -> list[Path]:
    """Return the files given by names, folders (all data files in them) and patterns such as ``*.csv``.

    They are looked for in several folders, of which the first with a match counts. Missing files are included too, so
    that the others of a batch go on: they cannot be read. Raises `DataError` if none of them means anything.
    """
    found: dict[Path, bool] = {}
    missing = []
    for pattern in patterns:
        for folder in folders:
            path = folder / pattern
            if path.is_dir():
                children = sorted(path.iterdir())
                # What says that files belong together stands for them.
                here = [child for child in children if child.suffix in SCANS]
                here = here or [child for child in children if child.suffix in TABLES + MESHES]
            elif path.is_file():
                here = [path]
            else:
                here = [one for one in sorted(_matching(folder, pattern)) if one.is_file()]
            if here:
                found |= dict.fromkeys(here, True)
                break
        else:
            missing.append(f"{pattern}: no such file, expected a file, a folder of data files or a pattern")
            found |= {folders[0] / pattern: False}
    if not any(found.values()):
        raise DataError(*missing)
    return list(found)


def _matching(folder: Path, pattern: str) -> Iterator[Path]:
    """Find what a pattern means, in a folder where it does not say in full where."""
    if "\0" not in pattern and any(sign in pattern for sign in "*?["):
        # pathlib takes no pattern that begins with the root
        for found in iglob(pattern, root_dir=folder, recursive=True, include_hidden=True):  # noqa: PTH207
            yield folder / found


def distinct(paths: Sequence[Path]) -> list[str]:
    """Return a name for each of different files: without its ending; with it, and with folders, where two share one."""
    names = [path.stem for path in paths]
    ways = [path.relative_to(path.anchor).parts for path in paths]
    for depth in range(1, max(map(len, ways), default=0) + 1):
        shared = {name for name, times in Counter(names).items() if times > 1}
        names = ["-".join(way[-depth:]) if name in shared else name for way, name in zip(ways, names, strict=True)]
    for i, name in enumerate(names):  # a-b/c and a/b-c
        if name in names[:i]:
            names[i] = next(new for k in count(2) if (new := f"{name}-{k}") not in names)
    return names
