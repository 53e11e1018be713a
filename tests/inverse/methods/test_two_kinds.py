"""Data of two kinds in one inversion: a body under load and tests of its material, with constants that they share."""

import numpy as np
import pytest
from mpi4py import MPI
from pydantic import ValidationError
from scipy.integrate import trapezoid
from scipy.stats import norm

import forward.finer_meshes
from forward.conformance import check_derivatives
from forward.fem.finer import extrapolated
from forward.hyperelastic import Hyperelastic
from forward.joined_models import JoinedModels
from forward.material_tests import MaterialTests
from forward.materials.material_point import HomogeneousModel
from workflows.config.mistakes import StudyError
from workflows.config.study import document, parse

C1, D1 = 1e4, 3e5
MATERIAL = {"kind": "neo-hookean", "C1": C1, "D1": D1}
# The forms are those of `tests.bodies.cantilever`.
BODY = {
    "kind": "hyperelastic",
    "formulation": "displacement",
    "body": {"kind": "box", "size": [1.0, 0.5, 0.5], "cells": [2, 1, 1], "cell": "hexahedron"},
    "material": MATERIAL,
    "clamp": ["x-min"],
    "loads": [{"kind": "traction", "on": "x-max", "direction": [0, -1, 0], "size": 1e3}],
    "outputs": [{"name": "tip", "kind": "mean-displacement", "on": "x-max", "component": "y"}],
}
TESTS = {
    "kind": "material-tests",
    "material": MATERIAL,
    "tests": [{"mode": "uniaxial", "at": [1.1, 1.3]}, {"mode": "simple-shear", "at": [0.2]}],
}
MODEL = {"kind": "joined", "models": {"block": BODY, "strip": TESTS}, "shared": ["material.C1", "material.D1"]}
PRIOR = {"material.C1": {"kind": "log-normal", "mean": 1e4, "std": 4e3}}
POINT = np.array([C1])


@pytest.fixture(scope="module")
def joined():
    """Both models, as one of C1 and of the traction, which only the body has."""
    spec = JoinedModels.model_validate(MODEL)
    return spec.build(MPI.COMM_SELF, ("material.C1", "block.loads.traction.size"))


def test_values_are_those_of_each_and_derivatives_are_right(joined):
    point = np.array([1.1e4, 900.0])
    alone = Hyperelastic.model_validate(BODY).build(MPI.COMM_SELF, ("material.C1", "loads.traction.size"))
    tests = MaterialTests.model_validate(TESTS).build(None, ("material.C1",))
    found = joined.solve(point)
    np.testing.assert_array_equal(
        found.outputs, [*alone.solve(point).outputs, *tests.solve(point[:1]).outputs], strict=True
    )
    assert joined.outputs == ("block.tip", "strip.uniaxial.1", "strip.uniaxial.2", "strip.simple-shear")
    check_derivatives(joined, point, [1e3, 100.0]).require()
    error, own = found.mesh_error(), alone.solve(point).mesh_error()
    np.testing.assert_array_equal(error.outputs, [*own.outputs, 0.0, 0.0, 0.0])


def test_finer_meshes_are_those_of_the_body_and_leave_tests_as_they_are(joined, monkeypatch):
    """What it tends to and the gap between two meshes: of the body as alone, of tests themselves and zero."""
    monkeypatch.setattr(forward.finer_meshes, "LEAST", {1.5: 2, 1.0: 1})
    point = np.array([1.1e4, 900.0])
    fine = extrapolated(joined).of(joined).solve(point)
    body = joined.models[0].model
    alone = extrapolated(body).of(body).solve(point)
    tests = joined.solve(point).outputs[1:]
    np.testing.assert_array_equal(fine.outputs, [alone.outputs[0], *tests, alone.outputs[1], 0.0, 0.0, 0.0])
    slopes = fine.tangent(np.eye(2))
    np.testing.assert_array_equal(slopes[:, [0, 4]], alone.tangent(np.eye(2)))
    np.testing.assert_allclose(fine.adjoint(np.eye(8)).T, slopes, rtol=1e-9, atol=1e-9 * abs(slopes).max())


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """An inversion for C1 of a displacement and three stresses, made with C1 = 1.2e4 and errors."""
    folder = tmp_path_factory.mktemp("two-kinds")
    spec = JoinedModels.model_validate(MODEL)
    exact = spec.build(MPI.COMM_SELF, ("material.C1",)).solve(np.array([1.2e4])).outputs
    sigma = np.array([0.1, 0.1, 0.08, 0.1]) * abs(exact)
    values = exact + sigma * [0.5, -1.2, 0.7, 0.3]
    rows = [f"{v!r},{s!r}\n" for v, s in zip(values.tolist(), sigma.tolist(), strict=True)]
    (folder / "block.csv").write_text(f"# truth.loads.traction.size = 1000\noutput,value,sigma\ntip,{rows[0]}")
    (folder / "strip.csv").write_text(
        f"# truth.material.C1 = 12000\noutput,value,sigma\n"
        f"uniaxial.1,{rows[1]}uniaxial.2,{rows[2]}simple-shear,{rows[3]}"
    )
    blocks = {
        "model": MODEL,
        "parameters": PRIOR,
        "data": {"tables": {"block": "block.csv", "strip": "strip.csv"}},
        "method": {"kind": "invert", "samples": 64, "starts": 1, "draws": 100, "mesh_error": False},
    }
    return folder, blocks, values, sigma


