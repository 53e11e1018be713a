"""What a model could be measured at, as far as that is known before it is made."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from forward.bodies.geometry import AXES
from forward.model import FloatArray
from forward.scalars import Mistake
from forward.spec import ModelSpec
from forward.specimen import Observed, Specimen
from inverse.designs.candidates import Values
from inverse.methods.design import Design


def mistakes(method: Design, spec: ModelSpec) -> Iterator[Mistake]:
    """Find what a design asks for that a model does not have; nothing where only its mesh knows."""
    values = known(spec) if isinstance(spec, Specimen) else of_outputs(spec)
    if values is None:
        return
    if not values.names:
        message = "nothing is observed, expected boundaries or points, or outputs of load cases"
        yield ("model", "observed"), message, ()
        return
    for key, message, given in method.mistakes(values):
        yield ("method", key), message, given


def of_outputs(spec: ModelSpec) -> Values:
    """Say what each output of a model is that is no specimen."""
    axes, names = dict(spec.axes_of_outputs), tuple(output.name for output in spec.returned)
    steps = [str(step) for step in axes["step"][1]] if "step" in axes else [""] * len(names)
    parts = [str(part) for part in axes["output_of"][1]] if "output_of" in axes else list(names)
    return Values(names, np.full((len(names), 3), np.nan), tuple(steps), tuple(parts))


def known(spec: Specimen) -> Values | None:
    """Say what the values of a specimen are; None where nodes of a mesh from a file are observed."""
    names, places, cases, parts = list[str](), list[FloatArray](), list[str](), list[str]()
    for case in spec.cases:
        for item in spec.seen(case):
            points = _points(spec, item)
            if points is None:
                return None
            names += [f"{case.name}.{item.label}.{i}.{axis}" for i in range(len(points)) for axis in item.components]
            places += [point for point in points for _ in item.components]
            parts += [axis for _ in points for axis in AXES if axis in item.components]
        names += [f"{case.name}.{output.name}" for output in case.outputs]
        places += [np.full(3, np.nan) for _ in case.outputs]
        parts += [output.name for output in case.outputs]
        cases += [case.name] * (len(names) - len(cases))
    return Values(tuple(names), np.array(places).reshape(-1, 3), tuple(cases), tuple(parts))


def _points(spec: Specimen, item: Observed) -> FloatArray | None:
    """Points (n, 3) at which displacements are measured: nodes of a side as they lie on a cube of cells of one size."""
    if item.on is None:
        return np.array(item.at)
    cells = getattr(spec.body, "cells", None)
    if cells is None or len(cells) != len(AXES) or item.on not in SIDES:
        return None
    lines = [np.linspace(0.0, 1.0, spec.body.degree * n + 1) for n in cells]
    axis, end = SIDES[item.on]
    lines[axis] = lines[axis][[end]]
    return np.asarray(np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3))


SIDES = {f"{axis}-{side}": (k, end) for k, axis in enumerate(AXES) for side, end in (("min", 0), ("max", -1))}
