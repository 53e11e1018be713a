"""The published beam on meshes of several sizes."""

from __future__ import annotations

from pathlib import Path

from workflows.config.study import load
from workflows.studies.sampling import Study

CONFIG = Path(__file__).parent.parent / "configs" / "beam.toml"


def beam(cells: tuple[int, int, int], *changes: str) -> Study:
    """Return the study of the published beam on a mesh of P2 hexahedra."""
    return load(CONFIG, [f"model.body.cells={list(cells)}", *changes])


def field_beam(cells: tuple[int, int, int], *changes: str) -> Study:
    """Return the study of the beam with a random stiffness field on a mesh of P2 hexahedra."""
    return load(CONFIG.with_name("beam-field.toml"), [f"model.body.cells={list(cells)}", *changes])
