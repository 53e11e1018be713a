"""Forces as data of specimens: derivatives, what displacements alone do not tell, tables, synthesis, comparison."""

import json

import numpy as np
import pytest
from mpi4py import MPI

from forward.conformance import check_derivatives
from forward.model import SolveError
from forward.specimen import Specimen
from inverse.data.scans import Scan, read
from inverse.data.table import DataError
from inverse.methods.mesh_correction import uncertain
from tests.launch import on_kept_ranks
from uq.evaluation.hdf5 import stored_dataset
from workflows.config.mistakes import StudyError
from workflows.config.study import load
from workflows.data.measured import motion_of
from workflows.run.run import run as run_study

CUBE = """
[model]
kind = "specimen"
body = { kind = "box", size = [0.05, 0.05, 0.05], cells = [CELLS, CELLS, CELLS], degree = 1 }
material = { kind = "neo-hookean-coupled", mu = 1e4, lmbda = 2e4 }
MORE
observed = [{ at = [[0.05, 0.0, 0.025], [0.05, 0.05, 0.025], [0.0, 0.05, 0.025], [0.05, 0.025, 0.0375]] }]

[[model.cases]]
name = "pull"
clamp = ["z-min"]
displacements = [{ on = "z-max", x = 0, y = 0, z = 0.004 }]
outputs = [{ name = "grip", kind = "reaction", on = "z-max", component = "z" }]

[[model.cases]]
name = "press"
clamp = ["z-min"]
outputs = [{ name = "force", kind = "force" }]
loads = [{ kind = "indenter", shape = "plane", on = "z-max", at = [0.025, 0.025, 0.05], direction = [0, 0, -1], depth = 0.004 }]
"""  # noqa: E501
LUMP = 'inclusions = [{ name = "lump", x = 0.03, y = 0.03, z = 0.03, radius = 0.015, contrast = 3, width = 0.01 }]'
FIELD = 'fields = [{ of = "stiffness", length = 0.03, std = 0.5, basis = "nodes" }]'
MADE = (
    CUBE.replace("CELLS", "3").replace("MORE", LUMP)
    + """
[method]
kind = "synthesize"
noise = { relative = 0.02 }
seed = 3
"""
)
PRIORS = """
[parameters]
"inclusions.lump.contrast" = { kind = "log-uniform", lower = 1, upper = 16 }
"material.mu" = { kind = "log-normal", mean = 1.3e4, std = 7e3 }
"material.lmbda" = { kind = "log-normal", mean = 2.6e4, std = 1.4e4 }
"""
FEW = (
    CUBE.replace("CELLS", "2").replace("MORE", LUMP)
    + PRIORS
    + """
[data]
files = ["data"]

[method]
kind = "invert"
samples = 32
starts = 1
draws = 50
mesh_error = false
"""
)
OF_FIELD = (
    CUBE.replace("CELLS", "2").replace("MORE", FIELD)
    + """
[data]
files = ["data"]

[method]
kind = "invert"
draws = 10
mesh_error = false
"""
)
SELECT = (
    CUBE.replace("CELLS", "2").replace("MORE", LUMP)
    + """
[data]
file = "data/made.csv"

[candidates.right]
parameters."inclusions.lump.contrast" = { kind = "log-uniform", lower = 1, upper = 16 }
parameters."material.mu" = { kind = "log-normal", mean = 1.3e4, std = 7e3 }

[candidates.soft]
model.material = { kind = "neo-hookean-coupled", mu = 3e3, lmbda = 6e3 }
parameters."inclusions.lump.contrast" = { kind = "log-uniform", lower = 1, upper = 16 }

[method]
kind = "select"
samples = 32
starts = 1
noise = {}
mesh_error = false
"""
)
RATIOS = "displacements tell ratios of stiffnesses only"


def here(path, out, *, report=False):
    return run_study(load(path), path.stem, out, quiet=True, report=report)


