"""Material-point tests: closed forms, derivatives, compressible specimens against finite elements."""

import re

import numpy as np
import pytest
from mpi4py import MPI
from pydantic import ValidationError

from forward.hyperelastic import Hyperelastic
from forward.material_tests import MaterialTests
from forward.materials.material import MATERIALS, constants, measures, small_strain_moduli
from forward.materials.material_point import HomogeneousModel, MaterialTest
from forward.model import Guess, SolveError
from tests.bodies import CONSTANTS

CASES = [*CONSTANTS.items()] + [
    (kind, values | {"D1": 3e4}) for kind, values in CONSTANTS.items() if "D1" in constants(MATERIALS[kind])
]
STRETCHES = (0.7, 0.9, 1.1, 1.4)
TESTS = [
    *(
        MaterialTest(mode=mode, at=STRETCHES, stress=stress, name=f"{mode} {stress}")
        for mode in ("uniaxial", "equibiaxial", "pure-shear")
        for stress in ("nominal", "cauchy")
    ),
    MaterialTest(mode="biaxial", at=(1.2, 1.3), across=(1.1, 0.9)),
    MaterialTest(mode="biaxial", at=(1.2, 1.3), across=(1.1, 0.9), stress="cauchy", name="biaxial cauchy"),
    MaterialTest(mode="simple-shear", at=(-0.3, 0.0, 0.4)),
]


def model(kind: str, values: dict[str, float], *tests: MaterialTest) -> HomogeneousModel:
    alike = "i4" in measures(kind)
    chosen = [test for test in tests or TESTS if not (alike and test.mode == "equibiaxial")]
    return HomogeneousModel(kind, values, chosen, tuple(values), [(1.0, 0.0, 0.0)] if alike else ())


def stated(kind: str, values: dict[str, float], tests: list[dict], fibres=()) -> MaterialTests:
    of_fibres = {"fibres": fibres} if fibres else {}
    return MaterialTests.model_validate({"material": {"kind": kind, **values, **of_fibres}, "tests": tests})


@pytest.mark.unit
def test_every_energy_is_read():
    assert set(CONSTANTS) == set(MATERIALS)


@pytest.mark.parametrize(("kind", "values"), [case for case in CASES if case[0] in {"ogden", "demiray", "gent"}])
def test_points_at_once_are_the_points_one_by_one(kind, values, monkeypatch):
    """To the last bit, whichever points are beside them, refused ones too."""
    monkeypatch.setattr(HomogeneousModel, "together", 4)
    it = model(kind, values)
    points = np.array([[*values.values()]]) * np.random.default_rng(0).uniform(0.9, 1.1, (6, len(values)))
    points[3, 0] *= -100
    found = list(it.solve_many(points, [Guess(derivatives=True)] * len(points)))
    for point, one, plain in zip(points, found, it.solve_many(points), strict=True):
        if isinstance(one, SolveError):
            with pytest.raises(type(one), match=re.escape(str(one))):
                it.solve(point)
            assert str(plain) == str(one)
            continue
        alone = it.solve(point)
        np.testing.assert_array_equal(one.outputs, alone.outputs)
        np.testing.assert_array_equal(one.outputs, plain.outputs)
        np.testing.assert_array_equal(one.jacobian, alone.jacobian)
    assert isinstance(found[3], SolveError)
    assert sum(isinstance(one, SolveError) for one in found) < 4


def test_incompressible_closed_forms():
    """The formulas of any W(I1, I2), here with its slopes C1 and C2."""
    x, C1, C2 = np.array([0.6, 0.9, 1.3, 2.5]), 1e4, 3e4
    modes = ("uniaxial", "pure-shear", "equibiaxial", "simple-shear")
    tests = [MaterialTest(mode=mode, at=tuple(x)) for mode in modes]
    found = model("mooney-rivlin", {"C1": C1, "C2": C2}, *tests).stresses(np.array([[C1, C2]])).reshape(4, -1)
    np.testing.assert_allclose(found[0], 2 * (x - x**-2) * (C1 + C2 / x), rtol=1e-13)
    np.testing.assert_allclose(found[1], 2 * (x - x**-3) * (C1 + C2), rtol=1e-13)
    np.testing.assert_allclose(found[2], 2 * (x - x**-5) * (C1 + x**2 * C2), rtol=1e-13)
    np.testing.assert_allclose(found[3], 2 * x * (C1 + C2), rtol=1e-13)


