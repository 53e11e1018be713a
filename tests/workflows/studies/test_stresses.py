"""Stresses and strains at the mean of the inputs: against uniform states, between forms, and in ParaView's file."""

import numpy as np
import pytest
import pyvista

import tissuq

pytestmark = pytest.mark.fem

STRETCH = 1.2


def study(**changed):
    """A cube between plates that slide, pulled by a fifth: F is uniform."""
    model = {
        "body": {"kind": "box", "size": [1, 1, 1], "cells": [2, 1, 1], "degree": 2},
        "material": {"kind": "mooney-rivlin", "C1": 1e3, "C2": 2e3, "D1": 2e4},
        "displacements": [
            {"on": "x-min", "x": 0.0},
            {"on": "y-min", "y": 0.0},
            {"on": "z-min", "z": 0.0},
            {"on": "x-max", "x": STRETCH - 1},
        ],
        "outputs": [{"name": "end", "kind": "mean-displacement", "on": "y-max", "component": "y"}],
        "stresses": True,
    }
    return tissuq.Study(
        model=model | changed,
        parameters={"material.C1": {"kind": "uniform", "lower": 900, "upper": 1100}},
        method={"kind": "chaos", "samples": 3},
        accuracy={"mesh_error": False},
    )


@pytest.mark.parametrize("formulation", ["displacement", "mixed"])
def test_a_uniform_state(formulation):
    found = study(formulation=formulation).run()
    assert list(found.tensor.values) == ["xx", "yy", "zz", "xy", "yz", "xz"]
    across = 1 + float(found["nominal"].item())
    strain = [(STRETCH**2 - 1) / 2, *2 * [(across**2 - 1) / 2], 0, 0, 0]
    np.testing.assert_allclose(found["node_strain"], np.tile(strain, (found.sizes["node"], 1)), atol=1e-8)
    stress = found["node_stress"].to_numpy()
    np.testing.assert_allclose(stress[:, 1:], 0, atol=1e-4 * stress[0, 0])
    J, b = STRETCH * across**2, np.array([STRETCH**2, across**2, across**2])
    # Cauchy stress of W = C1 (I1 J^-2/3 − 3) + C2 (I2 J^-4/3 − 3) + D1 (J − 1)².
    C1, C2, D1 = 1e3, 2e3, 2e4
    I1 = b.sum()
    isochoric = (
        2
        / J
        * (C1 * J ** (-2 / 3) * (b - I1 / 3) + C2 * J ** (-4 / 3) * (I1 * b - b**2 - 2 * (I1**2 - (b**2).sum()) / 6))
    )
    expected = isochoric + 2 * D1 * (J - 1)
    np.testing.assert_allclose(stress[:, 0], expected[0], rtol=1e-4)
    np.testing.assert_allclose(found["von_mises"], abs(expected[0] - expected[1]), rtol=1e-4)


def test_they_are_in_the_file_for_paraview_and_not_unless_asked(tmp_path):
    study().run(tmp_path / "out")
    grid = pyvista.read(tmp_path / "out" / "fields" / "displacement.vtu")
    assert {"stress (Pa)", "strain", "von_mises (Pa)", "nominal (m)", "derivative material.C1 (m/Pa)"} <= set(
        grid.point_data
    )
    assert grid["stress (Pa)"].shape == (grid.n_points, 6)
    assert "node_stress" not in study(stresses=False).run()
