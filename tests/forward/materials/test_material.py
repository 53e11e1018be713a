"""Energies that come from outside, in a file beside a study, work wherever the program's own do."""

import re
import sys

import numpy as np
import pytest
from mpi4py import MPI

from forward.conformance import check_derivatives
from forward.hyperelastic import Hyperelastic
from forward.materials.admissible import Materials, admissible, moduli
from forward.materials.material import MATERIALS, constants, measures
from forward.materials.material_point import HomogeneousModel, MaterialTest
from tests.bodies import loaded_body
from tests.launch import report_of_own
from tests.steps import STEPS

OUTSIDE = '''
from typing import Annotated, Any

from annotated_types import Gt, Unit

from forward.materials.energies import Number
from forward.materials.material import with_volume


def fung(ops, i1, j, *, c: Annotated[float, Gt(0), Unit("Pa")], b: Annotated[float, Gt(0)], D1: Number):
    """Isotropic Fung: W = c/(2b) (exp(b(I1-3)) - 1) + D1(J-1)^2."""
    return c / (2 * b) * ops.expm1(b * i1) + D1 * j**2


def log_volume(ops, j, *, kappa: Number):
    """U = kappa/2 (ln J)^2."""
    return kappa / 2 * ops.log1p(j) ** 2


def mixed_volume(ops, j, *, kappa: Number):
    """U = kappa/4 (J^2 - 1 - 2 ln J)."""
    return kappa / 4 * (j * (2 + j) - 2 * ops.log1p(j))


def square_volume(ops, j, *, kappa: Number):
    """U = kappa/2 (J - 1)^2, which is said of D1 = kappa/2 otherwise."""
    return kappa / 2 * j**2


@with_volume(log_volume)
def of_log(ops, i1, *, C1: Number):
    """Neo-Hookean with a logarithm of the volume: W = C1(I1-3) + kappa/2 (ln J)^2."""
    return C1 * i1


@with_volume(mixed_volume)
def of_both(ops, i1, *, C1: Number):
    return C1 * i1


@with_volume(square_volume)
def of_square(ops, i1, *, C1: Number):
    return C1 * i1


def not_at_rest(ops, i1, j, *, c: Number, D1: Number):
    return c * (i1 - 3) + D1 * j**2


def other_D1(ops, i1, j, *, c: Number, D1: Number):
    return c * i1 + D1 * j**4


def of_math(ops, i1, j, *, c: Number, D1: Number):
    import math

    return c * math.exp(i1) + D1 * j**2


def of_words(ops, I1, *, c: Number):
    return c * I1


def no_constants(ops, i1):
    return i1


number = 3
'''
FUNG = {"kind": "my_tissue.fung", "c": 4e4, "b": 1.5, "D1": 2e5}
DEMIRAY = {"kind": "demiray", "a": 4e4, "b": 1.5, "D1": 2e5}


@pytest.fixture(autouse=True)
def outside(tmp_path, monkeypatch):
    (tmp_path / "my_tissue.py").write_text(OUTSIDE)
    monkeypatch.syspath_prepend(tmp_path)
    yield tmp_path
    sys.modules.pop("my_tissue", None)


def body(material):
    return Hyperelastic.model_validate(loaded_body("demiray").model_dump() | {"material": material})


def test_what_is_known_of_an_energy():
    assert measures("my_tissue.fung") == ("i1", "j")
    spec = body(FUNG)
    units = {path: one.unit for path, one in spec.scalars.items() if path.startswith("material.")}
    assert units == {"material.c": "Pa", "material.b": "1", "material.D1": "Pa"}
    assert spec.scalars["material.b"].objection(-1.0) is not None
    assert spec.model_dump()["material"] == FUNG
    assert Hyperelastic.model_validate(spec.model_dump(mode="json")) == spec


def test_moduli_are_found_of_numbers_and_arrays():
    numbers = {name: value for name, value in DEMIRAY.items() if name != "kind"}
    renamed = {name: value for name, value in FUNG.items() if name != "kind"}
    assert moduli("my_tissue.fung", renamed) == pytest.approx(moduli("demiray", numbers), rel=1e-9)
    c = np.array([-1.0, 2.0, 4e4])
    shear, bulk = moduli("my_tissue.fung", renamed | {"c": c})
    np.testing.assert_allclose(shear, c, rtol=1e-7, atol=1e-6)
    np.testing.assert_allclose(bulk, 4e5, rtol=1e-9)
    np.testing.assert_array_equal(admissible("my_tissue.fung", renamed | {"c": c}), [False, True, True])
    del renamed["D1"]
    assert moduli("my_tissue.fung", renamed)[1] == np.inf
    materials = Materials("my_tissue.of_log", {"material": {"C1": 1.0, "kappa": "kappa"}})
    assert materials.objection({"kappa": -3.0}) == "material: not stable at rest: κ = -3 Pa, expected more than 0"