def test_both_stresses_of_a_biaxial_test():
    """σ1 − σ3 = 2(λ1² − λ3²)(C1 + λ2² C2) and the same with 1 and 2 exchanged: R. S. Rivlin, D. W. Saunders (1951)."""
    x, z, C1, C2 = np.array([1.2, 1.3, 0.8, 2.0]), np.array([1.1, 0.9, 1.0, 1.5]), 1e4, 3e4
    for mode, across in (("biaxial", z), ("pure-shear", np.ones(4))):
        given = {"mode": mode, "at": tuple(x), "across": tuple(across) if mode == "biaxial" else None}
        free = (x * across) ** -2.0
        sigma = [2 * (a**2 - free) * (C1 + b**2 * C2) for a, b in ((x, across), (across, x))]
        for stress, scale in (("cauchy", (1, 1)), ("nominal", (x, across))):
            first, second = (one / by for one, by in zip(sigma, scale, strict=True))
            for component, exact in (("P1", first), ("P2", second), ("P1-P2", first - second)):
                test = MaterialTest(**given, stress=stress, component=component)
                found = model("mooney-rivlin", {"C1": C1, "C2": C2}, test)
                np.testing.assert_allclose(_at(found), exact, rtol=1e-12, atol=1e-9)
    assert MaterialTest(mode="pure-shear", at=(1.1,), component="P2").label == "pure-shear P2"


@pytest.mark.parametrize("kind", ["mooney-rivlin", "blatz-ko"])
def test_stresses_across_of_compressible_materials(kind):
    """What acts across is what acts along the specimen turned by a right angle, and so are its derivatives."""
    values = CONSTANTS[kind] | ({"D1": 3e4} if kind == "mooney-rivlin" else {})
    point = np.array([list(values.values())])
    for stress in ("nominal", "cauchy"):
        turned = MaterialTest(mode="biaxial", at=(1.1, 0.9), across=(1.2, 1.3), stress=stress)
        along = model(kind, values, turned).stresses_and_derivatives(point)
        here = {"mode": "biaxial", "at": (1.2, 1.3), "across": (1.1, 0.9), "stress": stress}
        whole = [
            model(kind, values, MaterialTest(**here, component=c)).stresses_and_derivatives(point)
            for c in ("P1", "P2", "P1-P2")
        ]
        for one, two, difference, other in zip(*whole, along, strict=True):
            np.testing.assert_allclose(two, other, rtol=1e-10)
            np.testing.assert_allclose(difference, one - two, rtol=1e-9, atol=1e-9 * np.abs(one).max())


def test_ogden_with_exponents_two_and_minus_two_is_mooney_rivlin():
    """W = μ1/2 (I1 − 3) − μ2/2 (I2 − 3) for exponents 2 and −2, so that C1 = μ1/2 and C2 = −μ2/2."""
    for volume in ({}, {"D1": 2e4}):
        one = model("mooney-rivlin", {"C1": 1e4, "C2": 3e4} | volume)
        values = {"mu1": 2e4, "alpha1": 2.0, "mu2": -6e4, "alpha2": -2.0, "mu3": 0.0, "alpha3": 1.0}
        other = model("ogden", values | volume)
        np.testing.assert_allclose(_at(one), _at(other), rtol=1e-9, atol=1e-6)


def _at(model: HomogeneousModel) -> np.ndarray:
    return model.stresses(model._values[model._varied][None, :])[0]


