"""Outputs that come from outside, each in one file beside a study, held against closed forms."""

import sys

import numpy as np
import pytest
from mpi4py import MPI

from forward.conformance import check_derivatives
from forward.hyperelastic import Hyperelastic
from tests.bodies import loaded_body
from tests.launch import report_of_own
from tests.steps import STEPS

pytestmark = pytest.mark.fem

OUTSIDE = '''
from typing import ClassVar

from forward.observables.functionals import Integral
from forward.observables.observable import Equations, Functional, Observable


class Flux(Observable):
    """Volume that a boundary sweeps."""

    kind: str
    on: str
    unit: ClassVar[str] = "m³"

    def functional(self, equations: Equations) -> Functional:
        import ufl

        normal = ufl.FacetNormal(equations.mesh)
        return Integral(equations, ufl.dot(equations.u, normal), measure=equations.surface(self.on))


class Density(Observable):
    """Mean square of the energy density, which depends on numbers of the model."""

    kind: str
    unit: ClassVar[str] = "Pa²"

    def functional(self, equations: Equations) -> Functional:
        return Integral(equations, equations.stored_energy**2, equations.volume)


class Held(Observable):
    kind: str
    of_held: ClassVar[bool] = True
    on: str


class Nameless(Observable):
    on: str
'''
OUTPUTS = (
    {"kind": "my_outputs.Flux", "name": "flux", "on": "x-max"},
    {"kind": "my_outputs.Density", "name": "density"},
    {"kind": "mean-displacement", "name": "mean", "on": "x-max", "component": "x"},
)


@pytest.fixture(autouse=True)
def outside(tmp_path, monkeypatch):
    (tmp_path / "my_outputs.py").write_text(OUTSIDE)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop("my_outputs", None)


def body(*outputs):
    return loaded_body("mooney-rivlin", outputs=outputs)


def test_values_and_derivatives():
    spec = body(*OUTPUTS)
    assert [output.unit for output in spec.outputs] == ["m³", "Pa²", "m"]
    assert Hyperelastic.model_validate(spec.model_dump(mode="json")) == spec
    names = ("material.C1", "material.D1", "loads.pressure.size", "displacements.y-max.y")
    values = np.array([spec.scalars[name].value for name in names])
    model = spec.build(MPI.COMM_SELF, names)
    flux, _, mean = model.solve(values).outputs
    assert flux == pytest.approx(0.7 * 0.8 * mean, rel=1e-12)
    check_derivatives(model, values, 0.1 * values, steps=STEPS).require()


@pytest.mark.parametrize(
    ("output", "said"),
    [
        ({"kind": "my_outputs.Flux", "name": "f", "on": "x-mid"}, "unknown boundary"),
        ({"kind": "my_outputs.Flux", "name": "f"}, "missing"),
        ({"kind": "my_outputs.Held", "name": "f", "on": "x-max"}, "nothing holds this boundary"),
        ({"kind": "my_outputs.Nameless", "name": "f", "on": "x-max"}, "has no field called kind"),
        ({"kind": "my_outputs.Flx", "name": "f"}, "did you mean 'Flux'"),
    ],
)
def test_mistakes(output, said):
    with pytest.raises(ValueError, match=said):
        body(output)


STUDY = """
[model]
kind = "hyperelastic"
body = { kind = "box", size = [1, 0.7, 0.8], cells = [2, 1, 1], cell = "hexahedron", degree = 1 }
material = { kind = "mooney-rivlin", C1 = 1e4, C2 = 2e4, D1 = 2e5 }
formulation = "displacement"
clamp = ["x-min"]
loads = [{ kind = "traction", on = "x-max", direction = [1, 0, 0], size = 4e3 }]
outputs = [{ name = "swept", kind = "my_outputs.Flux", on = "x-max" }]

[parameters]
"material.C1" = { kind = "uniform", lower = 1e4, upper = 2e4 }

[method]
kind = "sensitivity-monte-carlo"
samples = 8
seed = 1
"""


@pytest.mark.slow
def test_a_study_is_checked_and_run(outside, undrawn):
    assert "swept: my_outputs.Flux, on = x-max (m³)" in report_of_own(outside, STUDY)
