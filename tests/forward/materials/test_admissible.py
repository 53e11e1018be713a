"""Constants are judged together, by the stability of the material at rest."""

import numpy as np
import pytest

from forward.hyperelastic import Hyperelastic
from forward.materials.admissible import Materials, admissible, moduli, objection
from forward.materials.material import MATERIALS, constants, small_strain_moduli
from forward.materials.material_point import HomogeneousModel, MaterialTest
from forward.model import InadmissibleError
from tests.bodies import CONSTANTS
from uq.inputs.distributions import Normal, Uniform
from uq.inputs.random_parameters import Inputs


@pytest.mark.unit
@pytest.mark.parametrize("kind", list(MATERIALS))
def test_moduli_are_second_derivatives_of_the_energy(kind):
    values = CONSTANTS[kind] | ({"D1": 3e4} if "D1" in constants(MATERIALS[kind]) else {})
    assert moduli(kind, values) == pytest.approx(small_strain_moduli(kind, values), rel=1e-9)
    arrays = {name: np.array([value, 2 * value]) for name, value in values.items()}
    assert moduli(kind, arrays)[0][0] == pytest.approx(moduli(kind, values)[0])
    assert objection(kind, values) is None
    assert admissible(kind, arrays).all()


@pytest.mark.unit
@pytest.mark.parametrize(
    ("kind", "values", "told"),
    [
        ("mooney-rivlin", {"C1": 2.0, "C2": -1.0, "D1": 1.0}, None),
        ("mooney-rivlin", {"C1": 1.0, "C2": -1.0, "D1": 1.0}, "μ = 2 (C1 + C2) = 0 Pa"),
        ("mooney-rivlin", {"C1": -1.0, "C2": 2.0}, None),
        ("mooney-rivlin", {"C1": 1.0, "C2": 1.0, "D1": 0.0}, "κ = 2 D1 = 0 Pa"),
        ("yeoh", {"C10": 1.0, "C20": -5.0, "C30": -1.0}, None),
        ("ogden", {"mu1": 2.0, "alpha1": 2.0, "mu2": 1.0, "alpha2": -2.0, "mu3": 0.0, "alpha3": 1.0}, None),
        ("ogden", {"mu1": 1.0, "alpha1": 2.0, "mu2": 2.0, "alpha2": -2.0, "mu3": 0.0, "alpha3": 1.0}, "= -1 Pa"),
        ("neo-hookean-coupled", {"mu": 3.0, "lmbda": -1.0}, None),
        ("saint-venant-kirchhoff", {"mu": 3.0, "lmbda": -2.0}, "κ = lmbda + 2/3 mu = 0 Pa"),
        ("gent", {"mu": 1.0, "Jm": 0.0}, "Jm = 0, expected more than 0"),
        ("holzapfel-gasser-ogden", {"c": 1.0, "k1": -1.0, "k2": 1.0}, "k1 = -1, expected at least 0"),
        ("demiray", {"a": np.nan, "b": 1.0}, "μ = a = nan Pa"),
    ],
)
def test_which_constants_make_a_material(kind, values, told):
    assert admissible(kind, values) == (told is None)
    assert objection(kind, values) is None if told is None else told in objection(kind, values)


@pytest.mark.unit
def test_probability_of_materials():
    inputs = Inputs({"C1": Normal(mean=100.0, std=50.0), "C2": Normal(mean=0.0, std=50.0)})
    materials = Materials("mooney-rivlin", {"material": {"C1": "C1", "C2": "C2"}})
    assert inputs.admitted == 1
    assert inputs.within(materials).admitted == pytest.approx(0.9213504, abs=5e-4)  # Φ(√2)
    wide = Inputs(inputs.marginals, (("C1", "C2", -0.5),), materials)
    assert wide.admitted == pytest.approx(0.9772499, abs=5e-4)  # Φ(2)
    assert wide.admitted_at(0.5) == pytest.approx(0.9999683, abs=1e-4)
    bounded = Inputs({"C1": Uniform(lower=1.0, upper=2.0), "C2": Uniform(lower=-0.9, upper=1.0)}, (), materials)
    assert bounded.admitted == 1


@pytest.mark.unit
def test_bodies_and_their_regions():
    block = {
        "body": {"kind": "box", "size": [1.0, 1.0, 1.0], "cells": [1, 1, 1], "cell": "hexahedron", "degree": 1},
        "material": {"kind": "mooney-rivlin", "C1": 2e3, "C2": -1e3, "D1": 1e4},
        "clamp": ["x-min"],
        "outputs": [{"name": "u", "kind": "max-displacement", "component": "x"}],
    }
    spec = Hyperelastic.model_validate(block)
    paths = ("material.C2", "material.D1")
    materials = spec.materials(paths)
    assert materials.names == paths
    assert materials.objection({"material.C2": -1e3, "material.D1": 1.0}) is None
    assert "material: not stable" in materials.objection({"material.C2": -3e3, "material.D1": 1.0})
    with pytest.raises(ValueError, match="not stable at rest: μ"):
        Hyperelastic.model_validate(block | {"material": block["material"] | {"C2": -2e3}})


@pytest.mark.unit
def test_material_points():
    model = HomogeneousModel("mooney-rivlin", {}, [MaterialTest(mode="uniaxial", at=(1.1,))], ("C1", "C2"))
    assert model.solve(np.array([2.0, -1.0])).outputs[0] > 0
    with pytest.raises(InadmissibleError, match="not stable at rest: μ = 2"):
        model.solve(np.array([1.0, -2.0]))