@pytest.mark.parametrize(
    ("kind", "values"), CASES, ids=lambda v: v if isinstance(v, str) else " D1"[3 * ("D1" not in v) :]
)
def test_derivatives(kind, values):
    """Taylor remainders along every constant fall by four when the step is halved."""
    it = model(kind, values)
    point = np.array(list(values.values()))
    stress, slopes = it.stresses_and_derivatives(point[None, :])
    assert np.isfinite(stress).all()
    np.testing.assert_allclose(stress, it.stresses(point[None, :]), rtol=1e-13, atol=1e-9)
    for i, value in enumerate(point):
        steps = 1e-2 * value * np.array([1, 0.5])
        moved = np.tile(point, (2, 1))
        moved[:, i] += steps
        remainder = np.abs(it.stresses(moved) - stress - steps[:, None] * slopes[0, :, i]).max(axis=1)
        linear = remainder.max() < 1e-9 * np.abs(stress).max()
        assert linear or remainder[0] / remainder[1] == pytest.approx(4, abs=0.3)


@pytest.mark.parametrize(
    ("kind", "values"), CASES, ids=lambda v: v if isinstance(v, str) else " D1"[3 * ("D1" not in v) :]
)
def test_small_strains_are_linear_elasticity(kind, values):
    e = 1e-5
    if "k1" in values:  # fibres, which are not linear at zero
        values = values | {"k1": 0.0}
    modes = ("uniaxial", "pure-shear") if "k1" in values else ("uniaxial", "equibiaxial", "pure-shear")
    tests = [MaterialTest(mode=mode, at=(1 + e, 1 - e)) for mode in modes]
    tests.append(MaterialTest(mode="simple-shear", at=(e, -e)))
    found = _at(model(kind, values, *tests)).reshape(-1, 2)
    slopes = (found[:, 0] - found[:, 1]) / (2 * e)
    incompressible = "D1" in constants(MATERIALS[kind]) and "D1" not in values
    mu, kappa = small_strain_moduli(kind, values | ({"D1": 1.0} if incompressible else {}))
    kappa = np.inf if incompressible else kappa
    nu = 0.5 if np.isinf(kappa) else (3 * kappa - 2 * mu) / (2 * (3 * kappa + mu))
    E = 2 * mu * (1 + nu)
    expected = {"uniaxial": E, "equibiaxial": E / (1 - nu), "pure-shear": E / (1 - nu**2), "simple-shear": mu}
    np.testing.assert_allclose(slopes, [expected[test.mode] for test in tests], rtol=1e-6)


@pytest.mark.fem
@pytest.mark.parametrize("kind", ["mooney-rivlin", "ogden", "holzapfel-gasser-ogden"])
def test_finite_elements_agree(kind):
    """A block between smooth plates deforms homogeneously; its force over its area is the stress."""
    values = CONSTANTS[kind] | {"D1": 5e4}
    fibres = {"fibres": [[1.0, 0.0, 0.0]]} if "i4" in measures(kind) else {}
    spec = Hyperelastic.model_validate(
        {
            "body": {"kind": "box", "size": [1.0, 1.0, 1.0], "cells": [1, 1, 1], "cell": "hexahedron", "degree": 1},
            "material": {"kind": kind} | values | fibres,
            "displacements": [
                {"on": "x-min", "name": "a", "x": 0.0},
                {"on": "y-min", "name": "b", "y": 0.0},
                {"on": "z-min", "name": "c", "z": 0.0},
                {"on": "x-max", "name": "pull", "x": 0.0},
            ],
            "outputs": [{"name": "force", "kind": "reaction", "on": "x-max", "component": "x"}],
            "solver": {"tolerance": 1e-12},
        }
    )
    name = next(iter(values))
    body = spec.build(MPI.COMM_SELF, ("displacements.pull.x", f"material.{name}"))
    pulled = [body.solve(np.array([stretch - 1, values[name]])) for stretch in STRETCHES]
    point = model(kind, values, MaterialTest(mode="uniaxial", at=STRETCHES))
    stress, slopes = point.stresses_and_derivatives(np.array([list(values.values())]))
    np.testing.assert_allclose([solution.outputs[0] for solution in pulled], stress[0], rtol=1e-10)
    along = [solution.tangent(np.array([0.0, 1.0]))[0] for solution in pulled]
    np.testing.assert_allclose(along, slopes[0, :, 0], rtol=1e-9, atol=1e-12)


