"""Which formulation a study takes, over the whole range of its inputs, and what it says where cells lock."""

import math

import numpy as np
import pytest
from mpi4py import MPI

from benchmarks import locking as benchmark
from forward.fem.locking import SWITCH, ratios
from forward.hyperelastic import Hyperelastic
from forward.materials.admissible import moduli
from workflows.config.mistakes import StudyError
from workflows.config.study import parse
from workflows.run.plan import plan

BEAM = {
    "body": {"kind": "box", "size": [0.28, 0.0215, 0.087], "cells": [4, 1, 2]},
    "material": {"kind": "mooney-rivlin", "C1": 1e4, "C2": 2e5, "D1": 3e5},
    "clamp": ["x-min"],
    "loads": [{"kind": "gravity", "direction": [0, -1, 0], "density": 750}],
    "outputs": [{"name": "uy_max", "kind": "max-displacement", "component": "y"}],
}
STIFF = {"kind": "uniform", "lower": 1e9, "upper": 2e9}


def study(parameters, **changes):
    blocks = {"model": BEAM | changes, "parameters": parameters, "method": {"kind": "local-sensitivity"}}
    return parse(blocks)


@pytest.mark.parametrize(
    ("parameters", "changes", "mixed"),
    [
        ({"material.D1": STIFF}, {}, True),  # the number as given is soft
        ({"material.D1": {"kind": "uniform", "lower": 2e5, "upper": 4e5}}, {}, False),
        ({"material.D1": {"kind": "log-normal", "mean": 3e5, "std": 3e5}}, {}, True),  # its tail is stiff
        ({"material.D1": {"kind": "log-normal", "mean": 3e5, "std": 3e4}}, {}, False),
        ({"material.C2": {"kind": "uniform", "lower": 1e3, "upper": 3e5}}, {}, True),  # μ is small where C2 is
        ({"material.C2": {"kind": "normal", "mean": 0.0, "std": 5e3}}, {}, True),  # μ vanishes where C2 = −C1
        # What is given as nearly incompressible, but never is so over the distribution.
        (
            {"material.D1": {"kind": "uniform", "lower": 2e5, "upper": 4e5}},
            {"material": {**BEAM["material"], "D1": 1e9}},
            False,
        ),
        # Inclusions and fields multiply both moduli.
        (
            {"inclusions.sphere.contrast": {"kind": "uniform", "lower": 1.0, "upper": 1e4}},
            {"inclusions": [{"x": 0.1, "y": 0.01, "z": 0.04, "radius": 0.02, "contrast": 2, "width": 0.08}]},
            False,
        ),
        ({"loads.gravity.density": {"kind": "uniform", "lower": 1, "upper": 2}}, {"formulation": "mixed"}, True),
        ({"material.D1": STIFF}, {"formulation": "displacement"}, False),
        ({"material.D1": STIFF}, {"body": {**BEAM["body"], "degree": 1}}, False),
    ],
)
def test_one_formulation_for_all_values_of_the_inputs(parameters, changes, mixed):
    found = study(parameters, **changes)
    assert found.spec.mixed == mixed
    assert {model.formulation for model in found.specs} == {"mixed" if mixed else "displacement"}
    assert (
        parse(
            {"model": found.model.model_dump(), "parameters": parameters, "method": found.method.model_dump()}
        ).spec.mixed
        == mixed
    )
    (line,) = [line for line in plan(found) if line.startswith("form ")]
    assert ("mixed" if mixed else "displacement") in line
    assert "κ/μ" in line


def test_all_meshes_and_models_of_a_study_have_its_formulation():
    found = parse(
        {
            "model": BEAM,
            "parameters": {"material.D1": STIFF},
            "method": {"kind": "multilevel-monte-carlo", "samples": 100},
        }
    )
    assert len(found.meshes) > 1
    assert all(mesh.mixed for mesh in found.meshes)


def test_ratios_are_those_of_samples():
    """Against random points of the box, of which none is beyond, and one is near each end."""
    parameters = {
        "material.C1": {"kind": "uniform", "lower": 1e4, "upper": 5e4},
        "material.C2": {"kind": "uniform", "lower": -5e3, "upper": 1e4},
        "material.D1": {"kind": "log-uniform", "lower": 1e5, "upper": 1e7},
    }
    found = study(parameters)
    low, high = ratios(found.model.materials(tuple(parameters)), {k: d.range for k, d in found.parameters.items()})
    points = found.inputs.points(np.random.default_rng(0).random((20000, 3)))
    values = dict(zip(("C1", "C2", "D1"), points.T, strict=True))
    mu, kappa = moduli("mooney-rivlin", values)
    assert (kappa / mu).min() >= low > 0.7 * (kappa / mu).min()
    assert (kappa / mu).max() <= high < 1.5 * (kappa / mu).max()


def test_constants_of_regions_decide_too(tmp_path):
    body = Hyperelastic.model_validate(BEAM)
    changed = body.model_copy(update={"regions": {"tumour": {"D1": 2e6}}})
    assert not body.mixed
    assert changed.mixed
    assert not changed.over({"regions.tumour.D1": (1e5, 2e5)}).mixed
    assert body.over({"regions.tumour.D1": (1e9, 2e9)}).formulation == "displacement"  # of no such region


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["hexahedron", "tetrahedron"])
def test_what_locks_says_so_with_its_size(cell, degree):
    body = {**BEAM["body"], "cell": cell, "degree": degree}
    (finding,) = study({"material.D1": STIFF}, body=body, formulation="displacement").findings
    assert finding.severity == "warning"
    assert "factors of" in finding.text
    soft = {"material.D1": {"kind": "uniform", "lower": 2e5, "upper": 4e5}}
    assert not study(soft, body=body, formulation="displacement").findings
    if degree == 1:
        (by_itself,) = study({"material.D1": STIFF}, body=body).findings
        assert by_itself == finding


def test_an_energy_that_does_not_split_says_so():
    material = {"kind": "neo-hookean-coupled", "mu": 1e4, "lmbda": 1e7}
    (finding,) = study({"material.mu": {"kind": "uniform", "lower": 1e4, "upper": 2e4}}, material=material).findings
    assert "an energy with a constant D1" in finding.text


@pytest.mark.fem
def test_the_forms_agree_where_they_are_switched():
    """Within about 1 %, on meshes as coarse as those of the benchmark."""
    for name, cells in (("cantilever", (5, 1, 1)), ("block", (2, 2, 1))):
        blocks, _, _ = benchmark.BODIES[name]
        outputs = []
        for formulation in ("displacement", "mixed"):
            spec = Hyperelastic.model_validate(
                blocks
                | {"formulation": formulation, "body": blocks["body"] | {"cells": cells}}
                | {"material": {"kind": "neo-hookean", "C1": 5e3, "D1": SWITCH * 5e3}}
            )
            outputs.append(spec.build(MPI.COMM_SELF, ()).solve(np.zeros(0)).outputs[0])
        assert outputs[0] == pytest.approx(outputs[1], rel=0.025)
        assert math.isfinite(outputs[0])


def test_a_formulation_that_cannot_be_is_still_refused():
    with pytest.raises(StudyError, match="not stable"):
        study({"material.D1": STIFF}, body={**BEAM["body"], "degree": 1}, formulation="mixed")
