"""A run from Python: in memory, or to a directory, and the results as a dataset."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from workflows.results.directory import read_dataset
from workflows.run.run import run as into

if TYPE_CHECKING:
    import xarray as xr

    from workflows.studies.study import StudyKind


def run(
    study: StudyKind, directory: str | Path | None = None, *, quiet: bool = True, report: bool = False
) -> xr.Dataset:
    """Run a study and return its results; under mpirun collective, and the results are those of the first rank.

    Parameters
    ----------
    study
        What `load` returns, or `tissuq.Study(...)`.
    directory
        Where results go; an interrupted study there is continued, a finished one is read. By default nothing is written
        to disk.
    quiet
        Print no progress.
    report
        Write report.html too, if there is a directory.

    Returns
    -------
    xarray.Dataset
        results.nc, see docs/results.md; `findings` says what is doubtful about it. Empty on ranks other than the first.

    Raises
    ------
    StudyError, ModelError, SolveError, StopError
        Those that the command reports in one line.
    """
    from mpi4py import MPI

    if directory is not None:
        into(study, Path(directory).name, Path(directory), quiet=quiet, silent=quiet, report=report)
        return _on_first_rank(Path(directory))
    world = MPI.COMM_WORLD
    with tempfile.TemporaryDirectory(prefix="tissuq-") as own:
        scratch = Path(world.bcast(own)) / "study"
        into(study, "study", scratch, quiet=quiet, silent=quiet, report=False)
        found = _on_first_rank(scratch)
        world.barrier()  # the folder of the first rank goes with it
    return found


def _on_first_rank(directory: Path) -> xr.Dataset:
    import xarray as xr
    from mpi4py import MPI

    return read_dataset(directory) if MPI.COMM_WORLD.rank == 0 else xr.Dataset()