def test_arteries_in_biaxial_tension():
    """Two families at ± φ to the first stretch: P₁ = c(λ₁ − λ₃²/λ₁) + 4 k₁ λ₁ cos²φ x exp(k₂ x²), x = ⟨I4 − 1⟩."""
    c, k1, k2, phi = 1e4, 5e3, 0.8, 0.6
    direction = (np.cos(phi), np.sin(phi), 0.0)
    mirrored = (np.cos(phi), -np.sin(phi), 0.0)
    first, second = np.array([1.1, 1.3, 0.8]), np.array([1.05, 0.9, 0.9])
    test = MaterialTest(mode="biaxial", at=tuple(first), across=tuple(second))
    it = HomogeneousModel("holzapfel-gasser-ogden", {"c": c, "k1": k1, "k2": k2}, [test], (), (direction, mirrored))
    x = np.maximum((first * np.cos(phi)) ** 2 + (second * np.sin(phi)) ** 2 - 1, 0)
    expected = c * (first - 1 / (first**3 * second**2)) + 4 * k1 * first * np.cos(phi) ** 2 * x * np.exp(k2 * x**2)
    np.testing.assert_allclose(it.stresses(np.zeros((1, 0)))[0], expected, rtol=1e-12)


def test_fibres_that_a_test_would_shear_are_refused():
    values = {"c": 1e4, "k1": 5e3, "k2": 0.8}
    for mode, fibres, told in (
        ("uniaxial", [(1.0, 1.0, 0.0)], "would shear"),
        ("uniaxial", [(1.0, 1.0, 0.0), (1.0, -1.0, 0.0)], "stretch unequally"),
        ("equibiaxial", [(1.0, 0.0, 0.0)], "stretch unequally"),
        ("uniaxial", [], "expected fibres"),
    ):
        with pytest.raises(ValidationError, match=told):
            stated("holzapfel-gasser-ogden", values, [{"mode": mode, "at": [1.1]}], fibres)
    for mode, fibres in (("equibiaxial", [(1.0, 1.0, 0.0), (1.0, -1.0, 0.0)]), ("simple-shear", [(1.0, 2.0, 3.0)])):
        stated("holzapfel-gasser-ogden", values, [{"mode": mode, "at": [1.1]}], fibres).build(MPI.COMM_SELF, ())
    with pytest.raises(ValidationError, match="has no fibres"):
        stated("neo-hookean", {"C1": 1.0}, [{"mode": "uniaxial", "at": [1.1]}], [(1.0, 0.0, 0.0)])


def test_many_parameter_sets_at_once():
    it = model("gent", {"mu": 1e4, "Jm": 30.0})
    points = np.array([[1e4, 30.0], [2e4, 20.0], [3e4, 0.01]])
    found = it.stresses(points)
    np.testing.assert_array_equal(found[1], it.stresses(points[1:2])[0])
    assert np.isfinite(found[:2]).all()
    assert np.isnan(found[2]).any()  # the chains are stretched out
    with pytest.raises(SolveError, match=r"no stress in the test uniaxial nominal.1"):
        it.solve(points[2])
    solution = it.solve(points[0])
    np.testing.assert_array_equal(solution.outputs, found[0])
    np.testing.assert_allclose(solution.tangent(np.array([1e4, 0.0])), found[0], rtol=1e-12)  # P is linear in μ


@pytest.mark.unit
def test_mistakes_are_named():
    for settings, told in (
        ({"mode": "uniaxial", "at": (0.0,)}, "stretch 0"),
        ({"mode": "biaxial", "at": (1.1,)}, "across"),
        ({"mode": "uniaxial", "at": (1.1,), "across": (1.0,)}, "across"),
        ({"mode": "biaxial", "at": (1.1, 1.2), "across": (1.0,)}, "1 stretches, expected as many as in at: 2"),
        ({"mode": "uniaxial", "at": (1.1,), "component": "P2"}, "nothing acts across"),
    ):
        with pytest.raises(ValidationError, match=told):
            MaterialTest.model_validate(settings)
    for values, told in (({"C1": 1.0, "C3": 1.0}, "'C3' is no constant"), ({"C1": 1.0}, "missing: C2, expected in")):
        with pytest.raises(ValidationError, match=told):
            stated("mooney-rivlin", values, [{"mode": "uniaxial", "at": [1.1]}])