def results(out):
    return stored_dataset(out / "results.nc").isel(data_set=0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Studies, with displacements and forces of a specimen, and the same displacements without the forces."""
    place = tmp_path_factory.mktemp("forces")
    for name, text in (("made", MADE), ("few", FEW), ("field", OF_FIELD), ("select", SELECT)):
        (place / f"{name}.toml").write_text(text)
    assert here(place / "made.toml", place / "made") == 0
    (place / "made" / "data").rename(place / "data")
    lines = (place / "data" / "made.csv").read_text().splitlines()
    (place / "blind").mkdir()
    (place / "blind" / "made.csv").write_text("\n".join(line for line in lines if not line.startswith(",,,")))
    (place / "blind.toml").write_text(FEW.replace('["data"]', '["blind"]'))
    (place / "blind-field.toml").write_text(OF_FIELD.replace('["data"]', '["blind"]'))
    return place


# --- derivatives -----------------------------------------------------------------------------------------------------


def specimen(fields=()):
    pulled = {"name": "pull", "clamp": ("z-min",), "displacements": ({"on": "z-max", "x": 0.0, "y": 0.0, "z": 0.1},)}
    ball = {"kind": "indenter", "shape": "sphere", "radius": 0.8, "on": "z-max", "depth": 0.1}
    ball |= {"at": (0.5, 0.5, 1.0), "direction": (0, 0, -1)}
    held = {"kind": "reaction", "name": "grip", "on": "z-max", "component": "z"}
    return Specimen.model_validate(
        {
            "body": {"size": (1.0, 1.0, 1.0), "cells": (2, 2, 2), "degree": 1},
            "material": {"kind": "neo-hookean-coupled", "mu": 1e4, "lmbda": 2e4},
            "fields": fields,
            "cases": (
                {"name": "press", "clamp": ("z-min",), "loads": (ball,), "outputs": ({"kind": "force", "name": "F"},)},
                pulled | {"outputs": (held, {"kind": "strain-energy", "name": "work"})},
            ),
            "observed": ({"at": ((1.0, 0.5, 0.5),), "components": "xz"},),
            "solver": {"tolerance": 1e-12},
        }
    )


NUMBERS = ("material.mu", "loads.indenter.depth", "displacements.z-max.z")


def test_forces_follow_the_displacements_of_their_load_case_and_have_derivatives():
    model = specimen().build(MPI.COMM_SELF, NUMBERS)
    assert model.outputs[2] == "press.F"
    assert model.outputs[-2:] == ("pull.grip", "pull.work")
    point = np.array([1e4, 0.1, 0.1])
    found = check_derivatives(model, point, [300.0, 2e-3, 3e-3], steps=(1 / 8, 1 / 16, 1 / 32), accuracy=1e-10)
    found.require()
    force, work = model.solve(point).outputs[[2, -1]]
    assert force > 0
    slope = model.solve(point).tangent(np.array([0.0, 0.0, 1.0]))  # what moves a face does work by its reaction
    assert slope[-1] == pytest.approx(model.solve(point).outputs[-2], rel=1e-6)
    assert work > 0


def test_adjoints_of_forces_see_every_node_of_a_field():
    spec = specimen(({"of": "stiffness", "length": 0.5, "std": 0.4, "basis": "nodes"},))
    model = spec.build(MPI.COMM_SELF, spec.coefficients)
    point = 0.2 * np.random.default_rng(0).standard_normal(len(spec.coefficients))
    directions = np.vstack([np.eye(len(point))[[0, 13]], np.random.default_rng(1).uniform(-1, 1, len(point))])
    steps = (1 / 16, 1 / 32, 1 / 64)
    check_derivatives(
        model, point, np.full(len(point), 0.3), directions=directions, steps=steps, accuracy=1e-10
    ).require()
    solution = model.solve(point)
    doubled = model.solve(point + 0.5).outputs / solution.outputs
    assert doubled[-2:] == pytest.approx(np.exp([0.5, 0.5]), rel=1e-6)  # stiffer everywhere by the same factor


def test_what_is_observed_may_be_any_of_them_in_any_number():
    model = specimen().build(MPI.COMM_SELF, NUMBERS)
    everything = model.solve(np.array([1e4, 0.1, 0.1]))
    places = np.array([[np.nan] * 3, [1.0, 0.5, 0.5], [np.nan] * 3, [np.nan] * 3, [np.nan] * 3])
    other = model.observing(places, (3, 2, 3, 4, 3), (0, 0, 0, 1, 1)).solve(np.array([1e4, 0.1, 0.1]))
    which = [2, 1, 2, 6, 5]
    np.testing.assert_allclose(other.outputs, everything.outputs[which])
    np.testing.assert_allclose(other.tangent(np.eye(3)), everything.tangent(np.eye(3))[:, which], rtol=1e-9)
    weights = np.random.default_rng(0).standard_normal((2, 5))
    spread = np.zeros((2, 7))
    np.add.at(spread, (slice(None), which), weights)
    np.testing.assert_allclose(other.adjoint(weights), everything.adjoint(spread), rtol=1e-9)
    np.testing.assert_allclose(other.mesh_error().outputs, everything.mesh_error().outputs[which])


RANKS = """
import sys
import numpy as np
from mpi4py import MPI
from tests.inverse.methods.test_forces import NUMBERS, specimen

model = specimen().build(MPI.COMM_WORLD, NUMBERS)
solution = model.solve(np.array([1e4, 0.1, 0.1]))
found = solution.outputs, solution.tangent(np.eye(3)), solution.adjoint(np.eye(len(model.outputs)))
if MPI.COMM_WORLD.rank == 0:
    np.savez(sys.argv[1], *found)
"""


@pytest.mark.mpi
def test_ranks_that_share_a_specimen_find_the_same_forces(tmp_path):
    run = on_kept_ranks(2, RANKS, tmp_path / "found.npz")
    assert run.returncode == 0, run.stderr
    solution = specimen().build(MPI.COMM_SELF, NUMBERS).solve(np.array([1e4, 0.1, 0.1]))
    expected = solution.outputs, solution.tangent(np.eye(3)), solution.adjoint(np.eye(len(solution.outputs)))
    with np.load(tmp_path / "found.npz") as found:
        for name, values in zip(found.files, expected, strict=True):
            np.testing.assert_allclose(found[name], values, atol=1e-9 * np.abs(values).max())


# --- what forces tell ------------------------------------------------------------------------------------------------


def test_synthetic_tables_hold_forces_with_errors_of_their_own(folder):
    study = load(folder / "few.toml")
    found = study.measurements[0]
    forces = found.axes >= 3
    assert forces.sum() == 2
    np.testing.assert_array_equal(found.cases[forces], [0, 1])
    assert np.isnan(found.places[forces]).all()
    np.testing.assert_allclose(found.sigma[forces] / found.values[forces], 0.02, rtol=0.1)
    assert study.measurements[0].data_labels()[int(np.flatnonzero(forces)[0])].endswith(", pull, grip")


@pytest.mark.slow
def test_displacements_alone_tell_ratios_and_a_force_the_absolute_stiffness(folder, looked_at):
    blind, seeing = load(folder / "blind.toml"), load(folder / "few.toml")
    assert any(RATIOS in finding.text and "material.mu" in finding.text for finding in blind.findings)
    assert not any(RATIOS in finding.text for finding in seeing.findings)
    here(folder / "blind.toml", folder / "out-blind")
    here(folder / "few.toml", folder / "out-few", report=True)
    without, found = results(folder / "out-blind"), results(folder / "out-few")
    of = {"parameter": "material.mu"}
    spread = np.log(without["draw"].sel(of)).std() / np.sqrt(np.log1p((7 / 13) ** 2))
    assert float(spread) == pytest.approx(2**-0.5, abs=0.2)  # two equal priors of constants whose ratio is known
    assert float(found["std"].sel(of) / found["prior_std"].sel(of)) < 0.15
    summary = json.loads((folder / "out-blind" / "summary.json").read_text())
    assert any(RATIOS in finding["text"] for finding in summary["findings"])
    predicted = found["predicted"].values[found["datum_axis"].values >= 3]
    measured = found["measured"].values[found["datum_axis"].values >= 3]
    np.testing.assert_allclose(predicted, measured, rtol=0.06)
    page = (folder / "out-few" / "report.html").read_text()
    looked_at(folder / "out-few")
    assert "grip by load case, measured and predicted" in page
    assert page.count("residual over its error") == 1


@pytest.mark.slow
def test_forces_alone_are_data_enough(folder):
    study = load(folder / "few.toml")
    data, forces = study.measurements[0], study.measurements[0].subset(study.measurements[0].axes >= 3)
    rows = [
        f"{study.parts[c]},{n},{v},{s}"
        for c, n, v, s in zip(forces.cases, forces.names, forces.values, forces.sigma, strict=True)
    ]
    (folder / "alone").mkdir()
    (folder / "alone" / "made.csv").write_text("\n".join(["case,output,value,sigma", *rows]))
    (folder / "alone.toml").write_text(FEW.replace('["data"]', '["alone"]'))
    here(folder / "alone.toml", folder / "out-alone", report=True)
    found = results(folder / "out-alone")
    assert int(np.isfinite(found["measured"]).sum()) == len(forces) < len(data.values)
    assert int(found["points_moved"]) == 0
    assert "force by load case" in (folder / "out-alone" / "report.html").read_text()
    assert not list((folder / "out-alone" / "fields").glob("points-*"))


def test_fields_of_stiffness_get_their_mean_from_forces(folder):
    assert any(RATIOS in finding.text for finding in load(folder / "blind-field.toml").findings)
    here(folder / "blind-field.toml", folder / "out-blind-field")
    here(folder / "field.toml", folder / "out-field")
    without, found = results(folder / "out-blind-field"), results(folder / "out-field")
    assert float(found["std"][0]) < 0.3 * float(without["std"][0])
    predicted = found["predicted"].values[found["datum_axis"].values >= 3]
    np.testing.assert_allclose(predicted, found["measured"].values[found["datum_axis"].values >= 3], rtol=0.06)


@pytest.mark.slow
def test_candidates_are_compared_by_forces_too(folder):
    here(folder / "select.toml", folder / "out-select")
    found = stored_dataset(folder / "out-select" / "results.nc")
    assert float(found["probability"].sel(model="right").max()) > 0.99  # the other is three times softer


def test_forces_lie_nowhere_in_comparisons_as_in_inversions(folder, monkeypatch):
    """What finer meshes still miss of displacements varies over the body, with which forces have nothing to do."""
    looked = []

    def stop(posterior, problem):
        looked.append(problem.data)
        raise SolveError("enough")

    monkeypatch.setattr("inverse.methods.selection.infer", stop)
    study = load(folder / "select.toml")
    with pytest.raises(SolveError, match="enough"):
        study.method.run(study.models, study.data_groups, lambda *pair: None)
    (data,), inverted = looked, load(folder / "few.toml").measurements[0]
    np.testing.assert_array_equal(np.isnan(data.places).all(axis=1), data.axes >= 3)
    rows = (uncertain(np.ones(len(one)), np.ones(len(one)), one) for one in (data, inverted))
    np.testing.assert_allclose(*rows)


@pytest.mark.slow
def test_forces_stand_beside_points_of_uncertain_registration(folder):
    """A motion of the scan moves points, not forces: these keep errors of their own."""
    uncertain = '["data"]\nregistration = { kind = "given", rotation_std = 2.0, translation_std = 1e-3 }'
    (folder / "moved.toml").write_text(FEW.replace('["data"]', uncertain))
    study = load(folder / "moved.toml")
    motion, forces = motion_of(study.measurements[0], study.model.body), study.measurements[0].axes >= 3
    model = study.specimen.build(MPI.COMM_SELF, study.inputs.names).observing(*motion.observed)
    rows = motion.errors(model.solve(study.inputs.mean).outputs)
    assert rows.shape == (6, len(forces))
    assert not rows[:, forces].any()
    assert np.abs(rows[:, ~forces]).max(axis=1).min() > 0
    here(folder / "moved.toml", folder / "out-moved")
    here(folder / "few.toml", folder / "out-few")
    found, known = results(folder / "out-moved"), results(folder / "out-few")
    of = {"parameter": "inclusions.lump.contrast"}
    assert float(found["std"].sel(of)) > 1.1 * float(known["std"].sel(of))  # which displacements tell
    assert float(found["std"].sel(parameter="material.mu") / found["prior_std"].sel(parameter="material.mu")) < 0.25
    assert int(np.isfinite(found["motion_eigenvalue"]).sum()) == 6


# --- tables ----------------------------------------------------------------------------------------------------------

CASES = {"pull": {"grip": "N"}, "press": {"force": "N", "pressure": "Pa"}}
TABLE = """x,y,z,ux,uy,uz,sigma,case,output,value
1,0,0,1e-3,,,1e-5,pull,,
,,,,,,0.01,pull,grip,2
,,,,,,0.02,press,force,3
"""


def table(tmp_path, text, unit=None):
    (tmp_path / "made.csv").write_text(text)
    return read(tmp_path, Scan(file="made.csv", unit=unit), CASES)


def test_rows_of_outputs_stand_among_displacements_or_alone(tmp_path):
    both = table(tmp_path, TABLE, 1e-3)
    data = both.measured()
    assert data.names.tolist() == ["x", "grip", "force"]
    np.testing.assert_allclose(data.sigma[1:], [0.01, 0.02])
    assert data.values[0] == pytest.approx(1e-6)  # data.unit is that of lengths only
    np.testing.assert_array_equal(data.axes, [0, 3, 3])
    np.testing.assert_array_equal(data.cases, [0, 0, 1])
    alone = table(
        tmp_path, "case,output,value [mN],sigma_value [mN]\npull,grip,2000,10\npress,force,3000,\npress,force,3100,20\n"
    )
    assert len(alone.places_of_points) == 0
    np.testing.assert_allclose(alone.values, [2, 3, 3.1])
    np.testing.assert_allclose(alone.sigma, [0.01, np.nan, 0.02])
    first, second = alone.measured().neighbours()
    assert (first.tolist(), second.tolist()) == ([1], [2])  # repeated measurements


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (TABLE.replace("pull,grip", "pull,force"), "line 3: no output 'force' is measured in load case 'pull'; .*grip"),
        (TABLE.replace("press,force", "lift,force"), "line 4: unknown load case 'lift'"),
        (TABLE.replace("0.01,pull", "-0.01,pull"), "line 3: sigma is '-0.01', expected a number more than 0"),
        (TABLE.replace("0.01,pull", "0,pull"), "line 3: sigma is '0', expected a number more than 0"),
        (TABLE.replace("grip,2", "grip,two"), "line 3: value is 'two', expected a number"),
        (TABLE.replace("grip,2", "grip,inf"), "line 3: value is 'inf', expected a number"),
        (TABLE.replace("grip,2", "grip,"), "line 3: no value of 'grip'"),
        (TABLE.replace(",,,,,,0.01", "1,,,,,,0.01"), "line 3: the row of an output has a number in x"),
        (TABLE.replace("pull,,", "pull,,7"), "line 2: a value of no output"),
        (TABLE.replace("output,value", "output,valve"), "a column 'output' and none 'value'"),
        (TABLE + ",,,,,,0.01,pull,grip,2\n", "line 5: 'grip' of line 3 again, expected each measurement once"),
        (
            TABLE.replace(",sigma,", ",sigma_value [N],").replace("output,value", "output,value [mm]"),
            r"line 3: column 'value' has the unit 'mm'.* for 'grip'",
        ),
        (TABLE.replace("output,value", "output,value [mN]"), r"'value' states a unit and 'sigma' does not"),
        (
            TABLE.replace(",sigma,", ",sigma [mm],"),
            r"line 3: column 'sigma' has the unit 'mm'.*in a column sigma_value",
        ),
        ("case,output,value [N]\npull,grip,2\npress,pressure,3\n", "line 3: column 'value' has the unit 'N'"),
        ("case,output,value,sigma\npull,grip,2,1\n", "no data in load case 'press'"),
        ("case,output,value,sigma\n,grip,2,1\n", "line 2: no load case"),
    ],
)
def test_bad_rows_of_outputs_are_named(tmp_path, text, said):
    with pytest.raises(DataError, match=said):
        table(tmp_path, text)


def test_missing_errors_of_forces_are_asked_for(folder):
    lines = (folder / "data" / "made.csv").read_text().splitlines()
    text = "\n".join(line if line.startswith("#") else line.rpartition(",")[0] for line in lines)
    (folder / "unknown").mkdir()
    (folder / "unknown" / "made.csv").write_text(text)
    (folder / "unknown.toml").write_text(FEW.replace('["data"]', '["unknown"]\nsigma = 1e-5'))
    with pytest.raises(StudyError, match=r"of 'grip' is not known \(and 1 more\).*data\.sigma_of\.grip"):
        load(folder / "unknown.toml")
    assert load(folder / "unknown.toml", ["data.sigma_of={grip=0.5, force=0.1}"]).measurements[0].sigma.min() > 0


def test_outputs_of_load_cases_are_checked():
    wrong = CUBE.replace("CELLS", "2").replace("MORE", "").replace('kind = "force"', 'kind = "force", tool = "needle"')
    with pytest.raises(StudyError, match=r"model\.cases\[1\]\.outputs\[0\]\.tool: unknown tool"):
        _parse(wrong)
    with pytest.raises(StudyError, match=r"\.name: the name of a component of displacements"):
        _parse(CUBE.replace("CELLS", "2").replace("MORE", "").replace('"grip"', '"z"'))


def _parse(text):
    import tomllib

    from workflows.config.study import parse

    return parse(tomllib.loads(text + '\n[method]\nkind = "synthesize"\nnoise = { relative = 0.02 }\n'))
