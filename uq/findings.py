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


def findings(dataset: xr.Dataset) -> list[Finding]:
    """Return the findings that a dataset keeps, the most severe first."""
    return sorted(_kept(dataset), key=lambda one: SEVERITIES.index(one.severity))


def _kept(dataset: xr.Dataset) -> list[Finding]:
    return [Finding(**one) for one in json.loads(dataset.attrs.get("findings", "[]"))]
