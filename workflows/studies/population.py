"""A study of a population: what the posteriors of specimens say on specimens in general. Nothing is solved."""

from __future__ import annotations

from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import model_validator

from forward.model import Finding
from inverse.methods.population import Columns, Population, Scale, prior_names
from uq.estimators.of_draws import findings_of_few
from uq.inputs.draws import Draws
from workflows.config.blocks import Parallel
from workflows.config.mistakes import StudyError, refused
from workflows.config.report import Report
from workflows.studies.job import Job, TasksJob
from workflows.studies.posteriors import LETTERS, prior_of, specimens
from workflows.studies.study import StudyKind

if TYPE_CHECKING:
    import xarray as xr

    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble


class PopulationStudy(StudyKind):
    """From what, and how, the distribution over specimens is found.

    Parameters
    ----------
    method
        What is computed and how.
    parallel
        Use of ranks: it takes one.
    report
        Your own sections of the report.
    """

    stopped: ClassVar[str] = "a population"
    explains: ClassVar[bool] = False

    method: Population
    parallel: Parallel = Parallel()
    report: Report | None = None

    @cached_property
    def posteriors(self) -> dict[str, Draws]:
        """Draws of each specimen, by its name."""
        return specimens(self.method.source, self.method.model)

    @property
    def planned(self) -> int:
        """One evaluation: none is solved."""
        return 1

    @property
    def solves(self) -> int:
        """There are none."""
        return 0

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Say which specimens are known by few draws."""
        every = self.posteriors.items() if self._there else ()
        return tuple(found for name, draws in every for found in findings_of_few(draws, f" of {name}"))

    @property
    def _there(self) -> bool:
        return Path(self.method.source).exists()

    def plan(self, rank_groups: int) -> list[str]:
        """Say what is taken from where."""
        names = prior_names(self.posteriors)
        return [
            f"method      {self.method.kind}, {self.method.distribution}",
            f"source      {self.method.source}",
            f"specimens   {', '.join(self.posteriors)}",
            f"parameters  {', '.join(names)}",
            "solves      none",
        ]

    def parameters_of(self, label: str) -> tuple[str, ...]:
        """Names of the parameters."""
        return prior_names(self.posteriors)

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> Job:
        """Fit on the first rank, at once."""

        def results(_: Any) -> xr.Dataset:
            names = prior_names(self.posteriors)
            return self.method.run(self.posteriors, prior_of(self.method.source, self.method.model, names))

        return TasksJob((), _nothing, _nothing, _nothing, results, lambda found: found)

    def summary(self, job: Job) -> dict[str, Any]:
        """There is more in results.nc."""
        return {"specimens": list(self.posteriors)}

    @model_validator(mode="after")
    def _check(self) -> PopulationStudy:
        place, source, digest = ("method", "source"), Path(self.method.source), self.method.digest
        if digest and not source.exists():  # results, which are looked at
            return self
        try:
            posteriors = self.posteriors
            Scale.of(self.method.distribution, posteriors)
            Columns.of(self.method.covariates, list(posteriors)).row(self.method.new)
            found = sha256((source / "results.nc").read_bytes()).hexdigest()[:LETTERS]
        except (ValueError, StudyError) as error:
            refused("Population", [(place, str(error), self.method.source)])
            raise
        if digest and found != digest:
            message = f"has changed since the study was begun: hash {digest} → {found}"
            refused("Population", [(place, message, self.method.source)])
        object.__setattr__(self.method, "digest", found)
        return self


def _nothing(*_: Any) -> Any:
    """Do nothing: there are no tasks."""