@pytest.mark.parametrize(
    ("material", "said"),
    [
        (FUNG | {"kind": "my_tissue.fng"}, "did you mean 'fung'?"),
        (FUNG | {"b": -1.0}, "greater than 0"),
        (FUNG | {"e": 1.0}, "unknown key"),
        ({"kind": "my_tissue.not_at_rest", "c": 1e4, "D1": 1e5}, "energy of the undeformed body is -3e+04 J/m³"),
        ({"kind": "my_tissue.other_D1", "c": 1e4, "D1": 1e5}, "D1 is the constant of a part D1(J−1)²"),
        ({"kind": "my_tissue.of_math", "c": 1e4, "D1": 1e5}, "must use the operators that it is given"),
        ({"kind": "my_tissue.of_words", "c": 1e4}, "'I1' is no measure of a deformation, expected some of: i1"),
        ({"kind": "my_tissue.no_constants"}, "expected its constants as keyword-only arguments"),
        ({"kind": "my_tissue.number"}, "expected a function"),
        ({"kind": "my_tissue.of_log", "C1": -1e4, "kappa": 1e5}, "not stable at rest: μ = -20000 Pa"),
    ],
)
def test_what_is_no_energy_is_refused(material, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        body(material)


@pytest.mark.parametrize("D1", [True, False])
def test_material_points_are_those_of_the_same_energy(D1):
    tests = [MaterialTest(mode="uniaxial", at=(0.8, 1.3)), MaterialTest(mode="simple-shear", at=(0.2,))]
    left_out = {"kind"} if D1 else {"kind", "D1"}
    own = {name: value for name, value in DEMIRAY.items() if name not in left_out}
    ours = HomogeneousModel("demiray", own, tests, ["a"])
    theirs = HomogeneousModel(
        "my_tissue.fung", {name: value for name, value in FUNG.items() if name not in left_out}, tests, ["c"]
    )
    for a, b in zip(
        ours.stresses_and_derivatives(np.array([[4e4]])),
        theirs.stresses_and_derivatives(np.array([[4e4]])),
        strict=True,
    ):
        np.testing.assert_array_equal(a, b)


def test_an_incompressible_one_has_no_constants_of_the_volume():
    tests = [MaterialTest(mode="uniaxial", at=(1.3,))]
    (found,) = HomogeneousModel("my_tissue.of_log", {"C1": 1e4}, tests, []).solve(np.zeros(0)).outputs
    assert found == pytest.approx(2e4 * (1.3 - 1.3**-2), rel=1e-12)
    assert set(constants("my_tissue.of_log")) == {"C1", "kappa"}
    assert MATERIALS["my_tissue.of_log"].__doc__.startswith("Neo-Hookean with a logarithm")


@pytest.mark.fem
def test_a_body_is_that_of_the_same_energy():
    """To the bit: the forms are the same."""
    ours, theirs = (
        body(material).build(MPI.COMM_SELF, (f"material.{name}", "material.D1"))
        for material, name in ((DEMIRAY, "a"), (FUNG, "c"))
    )
    point = np.array([4e4, 2e5])
    a, b = ours.solve(point), theirs.solve(point)
    np.testing.assert_array_equal(a.outputs, b.outputs)
    np.testing.assert_array_equal(a.adjoint(np.eye(len(a.outputs))), b.adjoint(np.eye(len(b.outputs))))


def mixed(kind, kappa, cells=2, form="mixed"):
    """A block that is pressed and sheared, of quadratic tetrahedra."""
    blocks = {
        "formulation": form,
        "body": {"kind": "box", "size": (1.0, 1.0, 1.0), "cells": (cells,) * 3, "cell": "tetrahedron", "degree": 2},
        "material": {"kind": kind, "C1": 1e4, **({"D1": kappa / 2} if kind == "neo-hookean" else {"kappa": kappa})},
        "clamp": ("z-min",),
        "loads": ({"kind": "traction", "on": "z-max", "direction": (0.3, 0.0, -1.0), "size": 3e3},),
        "outputs": (
            {"kind": "mean-displacement", "name": "down", "on": "z-max", "component": "z"},
            {"kind": "mean-displacement", "name": "aside", "on": "z-max", "component": "x"},
            {"kind": "volume-change", "name": "volume"},
            {"kind": "strain-energy", "name": "energy"},
        ),
        "solver": {"tolerance": 1e-12},
    }
    return Hyperelastic.model_validate(blocks)


@pytest.mark.fem
def test_a_stated_square_is_the_form_of_D1():
    """The integral over the curvature is exact for a square, whose mixed form is written otherwise."""
    ours = mixed("neo-hookean", 1e6).build(MPI.COMM_SELF, ()).solve(np.zeros(0)).outputs
    theirs = mixed("my_tissue.of_square", 1e6).build(MPI.COMM_SELF, ()).solve(np.zeros(0)).outputs
    np.testing.assert_allclose(theirs, ours, rtol=1e-8)


@pytest.mark.few(1)
@pytest.mark.fem
@pytest.mark.parametrize("kind", ["my_tissue.of_log", "my_tissue.of_both"])
def test_stated_volumes_have_a_mixed_form_that_agrees_with_displacements(kind):
    """At a moderate κ/μ = 3, where neither locks: both tend to the same as cells become smaller."""
    by_form = {
        form: [mixed(kind, 6e4, cells, form).build(MPI.COMM_SELF, ()).solve(np.zeros(0)).outputs for cells in (1, 2, 4)]
        for form in ("mixed", "displacement")
    }
    apart = [np.abs(a / b - 1).max() for a, b in zip(*by_form.values(), strict=True)]
    assert apart[2] < apart[1] / 2 < apart[0] / 3
    assert apart[2] < 1e-2


@pytest.mark.fem
@pytest.mark.parametrize("ratio", [1.0, 1e4])
@pytest.mark.parametrize("kind", ["my_tissue.of_log", "my_tissue.of_both"])
def test_a_mixed_form_that_is_stated_is_exact_where_the_strain_is_the_same_everywhere(kind, ratio):
    """Held against material points: large changes of volume, and none."""
    constants_ = {"C1": 1e4, "kappa": 2e4 * ratio}
    test = MaterialTest(mode="uniaxial", at=(1.6,))
    (stress,) = HomogeneousModel(kind, constants_, [test], []).solve(np.zeros(0)).outputs
    blocks = mixed(kind, constants_["kappa"], 1).model_dump()
    held = tuple({"on": f"{axis}-min", axis: 0.0} for axis in "xyz")
    traction = {"kind": "traction", "on": "z-max", "direction": (0.0, 0.0, 1.0), "size": stress}
    spec = Hyperelastic.model_validate(blocks | {"clamp": (), "displacements": held, "loads": (traction,)})
    found = dict(zip(spec.outputs, spec.build(MPI.COMM_SELF, ()).solve(np.zeros(0)).outputs, strict=True))
    by_name = {output.name: value for output, value in found.items()}
    assert by_name["down"] == pytest.approx(0.6, rel=1e-9)
    assert (abs(by_name["volume"]) > 0.1) == (ratio == 1)


@pytest.mark.fem
def test_derivatives_of_a_mixed_form_that_is_stated():
    names = ("material.C1", "material.kappa")
    model = mixed("my_tissue.of_log", 1e6, 1).build(MPI.COMM_SELF, names)
    check_derivatives(model, (1e4, 1e6), (2e3, 3e5), steps=STEPS).require()


STUDY = """
[model]
kind = "hyperelastic"
body = { kind = "box", size = [1, 0.7, 0.8], cells = [2, 1, 1], cell = "tetrahedron", degree = 1 }
material = { kind = "my_tissue.fung", c = 4e4, b = 1.5, D1 = 2e5 }
clamp = ["x-min"]
loads = [{ kind = "gravity", direction = [0, -1, 0], density = 750 }]
outputs = [{ name = "down", kind = "max-displacement", component = "y" }]

[parameters]
"material.c" = { kind = "uniform", lower = 2e4, upper = 6e4 }

[method]
kind = "sensitivity-monte-carlo"
samples = 8
seed = 1
"""


@pytest.mark.slow
@pytest.mark.fem
def test_a_study_is_checked_and_run(outside, undrawn):
    assert "Isotropic Fung" in report_of_own(outside, STUDY)
