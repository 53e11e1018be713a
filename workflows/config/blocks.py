"""Blocks that studies of all kinds have."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, GetJsonSchemaHandler, TypeAdapter
from pydantic_core import CoreSchema

from forward.registry import OfKind
from forward.settings import Settings
from uq.evaluation.request import BLOCKS

BESIDE = "uncertain."  # before names, in draws, of numbers that were uncertain beside the parameters
KEPT = "draws.npz"  # beside study.toml: the draws as they were read
# A mesh that was refined, how it was, and how one was found that is fine enough for a tolerance.
MESHES = MESH, HISTORY, TOLERANCE = "mesh.npz", "mesh.json", "tolerance.json"
AVERAGED = "averaged"  # all candidates of a comparison, by their probabilities
STACKED = "stacked"  # all candidates, by the weights with which they predict left-out data best
ALL_CANDIDATES = AVERAGED, STACKED


class Correlation(Settings):
    """Correlation of two parameters in the Gaussian copula."""

    between: tuple[str, str]
    value: Annotated[float, Field(gt=-1, lt=1)]


class Parallel(Settings):
    """How ranks are used; results do not depend on it (except for rounding, if ranks share a model or blocks change).

    Parameters
    ----------
    ranks_per_model
        Ranks that share one model; the others work on other samples.
    blocks
        Largest number of blocks into which an evaluation is cut: more groups of ranks than this have nothing to do, and
        an interrupted block is started again.
    """

    ranks_per_model: Annotated[int, Field(ge=1)] = 1
    blocks: Annotated[int, Field(ge=1, le=1_000_000)] = BLOCKS


class Accuracy(Settings):
    """What is asked of errors beside those of sampling.

    Parameters
    ----------
    mesh_error
        Whether the error that the mesh makes is estimated of all that the study estimates, where the model is a body:
        at a few parameters, in elements of one degree more, for at most a fifth of the solves or three estimates.
    memory
        Memory (MiB) of a group of ranks that these estimates may take; where they would take more there are none, and
        a finding says so. With a tolerance, refined meshes take no more either.
    tolerance
        Largest error of mean and standard deviation of every output, relative to them, of mesh, sampling and solver
        together, at 95 %: in place of a number of samples. It is split between them, and the number of solves, the mesh
        and, without a block `[method]`, the method are chosen so that it is met at little cost
        (docs/how-to/accuracy.md).
    solves
        Most solves that a tolerance may take.
    """

    mesh_error: bool = True
    memory: Annotated[float, Field(gt=0)] = 4096.0
    tolerance: Annotated[float, Field(gt=0, lt=1)] | None = None
    solves: Annotated[int, Field(ge=16)] = 10_000


class Report(Settings):
    """What the report shows besides the usual sections. It does not change results.

    Parameters
    ----------
    sections
        Your own sections: dotted paths, such as "my_sections.Wear", to classes in modules beside the study.
    folder
        Where these modules are: the folder of the study, unless said otherwise.
    """

    sections: Annotated[tuple[Annotated[str, Field(pattern=r"^[^.\s]+(\.[^.\s]+)+$")], ...], Field(min_length=1)]
    folder: str = ""

    @property
    def modules(self) -> Iterator[str]:
        """The modules of the sections."""
        return (name.rpartition(".")[0] for name in self.sections)


@dataclass(frozen=True)
class _Given:
    """What stands in a study, and the type that it is of."""

    of: Any
    value: Any


def decided(blocks: Any, **types: Any) -> Any:
    """Return the blocks of a study in which some are of types that others decide on: fields with `AS_DECIDED`."""
    match blocks:
        case {**found}:
            return found | {name: _Given(of, found[name]) for name, of in types.items() if name in found}
        case _:
            return blocks


AS_DECIDED = BeforeValidator(
    lambda block: TypeAdapter(block.of).validate_python(block.value) if isinstance(block, _Given) else block
)


@dataclass(frozen=True)
class PartOrKind:
    """Annotation of a field for the JSON Schema: a block of one of these kinds, or a part of one."""

    whole: OfKind

    def __get_pydantic_json_schema__(self, core: CoreSchema, handler: GetJsonSchemaHandler) -> Any:
        """Any of the kinds; nothing is known of a part."""
        return {"anyOf": [self.whole.__get_pydantic_json_schema__(core, handler), {"type": "object"}]}


def located(report: Any, folder: Path) -> Any:
    """Return the block of the report with the folder of its sections, which it names relative to that of the study."""
    given = report.get("folder", "") if isinstance(report, dict) else None
    return {**report, "folder": str((folder / given).resolve())} if isinstance(given, str) else report
