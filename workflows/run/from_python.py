"""Studies that Python runs: `study.run()`."""

from __future__ import annotations

import html
from pathlib import Path
from typing import TYPE_CHECKING, Any

from forward.settings import cut, shown
from workflows.config.study import document, dump

if TYPE_CHECKING:
    import xarray as xr


NAMED = 4  # parts of a block that are named


class FromPython:
    """What Python adds to a kind of study."""

    def __repr__(self: Any) -> str:
        """What it is in a few words, however long it is."""
        parts = (f"{name}: {_short(block)}" for name, block in document(self).items() if block)
        return f"{type(self).__name__}({'; '.join(parts)})"

    def _repr_html_(self: Any) -> str:
        """The same, with all that a study file would hold."""
        text = html.escape(dump(self))
        return f"<details><summary>{html.escape(repr(self))}</summary><pre>{text}</pre></details>"

    def run(
        self: Any, directory: str | Path | None = None, *, quiet: bool | None = None, report: bool = False
    ) -> xr.Dataset:
        """Run the study from Python, in memory or to a directory, as `workflows.run.run.results_of` does."""
        from workflows.run.run import results_of

        return results_of(self, directory, quiet=quiet, report=report)


def _short(block: Any) -> str:
    """Write the kind of a block, or the first of its names."""
    match block:
        case {"kind": str(kind)}:
            return kind
        case {**parts}:
            more = f" and {len(parts) - NAMED} others" if len(parts) > NAMED else ""
            return f"{', '.join(cut(str(name), 40) for name in [*parts][:NAMED])}{more}"
        case _:
            return shown(block)
