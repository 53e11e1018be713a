"""A hyperelastic body in words: what was solved, for people to read."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING

from forward.materials.material import constants, energy_of
from forward.readable import listed, named, settings

if TYPE_CHECKING:
    from forward.bodies.inclusions import Inclusion
    from forward.bodies.random_fields import RandomField
    from forward.loaded import LoadedBody


def in_words(model: LoadedBody, said: Callable[[str], str], where: str) -> Iterator[tuple[str, list[str]]]:
    """Describe a body, its material, supports and loads; arguments as in `ModelSpec.words`."""
    body = model.body
    yield "body", [f"{body.description}; {body.cells_in_words} cells ({body.cell}, degree {body.degree}){where}"]
    pressures = " and pressures (mixed form)" if model.mixed else ""
    yield "unknowns", [f"{model.unknowns:,} displacements{pressures}{where}"]
    numbers = [f"{name} = {said(f'material.{name}')}" for name in constants(model.energy)]
    fibres = [f"fibres along {' and '.join(map(listed, model.fibres))}"] if model.fibres else []
    law = str(energy_of(model.energy).__doc__).partition("\n")[0]
    small = ["small strains: its moduli at rest"] if model.strains == "small" else []
    yield "material", [law, ", ".join(numbers), *fibres, *small]
    if model.regions:
        yield "regions", [_region(region, changed, said) for region, changed in model.regions.items()]
    if model.inclusions:
        yield "inclusions", [_inclusion(inclusion, said) for inclusion in model.inclusions]
    if model.fields:
        yield "random fields", [_field(field) for field in model.fields]
    held = [f"{boundary} clamped" for boundary in model.clamp] + [
        f"{item.on}: u{axis} = {said(f'displacements.{item.label}.{axis}')}"
        for item in model.displacements
        for axis in item.components
    ]
    yield "held", held
    loads = [load.words({name: said(f"loads.{load.label}.{name}") for name in load.scalars}) for load in model.loads]
    yield "loads", loads or ["none"]
    outputs = []
    for output in model.outputs:
        block = output.model_dump()
        details = settings(block, "kind", "name")
        outputs.append(named(f"{output.name}: {block['kind']}{', ' if details else ''}{details}", output.unit))
    yield "outputs", outputs


def _region(region: str, changed: Iterable[str], said: Callable[[str], str]) -> str:
    numbers = [f"{name} = {said(f'regions.{region}.{name}')}" for name in changed]
    return f"{region}: {', '.join(numbers)}"


def _inclusion(inclusion: Inclusion, said: Callable[[str], str]) -> str:
    numbers = [
        f"{name} = {said(f'inclusions.{inclusion.label}.{name}')}"
        for name in type(inclusion).model_fields
        if name not in {"kind", "name"}
    ]
    label = f"{inclusion.name} ({inclusion.kind})" if inclusion.name else inclusion.kind
    return f"{label}: {', '.join(numbers)}"


def _field(field: RandomField) -> str:
    made_of = {
        "modes": f"{field.modes} Karhunen–Loève modes",
        "noise": "white noise",
        "nodes": "values at the vertices",
    }
    return (
        f"{field.label}: log-normal factor on the {field.of} with mean {field.mean:g} and standard deviation "
        f"{field.std:g}, Matérn correlation of length {field.length:g} m (ν = {field.smoothness - 1.5:g}), "
        f"from {made_of[field.basis]}"
    )
