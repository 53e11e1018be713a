"""What a tool feels: area and pressure, on a tiny mesh against what is known of them."""

import numpy as np
import pytest
from mpi4py import MPI

from forward.conformance import check_derivatives
from tests.forward.terms.test_indenter import SIDE, body, only, tool
from tests.steps import STEPS

pytestmark = pytest.mark.fem
OUTPUTS = (
    {"kind": "max-pressure", "name": "pressure"},
    {"kind": "contact-area", "name": "area"},
    {"kind": "force", "name": "force"},
)


def test_a_plane_presses_evenly():
    """Pressure is force over undeformed area; the area in contact is the deformed one."""
    spec = body(
        only("plane"), outputs=(*OUTPUTS, {"kind": "displacement", "name": "x", "at": (SIDE,) * 3, "component": "x"})
    )
    found = spec.build(MPI.COMM_SELF, ()).solve(np.zeros(0))
    pressure, area, force, wider = found.outputs
    assert pressure == pytest.approx(force / SIDE**2, rel=1e-7)
    assert area == pytest.approx((SIDE + wider) ** 2, rel=1e-7)


def test_derivatives_of_the_largest_pressure():
    spec = body(tool(at=(2e-3, 1e-3, SIDE)), outputs=OUTPUTS[:1])
    names = ("loads.indenter.depth", "loads.indenter.radius", "material.C1")
    values = np.array([spec.scalars[name].value for name in names])
    model = spec.build(MPI.COMM_SELF, names)
    check_derivatives(model, values, 1e-3 * values, steps=STEPS).require()
    assert model.solve(values).outputs[0] > 100