@pytest.mark.slow
def test_the_posterior_is_that_of_the_product_of_the_likelihoods(study, tmp_path):
    """Against quadrature over the likelihoods of the displacement and of the stresses, each of a model of its own."""
    folder, blocks, values, sigma = study
    it = parse(blocks, folder=folder)
    found = it.run(tmp_path / "out")
    scale, shape = 1e4 / np.sqrt(1.16), np.sqrt(np.log(1.16))  # of a log-normal of mean 1e4 and deviation 4e3
    x = np.linspace(-0.6, 1.8, 25)  # ln C1 in standard deviations of the prior
    C = scale * np.exp(shape * x)
    body = Hyperelastic.model_validate(BODY).build(MPI.COMM_SELF, ("material.C1",))
    strip = HomogeneousModel("neo-hookean", {"D1": D1}, MaterialTests.model_validate(TESTS).tests, ("C1",))
    of_block = np.array([norm.logpdf(values[0], body.solve(np.array([c])).outputs[0], sigma[0]) for c in C])
    of_strip = norm.logpdf(values[1:], strip.stresses(C[:, None]), sigma[1:]).sum(axis=1)
    density = norm.pdf(x) * np.exp(of_block + of_strip)
    assert density[[0, -1]].max() < 1e-6 * density.max()  # beyond, the data are far away
    evidence, mean, square = (trapezoid(part, x) for part in (density, C * density, C**2 * density))
    mean, std = mean / evidence, np.sqrt(square / evidence - (mean / evidence) ** 2)
    log_evidence, error = (float(found[name].squeeze()) for name in ("log_evidence", "log_evidence_error"))
    assert abs(log_evidence - np.log(evidence)) < 3 * error + 1e-6
    assert float(found["mean"].squeeze()) == pytest.approx(mean, abs=0.05 * std)
    assert float(found["std"].squeeze()) == pytest.approx(std, rel=0.1)
    assert float(found["true"].squeeze()) == 1.2e4
    assert found.case.values.tolist() == ["block.tip", "strip.uniaxial.1", "strip.uniaxial.2", "strip.simple-shear"]


def test_a_study_is_written_and_read_again_and_counts_what_its_tables_hold(study, tmp_path):
    folder, blocks, *_ = study
    it = parse(blocks, folder=folder)
    assert parse(document(it), folder=folder) == it
    assert it.data.sets[0].name == "tables"
    assert it.measurements[0].truth == {"block.loads.traction.size": 1e3, "material.C1": 1.2e4}
    other = tmp_path / "other"
    other.mkdir()
    for name in ("block.csv", "strip.csv"):
        (other / name).write_text((folder / name).read_text().replace("12000", "12001"))
    assert parse(blocks, folder=other).data.sets[0].digest != it.data.sets[0].digest


def test_a_single_test_is_a_curve():
    """Its table has a column of stretches, as that of a path has one of depths."""
    one = MaterialTests.model_validate(TESTS | {"tests": [{"mode": "uniaxial", "at": [1.1, 1.3]}]})
    assert one.axes_of_outputs["stretch"] == ("1", [1.1, 1.3])
    assert [output.name for output in one.outputs] == ["uniaxial.1", "uniaxial.2"]
    assert not MaterialTests.model_validate(TESTS).axes_of_outputs


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"shared": ["material.C2"]}, "did you mean 'material.C1'"),
        ({"shared": ["loads.traction.size"]}, "not a number of two models"),
        ({"models": {"block": BODY, "strip": TESTS | {"material": {**MATERIAL, "C1": 2e4}}}}, "expected one value"),
        ({"models": {"block": BODY}}, "at least 2"),
        ({"models": {"block": BODY, "again": MODEL}}, "not here"),
        ({"models": {"a.b": BODY, "c": TESTS}}, "pattern"),
        (
            {"models": {"block": BODY, "strip": TESTS | {"material": {"kind": "yeoh", "C10": 1, "C20": 1, "C30": 1}}}},
            "expected one kind",
        ),
        ({"models": {"block": BODY, "strip": TESTS | {"material": {"kind": "neo-hookean"}}}}, "missing: C1"),
        ({"models": {"block": BODY, "strip": TESTS | {"material": {**MATERIAL, "C1": -1.0}}}}, "not stable at rest"),
    ],
)
def test_models_that_cannot_be_joined(change, said):
    with pytest.raises(ValidationError, match=said):
        JoinedModels.model_validate(MODEL | change)


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ({"block": "block.csv", "stripe": "strip.csv"}, "no model of this name; did you mean 'strip'"),
        ({"block": "block.csv", "strip": "lost.csv"}, "lost.csv: no such file"),
        ({"block": "strip.csv", "strip": "block.csv"}, "no output 'tip'"),
    ],
)
def test_tables_that_are_none(study, tables, said):
    folder, blocks, *_ = study
    with pytest.raises(StudyError, match=said):
        parse(blocks | {"data": {"tables": tables}}, folder=folder)


def test_candidates_of_joined_models_are_looked_at_on_finer_meshes(study):
    """The finer meshes are those of their bodies, as they are of an inversion."""
    folder, blocks, *_ = study
    candidates = {"one": {"parameters": PRIOR}}
    data = {"outputs": {"block.tip": -0.2, "strip.simple-shear": 4e3}, "sigma": {"block.tip": 0.1}}
    method = {"kind": "select", "noise": {"relative": 0.1}}
    it = parse({"model": MODEL, "candidates": candidates, "data": data, "method": method}, folder=folder)
    assert it.unchecked == {"one": ""}
    assert [spec.kind for spec in it.specs] == ["joined", "hyperelastic", "hyperelastic"]
    inverted = parse(blocks | {"method": {"kind": "invert"}}, folder=folder)
    assert inverted.specs[1:] == it.specs[1:]
