"""What a study found out about the worth of its own numbers, kept with the results."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

from forward.model import Finding, Severity

if TYPE_CHECKING:
    import xarray as xr

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")  # the most severe first
NUMBER = r"−?\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?"
MANY = 3  # steps at which a list says the same
UNKNOWN = "mesh_unknown"  # attribute of results, see `keep_unknown`
NOT_KNOWN = "mesh not known"  # beside every error that is of sampling alone
DIGITS = 2  # of numbers whose error of the mesh was to be known, and is not


def add(dataset: xr.Dataset, *found: Finding, first: bool = False) -> None:
    """Keep findings in ``dataset.attrs["findings"]``, each once, after those that are there, or before them."""
    there = _kept(dataset)
    kept = list(dict.fromkeys([*found, *there] if first else [*there, *found]))
    if kept:
        dataset.attrs["findings"] = json.dumps([one._asdict() for one in kept], ensure_ascii=False)


def withdraw(dataset: xr.Dataset, names: Collection[str]) -> None:
    """Forget findings that speak of one of these outputs: "the expansion of NAME", "the 64 samples of NAME"."""
    about = re.compile(rf"\bof ({'|'.join(map(re.escape, names))})(?![\w.,])")
    dataset.attrs["findings"] = json.dumps(
        [one._asdict() for one in _kept(dataset) if not about.search(one.text)], ensure_ascii=False
    )


def once_for_steps(dataset: xr.Dataset) -> None:
    """Say once what findings say of one output at several steps of a path, in the words of the first of them.

    Of a list within a finding, what it says of an output at three steps or more becomes the largest, with the steps.
    """
    places = {
        str(name): (str(of), int(step))
        for name, of, step in zip(*(dataset[key].values for key in ("output", "output_of", "step")), strict=True)
    }
    known = re.compile(rf"(?<![\w.])({'|'.join(map(re.escape, places))})(?!\d|\.\d)")
    groups: dict[tuple[str, ...], list[tuple[Finding, int]]] = {}
    for i, long in enumerate(_kept(dataset)):
        one = long._replace(text=_shorter(long.text, known, places))
        named = set(known.findall(one.text))
        of, step = places[named.pop()] if len(named) == 1 else ("", 0)
        said = _alike(known.sub(of, one.text)) if of else str(i)
        groups.setdefault((one.severity, of, said), []).append((one, step))
    kept = []
    for (first, _), *others in groups.values():
        also = f" The same, with other numbers, at {_steps([step for _, step in others])}." if others else ""
        kept.append(first._replace(text=first.text + also))
    if kept:
        dataset.attrs["findings"] = json.dumps([one._asdict() for one in kept], ensure_ascii=False)


def once_for_outputs(texts: Sequence[str], names: Sequence[str]) -> list[str]:
    """Say once what texts say of several outputs, given by their names, in the words of the first of them."""
    known = re.compile(rf"(?<![\w.])({'|'.join(map(re.escape, names)) or '(?!)'})(?!\w|\.\w)")
    groups: dict[str, list[tuple[str, str]]] = {}
    for text in texts:
        of = set(known.findall(text))
        alike = _alike(known.sub("…", text)) if len(of) == 1 else text
        groups.setdefault(alike, []).append((text, "".join(of)))
    said = []
    for (first, _), *others in groups.values():
        also = f" The same, with other numbers, of {', '.join(name for _, name in others)}." if others else ""
        said.append(first + also)
    return said


def _shorter(text: str, known: re.Pattern[str], places: Mapping[str, tuple[str, int]]) -> str:
    """Shorten the lists of a text: "F.1 2%, F.2 5%, F.3 4%" to "F 5% (step 2, the largest of steps 1 to 3)"."""
    parts = re.split(r"(  |, |; |: |\. |\.$)", re.sub(rf" ({known.pattern}), (?={known.pattern})", r"  \1, ", text))
    entries: list[list[str]] = []  # each with what separates it from the next
    for piece, mark in zip(parts[::2], [*parts[1::2], ""], strict=True):
        if entries and known.match(entries[-1][0]) and entries[-1][1] == ", " and not known.match(piece):
            entries[-1] = [", ".join([entries[-1][0], piece]), mark]  # F.1 = 2 N, there 3 N; F.2 = …
        else:
            entries.append([piece, mark])
    alike: dict[tuple[str, str], list[int]] = {}
    for i, (piece, _) in enumerate(entries):
        if found := known.match(piece):
            alike.setdefault((places[found[1]][0], _alike(piece[found.end() :])), []).append(i)
    for (of, said), where in alike.items():
        if len(where) < MANY:
            continue
        rests = {i: known.sub("", entries[i][0], count=1) for i in where}
        steps = {i: places[known.findall(entries[i][0])[0]][1] for i in where}
        most = max(where, key=lambda i: float((re.findall(NUMBER, rests[i]) or ["0"])[0].strip("−").replace(",", "")))
        all_steps = _steps(list(steps.values()))
        largest = f"{of}{rests[most]} (step {steps[most]}, the largest of {all_steps})"
        entries[where[0]][0] = largest if "#" in said else f"{of} at {all_steps}{said}"
        for i in where[1:]:
            before = next(j for j in range(i - 1, -1, -1) if entries[j][0])
            if entries[i][1] not in (", ", "; "):
                entries[before][1] = entries[i][1]
            entries[i] = ["", ""]
    return "".join(piece + mark for piece, mark in entries).replace("  ", " ")


def _alike(text: str) -> str:
    """Leave numbers out of a text."""
    return re.sub(NUMBER, "#", text)


def _steps(steps: Collection[int]) -> str:
    """Name steps: "step 2", "steps 2, 10", "steps 2 to 5"."""
    first, *others = sorted(steps)
    if not others:
        return f"step {first}"
    if len(steps) >= MANY and others[-1] - first == len(others):
        return f"steps {first} to {others[-1]}"
    return f"steps {', '.join(map(str, [first, *others]))}"


def findings(dataset: xr.Dataset) -> list[Finding]:
    """Return the findings that a dataset keeps, the most severe first."""
    return sorted(_kept(dataset), key=lambda one: SEVERITIES.index(one.severity))


def keep_unknown(dataset: xr.Dataset, names: Collection[str], planned: Collection[str]) -> None:
    """Keep which outputs have a mesh whose error is not known, so that their errors are of sampling alone.

    Parameters
    ----------
    dataset
        The results.
    names
        These outputs.
    planned
        Outputs whose error of the mesh was to be estimated.
    """
    if names:
        dataset.attrs[UNKNOWN] = json.dumps({name: name in planned for name in names}, ensure_ascii=False)


def meshes_unknown(dataset: xr.Dataset) -> dict[str, bool]:
    """Return the outputs whose error of the mesh is not known, and whether its estimates have failed."""
    found: dict[str, bool] = json.loads(dataset.attrs.get(UNKNOWN, "{}"))
    return found


def _kept(dataset: xr.Dataset) -> list[Finding]:
    return [Finding(**one) for one in json.loads(dataset.attrs.get("findings", "[]"))]
