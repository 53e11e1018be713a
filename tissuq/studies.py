"""Studies from Python: read, run, read again."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from workflows.results.directory import read_dataset

if TYPE_CHECKING:
    import xarray as xr


def load(path: str | Path, changes: Sequence[str] = ()) -> Any:
    """Read a study from a TOML file.

    Parameters
    ----------
    path
        The file.
    changes
        Assignments such as "method.samples=512", as of ``--set``.

    Raises
    ------
    StudyError
        With every mistake in it.
    """
    from workflows.config.study import load as from_file

    return from_file(Path(path), changes)


def run(study: Any, directory: str | Path | None = None, *, quiet: bool = True, report: bool = False) -> xr.Dataset:
    """Run a study and return its results; under mpirun collective, and the results are those of the first rank.

    Parameters
    ----------
    study
        What `load` returns, or `tissuq.Study(...)`.
    directory
        Where results go; a study that was interrupted there is continued, one that is finished is read. By default
        nothing is left on disk.
    quiet
        Print no progress.
    report
        Write report.html too, where there is a directory.

    Returns
    -------
    xarray.Dataset
        results.nc, see docs/results.md; `findings` says what of it is doubtful. Empty on ranks other than the first.

    Raises
    ------
    StudyError, ModelError, SolveError, StopError
        As the command says them in one line.
    """
    from mpi4py import MPI

    from workflows.run.run import run as into

    if directory is not None:
        into(study, Path(directory).name, Path(directory), quiet=quiet, report=report)
        return _on_first_rank(Path(directory))
    world = MPI.COMM_WORLD
    with tempfile.TemporaryDirectory(prefix="tissuq-") as own:
        scratch = Path(world.bcast(own)) / "study"
        into(study, "study", scratch, quiet=quiet, report=False)
        found = _on_first_rank(scratch)
        world.barrier()  # the folder of the first rank goes with it
    return found


def read(directory: str | Path) -> xr.Dataset:
    """Read the results of a finished study.

    Raises
    ------
    FileNotFoundError
        If the directory holds none.
    """
    return read_dataset(Path(directory))


def _on_first_rank(directory: Path) -> xr.Dataset:
    import xarray as xr
    from mpi4py import MPI

    return read_dataset(directory) if MPI.COMM_WORLD.rank == 0 else xr.Dataset()
