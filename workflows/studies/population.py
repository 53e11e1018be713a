"""A study of a population: what the posteriors of specimens say on specimens in general.

Nothing is solved, but for specimens whose draws do not reach the population (`workflows.studies.redrawn`).
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import model_validator

from forward.findings import Finding
from forward.registry import named
from inverse.methods.population import Columns, Population, Scale, prior_names
from uq.estimators.of_draws import findings_of_few
from uq.findings import once_for_outputs
from uq.inputs.draws import Draws
from workflows.config.blocks import Parallel
from workflows.config.mistakes import StudyError, refused
from workflows.config.report import Report
from workflows.studies.job import Job
from workflows.studies.posteriors import digest_of, specimens
from workflows.studies.study import StudyKind

if TYPE_CHECKING:
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble


class PopulationStudy(StudyKind):
    """From what, and how, the distribution over specimens is found.

    Parameters
    ----------
    method
        What is computed and how.
    parallel
        Use of ranks, by specimens that are drawn again.
    report
        Your own sections of the report.
    """

    stopped: ClassVar[str] = "a population"

    method: Population
    parallel: Parallel = Parallel()
    report: Report | None = None

    @cached_property
    def posteriors(self) -> dict[str, Draws]:
        """Draws of each specimen, by its name."""
        return specimens(self.method.source, self.method.model)

    @property
    def planned(self) -> int:
        """One evaluation: none is solved, unless specimens are drawn again."""
        return 1

    @property
    def solves(self) -> int:
        """There are none that could be counted before."""
        return 0

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Say which specimens are known by few draws."""
        every = self.posteriors if self._there else {}
        few = [found for name, draws in every.items() for found in findings_of_few(draws, name)]
        return tuple(once_for_outputs(few, every))

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
            "solves      none, but for specimens whose draws do not reach the population",
        ]

    def parameters_of(self, label: str) -> tuple[str, ...]:
        """Names of the parameters."""
        return prior_names(self.posteriors)

    @cached_property
    def modules(self) -> tuple[str, ...]:
        """Modules that a user has written for the models of the specimens."""
        found: tuple[str, ...] = named("workflows.studies.redrawn:modules")(self)
        return found

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> Job:
        """Fit on the first rank, and draw specimens again on all of them where that is needed."""
        made: Job = named("workflows.studies.redrawn:PopulationJob")(self, name, directory)
        return made

    def units_of(self, label: str) -> dict[str, str]:
        """SI units of the parameters, as the study of the specimens has them."""
        found: dict[str, str] = named("workflows.studies.redrawn:units")(self)
        return found

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
            found = digest_of(self.method.source)
        except (ValueError, StudyError) as error:
            refused("Population", [(place, str(error), self.method.source)])
            raise
        if self.method.study is not None and not Path(self.method.study).is_file():
            message = "is not there, expected the file of the study that the source is of"
            refused("Population", [(("method", "study"), message, self.method.study)])
        if digest and found != digest:
            message = f"has changed since the study was begun: hash {digest} → {found}"
            refused("Population", [(place, message, self.method.source)])
        object.__setattr__(self.method, "digest", found)
        return self
