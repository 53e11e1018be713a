"""The linear model of a body: what finite strains tend to, a bar in closed form, and derivatives as of any model."""

import numpy as np
import pytest
from mpi4py import MPI

from forward.conformance import EXACT, check_derivatives
from forward.hyperelastic import Hyperelastic
from forward.material_tests import MaterialTests
from forward.materials.material import small_strain_moduli
from forward.model import ModelError
from forward.reduced.spec import mistakes
from tests.bodies import MATERIALS, MIXED, MORE_MATERIALS, cantilever, loaded_body
from workflows.config.study import parse

pytestmark = pytest.mark.fem
SCALES = (1e-4, 2e-4)


def small(material, **changes):
    return loaded_body(material, strains="small", **changes)


def scaled(spec, factor):
    numbers = {path: number.value for path, number in spec.scalars.items()}
    return np.array([(1.0 if path.startswith("material.") else factor) * value for path, value in numbers.items()])


def outputs_at(spec, factors):
    model = spec.build(MPI.COMM_SELF, tuple(spec.scalars))
    assert model.equations._residual._lanes is not None  # forces come for several cells at once
    found = [model.solve(scaled(spec, factor)) for factor in factors]
    return model.outputs, np.array([one.outputs for one in found]), np.array([one.state for one in found])


@pytest.mark.few(2)
@pytest.mark.parametrize("material", [*MATERIALS, *MORE_MATERIALS, *MIXED])
def test_it_is_what_finite_strains_tend_to(material):
    if material == "holzapfel-gasser-ogden":  # stretched fibres stiffen from the first moment on
        pytest.skip("fibres are left out")
    names, linear, states = outputs_at(small(material), (1.0, 0.5))
    np.testing.assert_allclose(states[1], states[0] / 2, atol=1e-10 * np.abs(states).max())
    _, finite, bent = outputs_at(loaded_body(material), SCALES)
    errors = [
        np.abs(u / scale - states[0]).max() / np.abs(states[0]).max() for u, scale in zip(bent, SCALES, strict=True)
    ]
    assert errors[0] < 1e-2
    assert 1.8 < errors[1] / errors[0] < 2.2  # of first order
    for k, name in enumerate(names):
        power = 2 if "energy" in name else 1
        assert linear[1, k] == pytest.approx(linear[0, k] / 2**power, rel=1e-8), name
        assert finite[0, k] / SCALES[0] ** power == pytest.approx(linear[0, k], rel=2e-2), name


@pytest.mark.parametrize("material", ["demiray", "neo-hookean mixed"])
def test_derivatives_are_those_of_any_model(material):
    spec = small(material)
    values = scaled(spec, 1.0)
    found = check_derivatives(spec.build(MPI.COMM_SELF, tuple(spec.scalars)), values, 0.1 * values, accuracy=1e-13)
    assert found.mistakes() == ()
    assert found.adjoint.max() <= EXACT
    assert found.stale <= EXACT
    of_material = found.orders[[path.startswith("'material") for path in found.directions]]
    assert np.nanmax(np.abs(of_material - 2)) <= 0.1
    assert np.isfinite(of_material).any(axis=0).sum() >= len(found.outputs) - 1  # a reaction is statically determinate


@pytest.mark.parametrize("formulation", ["displacement", "mixed"])
def test_a_bar_is_stretched_by_its_modulus(formulation):
    law = MATERIALS["mooney-rivlin"]
    mu, kappa = small_strain_moduli("mooney-rivlin", {name: law[name] for name in ("C1", "C2", "D1")})
    young = 9 * kappa * mu / (3 * kappa + mu)
    spec = Hyperelastic(
        strains="small",
        formulation=formulation,
        body={"kind": "box", "size": (0.4, 0.1, 0.2), "cells": (2, 1, 1), "cell": "hexahedron", "degree": 2},
        material=law,
        displacements=[{"on": f"{axis}-min", axis: 0.0} for axis in "xyz"],
        loads=[{"kind": "traction", "on": "x-max", "direction": (1, 0, 0), "size": 1e4}],
        outputs=[
            {"name": "tip", "kind": "mean-displacement", "on": "x-max", "component": "x"},
            {"name": "energy", "kind": "strain-energy"},
            {"name": "volume", "kind": "volume-change"},
            {"name": "stress", "kind": "max-von-mises"},
        ],
    )
    found = spec.build(MPI.COMM_SELF, ()).solve(np.zeros(0)).outputs
    expected = [0.4 * 1e4 / young, 1e8 / (2 * young) * 0.008, 1e4 / (3 * kappa), 1e4]
    np.testing.assert_allclose(found, expected, rtol=1e-8)


def test_a_candidate_and_its_errors_against_the_body():
    model = loaded_body("demiray").model_dump(mode="json", exclude_none=True)
    priors = {"material.a": {"kind": "log-normal", "mean": 4e4, "std": 1e4}}
    linear = {"model": {"strains": "small"}, "model_error": {"against": {}}, "parameters": priors}
    study = parse(
        {
            "model": model,
            "data": {"outputs": {"reaction-x": 100.0}, "sigma": {"reaction-x": 5.0}},
            "candidates": {"body": {"parameters": priors}, "linear": linear},
            "method": {"kind": "select", "noise": {}},
        }
    )
    assert [one.strains for one in study.of_candidates.values()] == ["finite", "small"]
    assert study.truth("linear") == study.of_candidates["body"]
    assert "another one, whose mesh is taken as it is" in study.unchecked["linear"]
    assert not study.unchecked["body"]


def test_a_reduced_model_stands_for_finite_strains_only():
    (said,) = [line for line in mistakes(cantilever(strains="small")) if "strains" in line]
    assert said.endswith("expected strains = 'finite'")
    with pytest.raises(ModelError, match="a model of kind 'material-tests' has no strains"):
        MaterialTests.model_construct().linearised()
