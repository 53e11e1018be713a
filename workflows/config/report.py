"""What a study specifies for its report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from forward.settings import Settings


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


def located(blocks: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return the blocks of a study with the folder of its sections, which it names relative to its own."""
    block = blocks.get("report")
    if not isinstance(block, Mapping) or not isinstance(place := block.get("folder", ""), str):
        return dict(blocks)
    return {**blocks, "report": {**block, "folder": str((folder / place).resolve())}}
