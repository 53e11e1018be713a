"""What the program asks of a study of any kind, and the kinds there are."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

from forward.registry import Kinds, named
from forward.settings import Settings

if TYPE_CHECKING:
    import xarray as xr

    from forward.model import Finding
    from forward.spec import ModelSpec
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from uq.evaluation.evaluate import Evaluations
    from workflows.config.blocks import Parallel
    from workflows.config.report import Report
    from workflows.studies.job import Job

SAMPLING = "sampling"  # the kind of study whose methods solve at points
WITHOUT_EFFECT = {"parallel", "report"}  # blocks that results do not depend on


class StudyKind(Settings):
    """A study: what is computed, from what, and how.

    Attributes
    ----------
    stopped
        Why it ends, in words, where the results do not say it.
    explains
        Whether data are explained: then parameters without a model have no likelihood, which is an answer too.
    """

    stopped: ClassVar[str] = ""
    explains: ClassVar[bool] = True

    if TYPE_CHECKING:  # fields of every kind

        @property
        def method(self) -> Any:
            """What is computed and how: a block with a kind."""

        @property
        def parallel(self) -> Parallel:
            """Use of ranks."""

        @property
        def report(self) -> Report | None:
            """What the report shows beside what every report does."""

    @classmethod
    def made(cls, blocks: Mapping[str, Any], folder: Path) -> Self:
        """Check the blocks of a study of this kind, with the files beside it in a folder.

        Raises
        ------
        pydantic.ValidationError
            For mistakes in the blocks.
        StudyError
            For mistakes in the files.
        """
        return cls.model_validate(blocks)

    @property
    @abstractmethod
    def planned(self) -> int:
        """Number of evaluations that ranks share, and one."""

    @property
    def solves(self) -> int:
        """Number of solves, as the progress counts them."""
        return self.planned

    @property
    @abstractmethod
    def findings(self) -> tuple[Finding, ...]:
        """What is to be said of the study before anything is solved."""

    @property
    def specs(self) -> Sequence[ModelSpec]:
        """Models that are in memory at the same time."""
        return ()

    @property
    def modules(self) -> tuple[str, ...]:
        """Modules that a user has written for its models."""
        return ()

    @abstractmethod
    def plan(self, rank_groups: int) -> list[str]:
        """Say line by line what it is and what it will cost with so many groups of ranks."""

    @abstractmethod
    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> Job:
        """Make what the ranks work on; collective."""

    @abstractmethod
    def parameters_of(self, label: str) -> tuple[str, ...]:
        """Names of the parameters of evaluations, by the name that these are kept under."""

    def run(self, directory: str | Path | None = None, *, quiet: bool = True, report: bool = False) -> xr.Dataset:
        """Run the study from Python, in memory or to a directory, as `workflows.run.from_python.run` does."""
        found: xr.Dataset = named("workflows.run.from_python:run")(self, directory, quiet=quiet, report=report)
        return found

    def finished(self, dataset: xr.Dataset, evaluations: Mapping[str, Evaluations]) -> xr.Dataset:
        """Add to results what all evaluations say."""
        return dataset

    def summary(self, job: Job) -> dict[str, Any]:
        """Return what summary.json has of this kind alone."""
        return {}

    def identity(self) -> dict[str, Any]:
        """Return all that decides on evaluations, as a table."""
        blocks = self.model_dump(mode="json", exclude_none=True)
        return {key: value for key, value in blocks.items() if key not in WITHOUT_EFFECT}


STUDIES = Kinds(
    "study",
    {
        SAMPLING: "workflows.studies.sampling:Study",
        "select": "workflows.studies.selection:Comparison",
        "invert": "workflows.studies.inversion:InversionStudy",
        "synthesize": "workflows.studies.synthesis:Synthesis",
    },
    StudyKind,
)
