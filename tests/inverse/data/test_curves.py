"""Tables of curves over the steps of a path, with units in their heads."""

import math

import numpy as np
import pytest

from forward.hyperelastic import Path as Steps
from inverse.data.outputs import read_outputs, steps_of
from inverse.data.table import DataError, factor, split_head

SPEC = Steps.model_validate(
    {
        "kind": "path",
        "body": {"kind": "box", "size": (0.01, 0.01, 0.01), "cells": (1, 1, 1), "cell": "hexahedron", "degree": 1},
        "material": {"kind": "neo-hookean-coupled", "mu": 1e3, "lmbda": 1e3},
        "clamp": ("z-min",),
        "displacements": ({"on": "z-max", "name": "plate", "x": 0.0, "y": 0.0, "z": (-1e-3, -2e-3, -2.5e-3)},),
        "outputs": (
            {"kind": "reaction", "name": "force", "on": "z-max", "component": "z"},
            {"kind": "max-displacement", "name": "bulge", "component": "x"},
        ),
    }
)
OUTPUTS = tuple(output.name for output in SPEC.returned)


def read(tmp_path, text):
    file = tmp_path / "curve.csv"
    file.write_text(text)
    return read_outputs(file, OUTPUTS, steps_of(SPEC))


@pytest.mark.unit
@pytest.mark.parametrize(
    "text",
    [
        "z,force,bulge,sigma_force,sigma_bulge\n-1e-3,-2e-3,1e-4,1e-4,2e-6\n-2.5e-3,-9e-3,,3e-4,\n",
        "z [mm],force [mN],bulge (µm),sigma_force [uN],sigma_bulge [um]\n-1,-2,100,100,2\n-2.5,-9,,300,\n",
        "step,force [mN],bulge [mm],sigma_bulge [mm],sigma_force [mN]\n1,-2,.1,.002,.1\n3,-9,,,.3\n",
        "displacements.plate.z [m],force [kN],bulge [cm],sigma_force [N],sigma_bulge [m]\n"
        "-.001,-2e-6,1e-2,1e-4,2e-6\n-.0025,-9e-6,,3e-4,\n",
    ],
)
def test_curves_in_any_units(tmp_path, text):
    found = read(tmp_path, text)
    assert tuple(found.names) == ("force.1", "bulge.1", "force.3")
    np.testing.assert_allclose(found.values, [-2e-3, 1e-4, -9e-3], rtol=1e-12)
    np.testing.assert_allclose(found.sigma, [1e-4, 2e-6, 3e-4], rtol=1e-12)
    assert found.labels[2] == "curve.csv: line 3"


@pytest.mark.unit
def test_long_tables_of_the_same_data_are_read_too(tmp_path):
    found = read(tmp_path, "# truth.material.mu = 1000\noutput,value\nforce.2,-5e-3\nforce.2,-6e-3\n")
    assert tuple(found.names) == ("force.2", "force.2")
    assert np.isnan(found.sigma).all()
    assert found.truth == {"material.mu": 1000.0}


@pytest.mark.unit
def test_measurements_may_be_repeated_and_steps_numbered(tmp_path):
    assert tuple(read(tmp_path, "z,force\n-1e-3,1\n-1e-3,1.1\n-2e-3,2\n").names) == ("force.1", "force.1", "force.2")
    assert tuple(read(tmp_path, "step,force\n2,1\n1,2\n").names) == ("force.2", "force.1")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("z,farce\n-1e-3,1\n", "unknown column 'farce'; did you mean 'force'?"),
        ("z,force [kPa]\n-1e-3,1\n", "column 'force' has the unit 'kPa', expected N, mN or µN"),
        ("z [N],force [N]\n-1e-3,1\n", "column 'z' has the unit 'N', expected m, mm or µm"),
        ("z [mm],force\n-1,1\n", "'z' states a unit and 'force' does not"),
        ("z [mm],force [mN],sigma_force\n-1,1,0.1\n", "'z' states a unit and 'sigma_force' does not"),
        ("z,force_needle\n-1e-3,1\n", "unknown column 'force_needle'; did you mean"),
        ("z,force,sigma\n-1e-3,1,-0.1\n", "line 2: sigma is '-0.1', expected a number more than 0"),
        ("z,force,sigma\n-1e-3,1,0\n", "line 2: sigma is '0', expected a number more than 0"),
        ("z,force\n-1e-3,1\n-2e-3,2\n-1e-3,0.9\n", "line 4: z = -1e-3 after that of line 3, which is farther"),
        ("z,force\n-1e-3,1\n-2e-3,2\n-2e-3,2\n", "line 4: 'force' of line 3 again, expected each measurement once"),
        ("z,force\n-1,1\n", "(in millimetres? then its head is 'z [mm]', and all heads state units)"),
        ("z,force,force\n-1e-3,1,1\n", "several columns 'force'"),
        ("force\n1\n", "no column says where on the path a row is"),
        ("z,sigma\n-1e-3,1\n", "sigma of several units"),
        ("z\n-1e-3\n", "no column is a measured output, expected one of: force, bulge"),
        (
            "z,force\n-1.5e-3,1\n",
            "line 2: z = -0.0015 is no step of the model; its steps are z = -0.001, -0.002, -0.0025",
        ),
        ("step,z,force\n1,-2e-3,1\n", "line 2: step = 1, z = -0.002 is no step of the model"),
        ("z,force\nx,1\n", "line 2: z is 'x', expected a number"),
        ("z,force\n-1e-3,soft\n", "line 2: value is 'soft', expected a number"),
    ],
)
def test_what_a_curve_cannot_be(tmp_path, text, message):
    with pytest.raises(DataError) as caught:
        read(tmp_path, text)
    assert message in " ".join(caught.value.args)


@pytest.mark.unit
def test_units_of_heads():
    assert split_head("depth [mm]") == ("depth", "mm")
    assert split_head("depth(mm)") == ("depth", "mm")
    assert split_head("depth") == ("depth", None)
    assert factor("mm³", "m³") == pytest.approx(1e-9)
    assert factor("%", "1") == 0.01
    assert factor("MPa", "Pa") == 1e6
    assert math.isclose(factor("mm2", "m²"), 1e-6)
    with pytest.raises(ValueError, match="expected m, mm or µm"):
        factor("inch", "m")
