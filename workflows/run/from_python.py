"""Studies that Python runs: `study.run()`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    import xarray as xr

    from workflows.studies.study import StudyKind


class FromPython:
    """What Python adds to a kind of study."""

    def run(self, directory: str | Path | None = None, *, quiet: bool = True, report: bool = False) -> xr.Dataset:
        """Run the study from Python, in memory or to a directory, as `workflows.run.run.results_of` does."""
        from workflows.run.run import results_of

        return results_of(cast("StudyKind", self), directory, quiet=quiet, report=report)
