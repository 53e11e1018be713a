"""What the program asks of a study of any kind, and the list of kinds."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

from pydantic import Field, model_validator

from forward.fem.cost import REPORT, START, Times
from forward.finer_meshes import finer, graded
from forward.registry import Kinds
from forward.settings import Settings
from uq.accuracy.budget import SHARE
from workflows.config.blocks import AVERAGED, Parallel, Report
from workflows.config.mistakes import refused

if TYPE_CHECKING:
    import xarray as xr

    from forward.findings import Finding
    from forward.scalars import Mistake
    from forward.spec import ModelSpec
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from uq.inputs.random_parameters import Inputs
    from workflows.studies.job import Job

SAMPLING = "sampling"  # the kind of study whose methods solve at points
UNNAMED = (SAMPLING, AVERAGED)  # kinds that no file names: their methods do, and their parameters
WITHOUT_EFFECT = ("parallel", "report")  # blocks that results do not depend on
HOPELESS = 100  # times a textbook solve: what a failing solve may take, with its load steps
NONE_TO_SPARE = -1e9  # solves: for estimates without what calibrates them
PRODUCT = 0.12  # time of a product, of that of a solve by Newton's method from a state nearby
LOOKS = 4  # solves on finer meshes: at the mean of the prior, at the mode, and at the corrected one
FINER = "finer mesh"  # in names of models
NOT_ASKED = "not requested: no result will be called trusted"


class Sampled(NamedTuple):
    """A model with random parameters."""

    inputs: Inputs
    spec: ModelSpec


class StudyKind(Settings):
    """A study: what is computed, from what, and how.

    A kind of one's own is a subclass in a module beside the study or in an installed package (`forward.registry`); a
    file is of the kind that its `method.kind` names.
    """

    # The blocks that may stand in a file in place of `data`, which is read before the study is made.
    data_in_file: ClassVar[tuple[type[Settings], ...]] = ()
    stopped: ClassVar[str] = ""  # why it ends, in words, if the results do not say so
    # Whether it explains data: then parameters without a model have zero likelihood, which is a valid answer.
    explains: ClassVar[bool] = True

    parallel: Parallel = Field(default=Parallel(), description="Use of ranks.")
    report: Report | None = Field(default=None, description="Your own sections of the report.")

    def __eq__(self, other: object) -> bool:
        """Whether the same is asked of the same files."""
        return type(self) is type(other) and self.model_dump() == other.model_dump()

    __hash__ = Settings.__hash__

    if TYPE_CHECKING:  # a field of every kind

        @property
        def method(self) -> Any:
            """What is computed and how: a block with a kind."""

    @classmethod
    def made(cls, blocks: Mapping[str, Any], folder: Path) -> Self:
        """Check the blocks of a study of this kind, with the files beside it in a folder.

        Mistakes in the blocks are a ValidationError of pydantic, those in files a StudyError.
        """
        return cls.model_validate(blocks)

    @model_validator(mode="after")
    def _check(self) -> Self:
        refused(type(self).__name__, list(self.mistakes()))
        return self

    def mistakes(self) -> Iterator[Mistake]:
        """Find what is wrong with the blocks together, each of which is right by itself."""
        yield from ()

    def mistakes_of_ranks(self, spec: ModelSpec) -> Iterator[Mistake]:
        """Find that several ranks are asked to share a model that cannot be shared."""
        if self.parallel.ranks_per_model > 1 and not spec.shareable:
            message = f"a model of kind '{spec.kind}' is not shared by ranks, expected 1"
            yield ("parallel", "ranks_per_model"), message, self.parallel.ranks_per_model

    @property
    @abstractmethod
    def planned(self) -> int:
        """Number of evaluations that ranks share, plus one."""

    @property
    def recorded(self) -> bool:
        """Whether this is the record of a study that ran, without the contents of its data files."""
        return False

    @property
    def solves(self) -> int:
        """Number of solves, as counted for the progress."""
        return self.planned

    @property
    @abstractmethod
    def findings(self) -> tuple[Finding, ...]:
        """Findings about the study before anything is solved."""

    @property
    def specs(self) -> Sequence[ModelSpec]:
        """Models that are in memory at the same time."""
        return ()

    @property
    def memory(self) -> float:
        """Memory (bytes) of a group of ranks beside that of the program; 0 where there are no finite elements.

        A body that is sampled has a factor for its solutions and one for a reference, each load case of a specimen one.
        """
        return bytes_of(self.specs)

    @property
    def growth(self) -> tuple[float, str]:
        """Memory (bytes) of the largest mesh that the study may make, and what sets it; 0 where it makes none."""
        return max((spec.largest_bytes for spec in self.specs), default=0.0), "as many unknowns as model.adapt.unknowns"

    @property
    def modules(self) -> tuple[str, ...]:
        """Modules that a user has written for its models."""
        return tuple(dict.fromkeys(module for spec in self.specs for module in spec.modules))

    @abstractmethod
    def plan(self, rank_groups: int) -> list[str]:
        """Say line by line what the study is and what it will cost with so many groups of ranks."""

    def prepared(self, ensemble: Ensemble, directory: Path, say: Callable[[str], None]) -> Self:
        """Do once what all ranks need before there is a job, and return the study that is then run; collective."""
        return self

    @property
    def kept(self) -> Self:
        """The study that is run as results have it: files beside these have no folder."""
        return self

    @abstractmethod
    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> Job:
        """Make what the ranks work on; collective."""

    def arviz_groups(self, found: xr.Dataset) -> Mapping[str, xr.Dataset]:
        """Return the groups of results besides their own variables: those of ArviZ, where there is a posterior."""
        return {}

    @property
    def inputs(self) -> Inputs:
        """The random or unknown parameters, where the study has one model."""
        raise NotImplementedError

    def parameters_of(self, label: str) -> tuple[str, ...]:
        """Names of the parameters of evaluations, by the name under which these are stored."""
        return self.inputs.names

    def units_of(self, label: str) -> dict[str, str]:
        """SI units of numbers of the model of these evaluations, by their paths."""
        return {path: number.unit for spec in self.specs[:1] for path, number in spec.scalars.items()}

    @property
    def sampled(self) -> Sampled | None:
        """The one model of the study with its random parameters, if it has one: what a server answers for."""
        return None

    @property
    def beside(self) -> Mapping[str, bytes]:
        """Files that are kept beside study.toml, by name."""
        return {}

    def identity(self) -> dict[str, Any]:
        """Return everything that evaluations depend on, as a table."""
        blocks = self.model_dump(mode="json", exclude_none=True)
        return {key: value for key, value in blocks.items() if key not in WITHOUT_EFFECT}


def bytes_of(specs: Iterable[ModelSpec]) -> float:
    """Memory (bytes) of models that are in memory together; 0 where there are no finite elements."""
    return sum(cost.bytes for cost in (spec.cost() for spec in specs) if cost is not None)


def _objection(found: Any) -> str | None:
    """Say why something is no kind of study, or None if it is one."""
    made = isinstance(found, type) and issubclass(found, StudyKind)
    return None if made else f"expected a subclass of {StudyKind.__name__}"


STUDIES = Kinds(
    "study",
    {
        SAMPLING: "workflows.studies.sampling:Study",
        AVERAGED: "workflows.studies.averaged:AveragedStudy",
        "select": "workflows.studies.selection:Selection",
        "invert": "workflows.studies.inversion:Inversion",
        "synthesize": "workflows.studies.synthesis:Synthesis",
        "population": "workflows.studies.population:PopulationStudy",
        "design": "workflows.studies.design:DesignStudy",
        "reduce": "workflows.studies.reduction:ReductionStudy",
    },
    objection=_objection,
)


# --- what studies say before they run, and the finer meshes that they look at models on -----------------------------


def times_of(spec: ModelSpec) -> Times:
    """Return the predicted times of a model that has some."""
    found = spec.cost()
    assert found is not None
    return found


def estimates_paid(spec: ModelSpec, parameters: int, solves: int) -> float:
    """Predict how many estimates of the error of a mesh take a fifth of a study of so many solves."""
    cost, one = spec.cost(), spec.mesh_error_cost(NONE_TO_SPARE)
    if cost is None or one is None:
        return math.inf
    once = START + REPORT + cost.first + cost.reference_factor(parameters)
    return float((SHARE * (once + solves * cost.sample) - one.once) / (cost.sample + one.seconds))


def of_file(spec: ModelSpec) -> bool:
    """Whether the mesh of a model, if it has one, is that of a file."""
    return any(not one.body.structured for one in spec.bodies)


def never_estimable(spec: ModelSpec, names: Collection[str] | None = None) -> tuple[str, ...]:
    """Return those outputs of a body, of some by their names, of which no error of a mesh can be estimated."""
    outputs = spec.returned if spec.bodies else ()
    some = outputs if names is None else [one for one in outputs if one.name in names]
    return tuple(one.name for one in some if not getattr(one, "estimable", True))


def meshes_of(spec: ModelSpec) -> tuple[Any, ...]:
    """Return the bodies of a model on the finer meshes that they are looked at on, where these are known before a run.

    A ValueError says that there are none, or that they would be too large.
    """
    return tuple(mesh for one in spec.bodies if one.body.structured for mesh in _finer_ones(one) if mesh is not None)


@lru_cache(maxsize=1)
def _finer_ones(body: Any) -> tuple[Any, Any]:
    """Make the finer meshes of a body, which are asked for their memory, their growth and their work in turn."""
    return finer(body), graded(body)


def mesh_check(spec: ModelSpec) -> tuple[float, str]:
    """Predict the processor time (s) of solves on finer meshes, and say what is solved."""
    try:
        fine = meshes_of(spec)
    except ValueError as error:
        return 0.0, f"not possible: {error}; no result will be called trusted"
    unknowns, once = max((one.unknowns for one in fine), default=0), sum(times_of(one).textbook for one in fine)
    for one in spec.bodies:
        if not one.body.structured:  # divided in a run; a factor grows faster than the mesh
            unknowns, once = max(unknowns, 8 * one.unknowns), once + 8**2 * times_of(one).textbook
    longest = duration(HOPELESS * once)
    each = f"each about {duration(once)}; up to {longest} if it has no answer"
    return LOOKS * once, f"about {LOOKS} solves of {unknowns:,} displacements on finer meshes, {each}"


def duration(seconds: float) -> str:
    """Write a time for a prediction."""
    if seconds < 9.5:
        return f"{seconds:.2g} s"
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
