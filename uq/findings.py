"""What a study found out about the worth of its own numbers, kept with the results."""

from __future__ import annotations

import json
import re
from collections.abc import Collection
from typing import TYPE_CHECKING

from forward.model import Finding, Severity

if TYPE_CHECKING:
    import xarray as xr

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")  # the most severe first


def add(dataset: xr.Dataset, *found: Finding) -> None:
    """Keep findings in ``dataset.attrs["findings"]``, each once, after those that are there."""
    kept = list(dict.fromkeys([*_kept(dataset), *found]))
    if kept:
        dataset.attrs["findings"] = json.dumps([one._asdict() for one in kept], ensure_ascii=False)


def withdraw(dataset: xr.Dataset, names: Collection[str]) -> None:
    """Forget findings that speak of one of these outputs: "the expansion of NAME", "the 64 samples of NAME"."""
    about = re.compile(rf"\bof ({'|'.join(map(re.escape, names))})(?![\w.,])")
    dataset.attrs["findings"] = json.dumps(
        [one._asdict() for one in _kept(dataset) if not about.search(one.text)], ensure_ascii=False
    )


def once_for_steps(dataset: xr.Dataset) -> None:
    """Say once what findings say of one output at several steps of a path, in the words of the first of them."""
    places = {
        str(name): (str(of), int(step))
        for name, of, step in zip(*(dataset[key].values for key in ("output", "output_of", "step")), strict=True)
    }
    known = re.compile(rf"(?<![\w.])({'|'.join(map(re.escape, places))})(?!\d|\.\d)")
    groups: dict[tuple[str, ...], list[tuple[Finding, int]]] = {}
    for i, one in enumerate(_kept(dataset)):
        named = set(known.findall(one.text))
        of, step = places[named.pop()] if len(named) == 1 else ("", 0)
        said = re.sub(r"\d[\d.,e+-]*", "#", known.sub(of, one.text)) if of else str(i)
        groups.setdefault((one.severity, of, said), []).append((one, step))
    kept = []
    for (first, _), *others in groups.values():
        also = ", ".join(str(step) for _, step in others)
        text = f"{first.text} The same, with other numbers, at step{'s' * (len(others) > 1)} {also}."
        kept.append(first._replace(text=text) if others else first)
    if kept:
        dataset.attrs["findings"] = json.dumps([one._asdict() for one in kept], ensure_ascii=False)


def findings(dataset: xr.Dataset) -> list[Finding]:
    """Return the findings that a dataset keeps, the most severe first."""
    return sorted(_kept(dataset), key=lambda one: SEVERITIES.index(one.severity))


def _kept(dataset: xr.Dataset) -> list[Finding]:
    return [Finding(**one) for one in json.loads(dataset.attrs.get("findings", "[]"))]
