"""What a study asks of its report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from forward.settings import Settings


class Report(Settings):
    """What the report shows beside what every report does. It changes no results.

    Parameters
    ----------
    sections
        Sections of one's own: dotted paths, such as "my_sections.Wear", to classes in modules beside the study.
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
    """Return the blocks of a study with the folder of its sections, which it names from where it stands itself."""
    block = blocks.get("report")
    if not isinstance(block, Mapping) or not isinstance(place := block.get("folder", ""), str):
        return dict(blocks)
    return {**blocks, "report": {**block, "folder": str((folder / place).resolve())}}
