"""Loads that come from outside, each in one file beside a study, held against the forces that balance them."""

import sys

import numpy as np
import pytest
from mpi4py import MPI

from forward.bodies.geometry import Box
from forward.conformance import check_derivatives
from forward.terms.loads import Spot
from forward.terms.term import Term
from tests.bodies import loaded_body
from tests.launch import report_of_own
from tests.steps import STEPS

pytestmark = pytest.mark.fem

OUTSIDE = '''
from typing import Annotated, Any

from annotated_types import Ge, Unit

from forward.terms.term import Place, Term


class Springs(Term):
    """Springs of stiffness k that hold a boundary."""

    kind: str
    on: str
    k: Annotated[float, Ge(0), Unit("Pa/m")]

    def potential(self, at: Place) -> Any:
        import ufl

        return at.numbers["k"] / 2 * ufl.inner(at.u, at.u) * at.on(self.on)


class Suction(Term):
    """A pull on the deformed surface that dies away with the distance from z = 0 in the undeformed body."""

    kind: str
    on: str
    size: Annotated[float, Unit("Pa")]
    length: Annotated[float, Ge(0), Unit("m")]

    def virtual_work(self, at: Place) -> Any:
        import ufl

        normal = ufl.dot(at.J * ufl.inv(at.F).T, at.normal)
        decay = ufl.exp(-at.X[2] / at.numbers["length"])
        return -at.numbers["size"] * decay * ufl.dot(normal, at.v) * at.on(self.on)
'''
SPRINGS = {"kind": "my_loads.Springs", "on": "x-max", "k": 3e5}
SUCTION = {"kind": "my_loads.Suction", "on": "z-max", "size": 3e3, "length": 0.6}
TRACTION = {"kind": "traction", "on": "x-max", "direction": (1.0, 0.0, 0.0), "size": 4e4}
OUTPUTS = (
    {"kind": "mean-displacement", "name": "mean", "on": "x-max", "component": "x"},
    {"kind": "reaction", "name": "held", "on": "x-min", "component": "x"},
)


@pytest.fixture(autouse=True)
def outside(tmp_path, monkeypatch):
    (tmp_path / "my_loads.py").write_text(OUTSIDE)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop("my_loads", None)


def body(*loads):
    return loaded_body("mooney-rivlin", loads=loads, displacements=(), outputs=OUTPUTS)


def test_springs_bear_what_the_clamp_does_not():
    spec = body(TRACTION, SPRINGS)
    assert spec.symmetric
    assert spec.scalars["loads.Springs.k"].unit == "Pa/m"
    assert spec.scalars["loads.Springs.k"].objection(-1.0) is not None
    mean, held = spec.build(MPI.COMM_SELF, ()).solve(np.zeros(0)).outputs
    area = 0.7 * 0.8
    assert -held == pytest.approx(area * (TRACTION["size"] - SPRINGS["k"] * mean), rel=1e-9)
    assert mean > 0.01


def test_derivatives_of_loads_from_outside():
    """One has a potential, the other follows the body and is not proportional to one of its numbers."""
    spec = body(TRACTION, SPRINGS, SUCTION)
    assert not spec.symmetric
    names = ("loads.Springs.k", "loads.Suction.size", "loads.Suction.length", "material.C1")
    values = np.array([spec.scalars[name].value for name in names])
    model = spec.build(MPI.COMM_SELF, names)
    check_derivatives(model, values, 0.1 * values, steps=STEPS).require()


def test_words():
    numbers = {"k": "3 Pa/m"}
    assert body(SPRINGS).loads[0].words(numbers) == "Springs: on = x-max, k = 3 Pa/m"


@pytest.mark.parametrize(
    ("kind", "said"),
    [("my_loads.Sprngs", "did you mean 'Springs'?"), ("my_loads.Unit", "expected a subclass of Term")],
)
def test_what_is_no_load_is_refused(kind, said):
    with pytest.raises(ValueError, match=said.replace("?", r"\?")):
        body(SPRINGS | {"kind": kind})


class Unknown(Term):
    """A load that says nothing of what it does."""

    kind: str = "unknown"


