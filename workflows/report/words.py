"""Studies in words, for reports."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from forward.bodies.inclusions import Inclusion
from forward.bodies.random_fields import RandomField
from forward.hyperelastic import Hyperelastic
from forward.materials.material import MATERIALS, constants, energy_of, units
from forward.observables.observable import Observable
from forward.terms.term import Term
from forward.words import listed, number, settings, with_unit
from workflows.studies.sampling import Study


def stability(counts: dict[str, int]) -> str:
    """Say how the stability of the states of a study was looked at, from `stability` in summary.json."""
    refused = counts["refused"] + counts["missed"]
    parts = [
        f"{counts['counted']:,} by counting negative eigenvalues",
        f"{counts['screened']:,} by the screen alone",
        *([f"{counts['not_tested']:,} not at all"] if counts["not_tested"] else []),
        *([f"{refused:,} refused as unstable"] if refused else []),
    ]
    return f"stability of the states: {', '.join(parts)}"


def solves(summary: Mapping[str, Any]) -> int:
    """Return the number of solves; a data set of several that are inverted side by side is one evaluation of many."""
    return int(max(summary["evaluations"], summary.get("solves", 0)))


def counted(solves: int) -> str:
    """Write a number of solves."""
    return "1 solve" if solves == 1 else f"{solves:,} solves"


def unit_of(path: str) -> str:
    """SI unit of a number of the model, by its path; "1" for ratios and for models of other programs."""
    block, _, name = path.partition(".")
    if block == "material":
        # A name has the same unit in every material.
        return next((of[name] for of in map(units, MATERIALS) if name in of), "1")
    if block == "inclusions":
        return {"contrast": "1", "volume": "m³", "turn_x": "rad", "turn_y": "rad", "turn_z": "rad"}.get(
            path.rpartition(".")[2], "m"
        )
    if block == "regions":
        name = path.rpartition(".")[2]
        return "1" if name == "contrast" else unit_of(f"material.{name}")
    if path.endswith(".density"):
        return "kg/m³"
    return {"displacements": "m", "loads": "Pa"}.get(block, "1")


def unit_of_constant(name: str) -> str:
    """SI unit of a constant of a material, or of a number of a model by its path."""
    return unit_of(name if "." in name else f"material.{name}")


def named(name: str, unit: str) -> str:
    """Write the unit after a name, if it has one."""
    return name if unit == "1" else f"{name} ({unit})"


def model_in_words(study: Study) -> Iterator[tuple[str, list[str]]]:
    """Say what was solved: headings, each with its lines."""
    model = study.spec
    if not isinstance(model, Hyperelastic):
        yield from _external_in_words(study)
        return
    body = model.body
    cells = body.cells_in_words
    coarsest = " on the coarsest mesh" if len(study.meshes) > 1 else ""
    yield "body", [f"{body.description}; {cells} cells ({body.cell}, degree {body.degree}){coarsest}"]
    pressures = " and pressures (mixed form)" if model.mixed else ""
    yield "unknowns", [f"{model.unknowns:,} displacements{pressures}{coarsest}"]
    kind = model.energy
    numbers = [f"{name} = {_scalar(study, f'material.{name}')}" for name in constants(kind)]
    fibres = [f"fibres along {' and '.join(map(listed, model.fibres))}"] if model.fibres else []
    law = str(energy_of(kind).__doc__).partition("\n")[0]
    yield "material", [law, ", ".join(numbers), *fibres]
    if model.regions:
        named = {
            region: ", ".join(f"{name} = {_scalar(study, f'regions.{region}.{name}')}" for name in numbers)
            for region, numbers in model.regions.items()
        }
        yield "regions", [f"{region}: {numbers}" for region, numbers in named.items()]
    if model.inclusions:
        yield "inclusions", [_inclusion(study, inclusion) for inclusion in model.inclusions]
    if model.fields:
        yield "random fields", [_field(field) for field in model.fields]
    held = [f"{boundary} clamped" for boundary in model.clamp] + [
        f"{item.on}: u{axis} = {_scalar(study, f'displacements.{item.label}.{axis}')}"
        for item in model.displacements
        for axis in item.components
    ]
    yield "held", held
    yield "loads", [_load(study, load) for load in model.loads] or ["none"]
    yield "outputs", [_output(output) for output in model.outputs]


def _external_in_words(study: Study) -> Iterator[tuple[str, list[str]]]:
    model = study.model
    yield "model", [model.description]
    yield "parameters", [f"{name} = {_scalar(study, name)}" for name in model.scalars]
    yield "outputs", [f"{output.name}{'' if output.unit == '1' else f' ({output.unit})'}" for output in model.outputs]


def _output(output: Observable) -> str:
    block = output.model_dump()
    details = settings(block, "kind", "name")
    unit = "" if output.unit == "1" else f" ({output.unit})"
    return f"{output.name}: {block['kind']}{', ' if details else ''}{details}{unit}"


def _inclusion(study: Study, inclusion: Inclusion) -> str:
    numbers = [
        f"{name} = {_scalar(study, f'inclusions.{inclusion.label}.{name}')}"
        for name in type(inclusion).model_fields
        if name not in {"kind", "name"}
    ]
    named = f"{inclusion.name} ({inclusion.kind})" if inclusion.name else inclusion.kind
    return f"{named}: {', '.join(numbers)}"


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


def _load(study: Study, load: Term) -> str:
    return load.words({name: _scalar(study, f"loads.{load.label}.{name}") for name in load.values})


def _scalar(study: Study, path: str) -> str:
    """A number of the model with its unit, or that it is random."""
    if path in study.parameters:
        return "random"
    scalar = study.model.scalars[path]
    return with_unit(number(scalar.value, 6), scalar.unit)
