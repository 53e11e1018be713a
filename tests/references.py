"""Outputs and derivatives of bodies that every DOLFINx must give: `python -m tests.references` writes them anew."""

import json
from pathlib import Path

import numpy as np
from mpi4py import MPI

from forward.specimen import Specimen
from tests.bodies import OUTPUTS, loaded_body
from workflows.config.study import load

ROOT = Path(__file__).parent.parent
KEPT = Path(__file__).with_suffix(".json")
FIELDS = (
    {"of": "stiffness", "length": 0.6, "std": 0.3, "modes": 4},
    {"of": "density", "length": 0.5, "std": 0.4, "basis": "noise"},
)
TUMOUR = {"name": "tumour", "x": 0.55, "y": 0.3, "z": 0.45, "radius": 0.3, "contrast": 8.0, "width": 0.15}
CASES = (
    {
        "name": "pulled",
        "clamp": ("z-min",),
        "loads": ({"kind": "traction", "on": "z-max", "direction": (1, 0, 1), "size": 900.0},),
    },
    {"name": "moved", "clamp": ("x-min",), "displacements": ({"on": "x-max", "x": 0.1, "y": 0.05},)},
)


def _beam():
    spec = load(ROOT / "configs" / "beam.toml", ["model.body.cells=[6, 1, 2]", "model.solver.tolerance=1e-12"]).model
    return spec, {"loads.gravity.density": 700.0, "material.C1": 1.1e4, "material.D1": 2.5e5}


def _block():
    numbers = {"material.C1": 1.2e4, "material.D1": 3e5, "loads.traction.size": 1.1e3, "displacements.y-max.y": 0.04}
    return loaded_body("mooney-rivlin"), numbers


def _mixed():
    numbers = {"material.C1": 1.2e4, "material.D1": 1e8, "loads.pressure.size": 1.5e3}
    return loaded_body("neo-hookean mixed", outputs=OUTPUTS[2:-1]), numbers


def _inclusion():
    spec = loaded_body("mooney-rivlin", body={"cells": (2, 2, 2)}, inclusions=(TUMOUR,), outputs=OUTPUTS[2:-1])
    return spec, {"material.C1": 1.1e4, "inclusions.tumour.x": 0.5, "inclusions.tumour.contrast": 5.0}


def _field():
    spec = loaded_body("mooney-rivlin", body={"cells": (3, 2, 2)}, fields=FIELDS, outputs=OUTPUTS[2:-1])
    return spec, {"material.C1": 1.1e4, **_noise(spec)}


def _specimen():
    spec = Specimen.model_validate(
        {
            "body": {"size": (1.0, 0.7, 0.8), "cells": (2, 2, 2), "degree": 1},
            "material": {"kind": "neo-hookean-coupled", "mu": 1e4, "lmbda": 4e4},
            "fields": ({"of": "stiffness", "length": 0.6, "std": 0.4, "basis": "nodes"},),
            "cases": CASES,
            "observed": (
                {"on": "y-max", "components": "xz"},
                {"at": ((0.55, 0.3, 0.71), (1.0, 0.0, 0.8)), "cases": ("moved",)},
            ),
            "solver": {"tolerance": 1e-12},
        }
    )
    return spec, {"material.mu": 1.1e4, "displacements.x-max.x": 0.12, **_noise(spec)}


def _noise(spec):
    return dict(zip(spec.coefficients, (0.3 * np.sin(np.arange(len(spec.coefficients)) ** 2)).tolist(), strict=True))


BODIES = {
    "beam": _beam,
    "block": _block,
    "mixed form": _mixed,
    "inclusion": _inclusion,
    "random fields": _field,
    "specimen": _specimen,
}


def computed(name):
    """Outputs, their derivative along a direction, and the gradient of a weighted sum of them."""
    spec, numbers = BODIES[name]()
    model = spec.build(MPI.COMM_SELF, tuple(numbers))
    parameters = np.array(list(numbers.values()))
    solution = model.solve(parameters)
    sizes = np.maximum(np.abs(solution.outputs), 1e-3)
    weights = np.cos(np.arange(len(sizes))) / sizes
    return {
        "outputs": solution.outputs.tolist(),
        "tangent": solution.tangent(0.1 * np.maximum(np.abs(parameters), 0.1)).tolist(),
        "adjoint": solution.adjoint(weights).tolist(),
    }


if __name__ == "__main__":
    KEPT.write_text(json.dumps({name: computed(name) for name in BODIES}, indent=1) + "\n", encoding="utf-8")