def test_a_load_that_does_nothing_is_an_error():
    """Not a body without loads, of which every displacement is zero."""
    spec = loaded_body("mooney-rivlin").model_copy(update={"loads": (Unknown(),)})
    with pytest.raises(NotImplementedError):
        spec.build(MPI.COMM_SELF, ())


STUDY = """
[model]
kind = "hyperelastic"
body = { kind = "box", size = [1, 0.7, 0.8], cells = [2, 1, 1], cell = "hexahedron", degree = 1 }
material = { kind = "mooney-rivlin", C1 = 1e4, C2 = 2e4, D1 = 2e5 }
formulation = "displacement"
clamp = ["x-min"]
loads = [
    { kind = "traction", on = "x-max", direction = [1, 0, 0], size = 4e4 },
    { kind = "my_loads.Springs", on = "x-max", k = 3e5 },
]
outputs = [{ name = "mean", kind = "mean-displacement", on = "x-max", component = "x" }]

[parameters]
"loads.Springs.k" = { kind = "uniform", lower = 2e5, upper = 4e5 }

[method]
kind = "sensitivity-monte-carlo"
samples = 8
seed = 1
"""


@pytest.mark.slow
def test_a_study_with_springs_is_checked_and_run(outside, undrawn):
    assert "Springs: on = x-max, k = random" in report_of_own(outside, STUDY)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("place", "share"),
    [((0.5, 0.5, 0.3), 1.0), ((1.0, 0.5, 0.3), 0.5), ((0.5, 0.5, 0.2), np.exp(-1 / 2.88)), ((1.0, 1.0, 0.3), 0.25)],
)
@pytest.mark.parametrize("kind", ["hexahedron", "tetrahedron"])
def test_a_spot_that_misses_its_boundary_says_so(place, share, kind):
    """Of a Gaussian bell on a square, at an edge, a corner and off the face."""
    body = Box(size=(1.0, 1.0, 0.3), cells=(5, 5, 1), cell=kind)
    x, y, z = place
    spot = Spot(on="z-max", direction=(0, 0, -1), size=2.0, x=x, y=y, z=z, width=0.12)
    said = [one.text for one in spot.findings(body) if one.code == "spot-lost"]
    assert said == (
        []
        if share == 1
        else [
            f"Only {100 * share:.2g} % of the force of loads.spot acts on 'z-max': the "
            "rest lies beyond it, and is lost."
        ]
    )
    (over,) = (one for one in spot.findings_over(body, {"y": (0.5, 1.5), "size": (1.0, 2.0)}))
    assert "at y = 1.5" in over.text


def test_a_spot_is_a_force_of_its_size_that_moves_with_its_place():
    from forward.hyperelastic import Hyperelastic

    spot = {"kind": "spot", "on": "z-max", "direction": [0, 0, -1], "size": 2.0, "x": 0.5, "y": 0.5, "z": 0.3}
    spec = Hyperelastic.model_validate(
        {
            "body": {"kind": "box", "size": [1, 1, 0.3], "cells": [6, 6, 1], "cell": "hexahedron", "degree": 1},
            "material": {"kind": "neo-hookean", "C1": 1e3, "D1": 2e3},
            "formulation": "displacement",
            "clamp": ["z-min"],
            "loads": [spot | {"width": 0.12}],
            "outputs": [
                {"name": "held", "kind": "reaction", "on": "z-min", "component": "z"},
                {"name": "left", "kind": "displacement", "at": [0.25, 0.5, 0.3], "component": "z"},
                {"name": "right", "kind": "displacement", "at": [0.75, 0.5, 0.3], "component": "z"},
            ],
        }
    )
    paths = ("loads.spot.size", "loads.spot.x", "loads.spot.width")
    model = spec.build(MPI.COMM_SELF, paths)
    held, left, right = model.solve(np.array([2.0, 0.5, 0.12])).outputs
    assert held == pytest.approx(2.0, rel=1e-3)
    assert left == pytest.approx(right, rel=1e-6)
    _, left, right = model.solve(np.array([2.0, 0.25, 0.12])).outputs
    assert left < 2 * right < 0
    check_derivatives(model, [2.0, 0.45, 0.12], [0.1, 0.02, 0.005]).require()
    sharp = spec.model_copy(update={"loads": (spec.loads[0].model_copy(update={"width": 0.01}),)})
    assert any("hardly sees the spot" in one.text for one in sharp.findings)
