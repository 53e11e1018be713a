"""Bodies of which the compiled forms are the same: compiling is what takes time in tests of finite elements."""

from types import SimpleNamespace

import sympy as sp
from sympy.codegen.cfunctions import expm1, log1p

from forward.hyperelastic import Hyperelastic
from forward.materials import kinematics
from forward.materials.material import MATERIALS as LAWS
from forward.materials.material import measures

MATERIALS = {
    "mooney-rivlin": {"kind": "mooney-rivlin", "C1": 1e4, "C2": 2e4, "D1": 2e5},
    "neo-hookean": {"kind": "neo-hookean", "C1": 1e4, "D1": 3e5},
    "neo-hookean-coupled": {"kind": "neo-hookean-coupled", "mu": 2e4, "lmbda": 2e5},
    "demiray": {"kind": "demiray", "a": 4e4, "b": 1.5, "D1": 2e5},
}
CONSTANTS: dict[str, dict[str, float]] = {
    "mooney-rivlin": {"C1": 1e4, "C2": 2e4},
    "neo-hookean": {"C1": 1e4},
    "neo-hookean-coupled": {"mu": 1e4, "lmbda": 2e4},
    "yeoh": {"C10": 1e4, "C20": -1e3, "C30": 500.0},
    "gent": {"mu": 1e4, "Jm": 30.0},
    "demiray": {"a": 1e4, "b": 0.7},
    "saint-venant-kirchhoff": {"mu": 1e4, "lmbda": 2e4},
    "blatz-ko": {"mu": 1e4},
    "ogden": {"mu1": 1e4, "alpha1": 1.5, "mu2": -2e3, "alpha2": -2.0, "mu3": 100.0, "alpha3": 5.0},
    "holzapfel-gasser-ogden": {"c": 1e4, "k1": 5e3, "k2": 0.8},
}
NOT_CONSTANTS = ("kind", "fibres")
# Of these, what differs from the ones above is the energy: it is compared with closed forms.
MORE_MATERIALS = {
    "yeoh": {"kind": "yeoh", "C10": 2e4, "C20": -2e3, "C30": 1e3, "D1": 2e5},
    "gent": {"kind": "gent", "mu": 4e4, "Jm": 3.0, "D1": 2e5},
    "saint-venant-kirchhoff": {"kind": "saint-venant-kirchhoff", "lmbda": 1e5, "mu": 4e4},
    "blatz-ko": {"kind": "blatz-ko", "mu": 5e4},
    "ogden": {
        "kind": "ogden",
        "mu1": 2e4,
        "alpha1": 1.5,
        "mu2": 1e3,
        "alpha2": 5.0,
        "mu3": -1e4,
        "alpha3": -2.0,
        "D1": 2e5,
    },
    "holzapfel-gasser-ogden": {
        "kind": "holzapfel-gasser-ogden",
        "c": 2e4,
        "k1": 1e4,
        "k2": 0.8,
        "D1": 2e5,
        "fibres": ((1.0, 0.0, 0.0),),
    },
}
CELLS = {
    "mooney-rivlin": ("hexahedron", 1),
    "neo-hookean": ("tetrahedron", 2),
    "neo-hookean-coupled": ("hexahedron", 1),
    "demiray": ("tetrahedron", 1),
} | dict.fromkeys(MORE_MATERIALS, ("tetrahedron", 1))
MIXED = ("neo-hookean mixed", "mooney-rivlin mixed")  # quadratic tetrahedra, quadratic hexahedra
FORMS = (*MATERIALS, *MIXED)
SYMPY = SimpleNamespace(
    ln=sp.log,
    exp=sp.exp,
    sqrt=sp.sqrt,
    positive=lambda x: sp.Piecewise((x, x > 0), (0, True)),
    tr=sp.trace,
    det=lambda F: F.det(),
    inner=lambda a, b: (a.T * b)[0],
    outer=lambda a, b: a * b.T,
    inv=lambda A: A.inv(),
    sinh=sp.sinh,
    log1p=log1p,
    expm1=expm1,
    near=lambda z, limit, inside, outside: sp.Piecewise((inside, z**2 < limit**2), (outside, True)),
)
OUTPUTS = (
    {"kind": "max-displacement", "name": "largest"},
    {"kind": "max-displacement", "name": "largest-z", "component": "z"},
    {"kind": "displacement", "name": "point", "at": (0.9, 0.35, 0.6), "component": "z"},
    {"kind": "mean-displacement", "name": "mean", "on": "x-max", "component": "y"},
    {"kind": "reaction", "name": "reaction-x", "on": "x-min", "component": "x"},
    {"kind": "reaction", "name": "reaction-y", "on": "y-max", "component": "y"},
    {"kind": "strain-energy", "name": "energy"},
    {"kind": "volume-change", "name": "volume"},
    {"kind": "max-von-mises", "name": "stress"},
)


def energy_density(kind, F, fibres=(), **constants):
    """Energy density by SymPy of a deformation gradient, in symbols or numbers; not of principal stretches."""
    at = kinematics.deformation(SYMPY, F - sp.eye(3), sp.eye(3))
    along = [sp.Matrix(fibre) for fibre in fibres]
    return LAWS[kind](SYMPY, *(kinematics.measure(SYMPY, name, at, along) for name in measures(kind)), **constants)


def loaded_body(material, *, density=600.0, traction=1e3, pressure=2e3, **changes):
    """A block under every kind of load; loads of size zero keep its compiled forms the same.

    It is made of a material, in its displacement form or in one of the forms `MIXED`.
    """
    material, _, mixed = material.partition(" ")
    cell, degree = CELLS[material]
    body = {"size": (1.0, 0.7, 0.8), "cells": (2, 1, 1), "cell": cell, "degree": 2 if mixed else degree}
    blocks = {
        "formulation": mixed or "displacement",
        "body": body | changes.pop("body", {}),
        "material": (MATERIALS | MORE_MATERIALS)[material],
        "clamp": ("x-min",),
        "displacements": ({"on": "y-max", "y": 0.05},),
        "loads": (
            {"kind": "gravity", "direction": (0.0, -1.0, 0.3), "density": density},
            {"kind": "traction", "on": "x-max", "direction": (1.0, 0.0, 1.0), "size": traction},
            {"kind": "pressure", "on": "z-max", "size": pressure},
        ),
        "outputs": OUTPUTS,
        "solver": {"tolerance": 1e-12},
    }
    return Hyperelastic.model_validate(blocks | changes)


def unloaded_body(material, **changes):
    """The same block without loads."""
    return loaded_body(material, density=0.0, traction=0.0, pressure=0.0, **changes)


def cantilever(**changes):
    """A block that bends a little: its stiffness is symmetric."""
    blocks = {
        "formulation": "displacement",
        "body": {"size": (0.1, 0.02, 0.02), "cells": (3, 1, 1), "cell": "hexahedron"},
        "material": {"kind": "neo-hookean", "C1": 5e3, "D1": 5e4},
        "clamp": ("x-min",),
        "loads": ({"kind": "traction", "on": "x-max", "direction": (0.0, -1.0, 0.0), "size": 60.0},),
        "outputs": ({"kind": "mean-displacement", "name": "tip", "on": "x-max", "component": "y"},),
    }
    return Hyperelastic.model_validate(blocks | changes)
