"""Numbers rounded to their errors, and studies in words, for reports."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, assert_never

from forward.bodies.inclusions import Inclusion
from forward.bodies.random_fields import RandomField
from forward.hyperelastic import Hyperelastic
from forward.materials.energies import MATERIALS, constants, units
from forward.observables.outputs import Output
from forward.terms.loads import Gravity, Load, Pressure, Traction
from workflows.config.study import Study

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
DIGITS = 15  # that a number has
NONE = "–"  # what stands for a number that there is not


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


def number(value: float | None, digits: int = 4) -> str:
    """Write a number with some significant digits; powers of ten where it is very small or large."""
    if value is None or math.isnan(value):
        return NONE
    if math.isinf(value):
        return "∞" if value > 0 else "−∞"
    power = _power(float(f"{value:.{digits - 1}e}"))
    if power:
        return _scaled(f"{value / 10.0**power:.{digits}g}", power)
    return f"{float(f'{value:.{digits}g}'):,.10g}".replace("-", "−")


def with_error(value: float, error: float) -> str:
    """Write a value and its standard error, which has two significant digits: 0.12279 ± 0.00015."""
    if not (math.isfinite(value) and math.isfinite(error) and error > 0):
        return f"{number(value, 6)} ± {number(error, 2)}"
    decimals = 1 - math.floor(math.log10(error))
    if value:
        # Numbers have fifteen digits: an error below them is one of the last.
        decimals = min(decimals, DIGITS - 1 - math.floor(math.log10(abs(value))))
        error = max(error, 10.0**-decimals)
    power = _power(max(abs(value), error))
    places = max(decimals + power, 0)
    rounded = [round(x, decimals) / 10.0**power for x in (value, error)]
    text = " ± ".join(f"{x:,.{places}f}" for x in rounded)
    return _scaled(f"({text})", power) if power else text.replace("-", "−")


def duration(seconds: float) -> str:
    """Write a time: 0.23 s, 35 s, 4 min 10 s, 3 h 05 min."""
    if seconds < 99.5:
        return f"{seconds:.2g} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 100:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def worth(ratio: float) -> str:
    """Write how many plain samples a controlled one is worth."""
    return number(ratio, 3)


def unit_of(path: str) -> str:
    """SI unit of a number of the model, by its path; "1" for ratios and for models of other programs."""
    block, _, name = path.partition(".")
    if block == "material":
        # A name has the same unit in every material.
        return next((of[name] for of in map(units, MATERIALS.values()) if name in of), "1")
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


def with_unit(text: str, unit: str) -> str:
    """Write the unit after a number, if it has one."""
    return text if unit == "1" or text == NONE else f"{text} {unit}"


def per(unit: str, divisor: str) -> str:
    """Unit of a derivative."""
    if divisor == "1":
        return unit
    return f"{unit}/({divisor})" if "/" in divisor else f"{unit}/{divisor}"


def settings(block: dict[str, Any], *left_out: str) -> str:
    """Write the settings of a block: a = 2, b = 2."""
    return ", ".join(f"{key} = {_value(value)}" for key, value in block.items() if key not in left_out)


def model_in_words(study: Study) -> Iterator[tuple[str, list[str]]]:
    """Say what was solved: headings, each with its lines."""
    if study.body is None:
        yield from _external_in_words(study)
        return
    model, body = study.body, study.body.body
    cells = body.cells_in_words
    coarsest = " on the coarsest mesh" if len(study.meshes) > 1 else ""
    yield "body", [f"{body.description}; {cells} cells ({body.cell}, degree {body.degree}){coarsest}"]
    pressures = " and pressures (mixed form)" if model.mixed else ""
    yield "unknowns", [f"{model.unknowns:,} displacements{pressures}{coarsest}"]
    kind = model.energy
    numbers = [f"{name} = {_scalar(study, f'material.{name}')}" for name in constants(MATERIALS[kind])]
    fibres = [f"fibres along {' and '.join(map(_value, model.fibres))}"] if model.fibres else []
    law = str(MATERIALS[kind].__doc__).partition("\n")[0]
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
    assert not isinstance(model, Hyperelastic)
    yield "model", [model.description]
    yield "parameters", [f"{name} = {_scalar(study, name)}" for name in model.parameters]
    yield "outputs", [f"{output.name}{'' if output.unit == '1' else f' ({output.unit})'}" for output in model.outputs]


def _output(output: Output) -> str:
    details = settings(output.model_dump(), "kind", "name")
    unit = "" if output.unit == "1" else f" ({output.unit})"
    return f"{output.name}: {output.kind}{', ' if details else ''}{details}{unit}"


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


def _load(study: Study, load: Load) -> str:
    match load:
        case Gravity():
            density = _scalar(study, f"loads.{load.label}.density")
            return f"gravity: density {density} × {load.acceleration:g} m/s² along {_value(load.direction)}"
        case Traction():
            size = _scalar(study, f"loads.{load.label}.size")
            return f"traction on {load.on}: {size} along {_value(load.direction)}"
        case Pressure():
            return f"pressure on {load.on}: {_scalar(study, f'loads.{load.label}.size')}"
        case _:
            assert_never(load)


def _scalar(study: Study, path: str) -> str:
    """A number of the model with its unit, or that it is random."""
    if path in study.parameters:
        return "random"
    return with_unit(number(study.model.scalars[path].value, 6), unit_of(path))


def _value(value: Any) -> str:
    if isinstance(value, tuple | list):
        return f"({', '.join(_value(item) for item in value)})"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _power(value: float) -> int:
    """Power of ten that is written apart: none for numbers of ordinary size."""
    power = math.floor(math.log10(abs(value))) if value else 0
    return 0 if -3 <= power < 6 else power


def _scaled(text: str, power: int) -> str:
    return f"{text} × 10{str(power).translate(_SUPERSCRIPTS)}".replace("-", "−")
