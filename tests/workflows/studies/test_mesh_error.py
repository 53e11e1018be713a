"""The error of the mesh over the distribution: studies of bodies, against finer meshes."""

import json
import re
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.facets import body
from forward.readable import SIZES, margin, places
from tests.launch import ROOT, TISSUQ, assert_same_bits, in_process, run, run_script
from uq.findings import findings
from workflows.__main__ import main
from workflows.config.mistakes import StudyError
from workflows.config.study import document, dump, load, parse
from workflows.run.plan import plan
from workflows.run.run import run as run_study
from workflows.studies import sampling_job

TINY = ROOT / "configs" / "tiny.toml"
OFF = "accuracy.mesh_error=false"
BLOCK = (  # compressed softly enough that the error of the mesh is no fixed share of the outputs
    "model.body.size=[1.0, 0.5, 0.5]",
    "model.material.C2=2e4",
    "parameters={'loads.gravity.density'={kind='uniform', lower=100, upper=300}, "
    "'material.D1'={kind='uniform', lower=3e4, upper=9e4}}",
    "method={kind='chaos', samples=16, max_order=4}",
)


@cache
def block(cells, *more):
    return load(TINY, [*BLOCK, f"model.body.cells={list(cells)}", *more]).run()


@pytest.mark.slow
@pytest.mark.fem
def test_what_three_estimates_predict_is_what_a_finer_mesh_changes():
    """Half the cells and one degree more see the same part of the error; calibration adds what both do not see."""
    coarse, fine = block((4, 2, 2)), block((8, 4, 4), OFF)
    assert coarse.sizes["estimate"] == 3
    factor = coarse["mesh_error_saturation"]
    assert ((factor > 1.1) & (factor < 1.8)).all()  # stresses are singular along the clamped edge
    for name in ("mean", "std"):
        first = "" if name == "mean" else "std_"
        moved = fine[name] - coarse[name]  # the same points on both meshes: of the error of sampling little is left
        np.testing.assert_allclose(coarse[f"{first}mesh_error"] / factor, moved, rtol=0.25)
        assert (moved < coarse[f"{first}total_error"]).all()
    sag = {"output": "uy_max"}
    moved = fine["quantiles"].sel(sag) - coarse["quantiles"].sel(sag)
    np.testing.assert_allclose(coarse["quantiles_mesh_error"].sel(sag) / factor.sel(sag), moved, rtol=0.25)
    for name in ("sobol_first", "sobol_total"):  # the influence of D1 is what a coarse mesh hides
        np.testing.assert_allclose(coarse[f"{name}_mesh_error"] / factor, fine[name] - coarse[name], rtol=0.35)
    local = fine["derivative"] - coarse["derivative"]
    np.testing.assert_allclose(coarse["derivative_mesh_error"] / factor, local, rtol=0.35)


@pytest.mark.slow
@pytest.mark.fem
def test_what_a_finer_mesh_gives_lies_within_the_stated_uncertainty():
    """The same study on cells half as large, of which the error is a third to a quarter: within it too."""
    coarse, fine = block((4, 2, 2)), block((8, 4, 4), OFF)
    for name in ("mean", "std", "quantiles", "sobol_first", "sobol_total", "derivative"):
        left = abs(fine[name] - coarse[f"{name}_corrected"])
        assert (left < 2 * coarse[f"{name}_corrected_error"]).all(), name
    assert (abs(fine["mean"] - coarse["mean"]) > 10 * coarse["mean_error"]).all()  # as are plain values not
    sag = {"output": "uy_max"}
    one, other = (found.sel(sag) for found in (coarse, fine))
    moved, true = one["density_edge_corrected"], other["density_edge"]
    below = np.interp(moved, true, [0, *np.cumsum(other["density"] * np.diff(true))])
    expected = [0, *np.cumsum(one["density"] * np.diff(one["density_edge"]))]
    uncorrected = np.interp(one["density_edge"], true, [0, *np.cumsum(other["density"] * np.diff(true))])
    assert abs(below - expected).max() < 0.5 * abs(uncorrected - expected).max()


@pytest.mark.fem
def test_fields_are_corrected_too():
    few = "method={kind='chaos', samples=8, max_order=2}"
    coarse, fine = block((2, 1, 1), few), block((4, 2, 2), few, OFF)
    nodes = {tuple(p): i for i, p in enumerate(np.round(fine["node_position"].values, 9).tolist())}
    shared = [nodes[tuple(p)] for p in np.round(coarse["node_position"].values, 9).tolist()]
    for name in ("mean", "std"):
        moved = fine[f"field_{name}"].values[shared] - coarse[f"field_{name}"].values
        found = coarse[f"field_{name}_mesh_error"].values
        seen = (found * moved).sum() / (moved**2).sum()  # of what the finer mesh sees: the rest is calibration
        assert 1.0 < seen < 1.8
        assert np.linalg.norm(found / seen - moved) < 0.2 * np.linalg.norm(moved)


@pytest.mark.slow
@pytest.mark.fem
def test_what_was_there_is_the_same_to_the_bit_without_estimates():
    small = ["method={kind='chaos', samples=8, max_order=2}", "model.body.cells=[2, 1, 1]"]
    on, off = (load(TINY, [*small, *more]).run() for more in ([], [OFF]))
    assert not any(
        "mesh_error" in name or "corrected" in name or "estimate" in off[name].dims for name in off.variables
    )
    for name in off.variables:
        assert on[name].values.tobytes() == off[name].values.tobytes(), name
    assert any("mesh" in one.text for one in findings(on))
    assert not any("The mesh" in one.text for one in findings(off))


@pytest.mark.few(4)
@pytest.mark.fem
@pytest.mark.parametrize(
    "method",
    [
        "{kind='monte-carlo', samples=8}",
        "{kind='quasi-monte-carlo', samples=8, scrambles=2}",
        "{kind='multilevel-chaos', samples=8, order=1}",
        "{kind='sobol', design='saltelli', samples=8, scrambles=4}",
        "{kind='derivative-based', samples=16, scrambles=4}",
        "{kind='local-sensitivity'}",
        "{kind='compare', repeats=2, textbook=0, methods=[{kind='monte-carlo', budgets=[4]}],"
        " reference={kind='chaos', samples=8, max_order=2}}",
        "{kind='multilevel-monte-carlo', samples=4, pilot=4, levels=2}",
    ],
)
def test_every_method_has_them(method):
    found = load(TINY, [f"method={method}", "model.body.cells=[2, 1, 1]"]).run()
    error = found["mesh_error" if "mean" in found else "nominal_mesh_error"]
    assert (error > 0).all()
    if "mean" in found:
        assert (found["total_error"] > abs(found["mesh_error"])).all() or "bias_error" in found
        assert (found["total_error"] >= found["mean_error"]).all()
        assert (found["std_total_error"] >= found["std_error"]).all()


@pytest.mark.fem
def test_comparisons_with_one_finer_mesh_end_in_words(tmp_path, capsys):
    """They have an error of the mesh, and no total one."""
    method = (
        "{kind='compare', repeats=2, textbook=0, mesh_error=true, methods=[{kind='monte-carlo', budgets=[4]}],"
        " reference={kind='chaos', samples=8, max_order=2}}"
    )
    study = load(TINY, [f"method={method}", "model.body.cells=[2, 1, 1]", OFF])
    run_study(study, "tiny", tmp_path / "out", report=False)
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("  mean")][:1]
    assert re.search(r"[+−]\d\S* +– +–", line), line


@pytest.mark.slow
@pytest.mark.fem
@pytest.mark.mpi
def test_the_same_bits_on_any_number_of_ranks_and_after_a_kill(tmp_path):
    study = ["run", TINY, "--set", "model.body.cells=[2, 1, 1]", "--set", "method.samples=8", "--no-report", "--out"]
    assert main([*map(str, study), str(tmp_path / "1")]) == 0
    # Killed as it writes the first file that holds an estimate.
    done = run_script(None, KILLED, *study, tmp_path / "killed")
    assert done.returncode == -9
    kept = len(list((tmp_path / "killed" / "evaluations").glob("*.block")))
    assert kept > 1
    done = run(3, TISSUQ, *study, tmp_path / "killed")
    assert done.returncode == 0, done.stderr
    assert_same_bits(tmp_path / "1", tmp_path / "killed")


KILLED = """
import os, sys
from uq.evaluation.checkpoint import Checkpoint
save = Checkpoint.save

def killed(self, key, block):
    save(self, key, block)
    if getattr(block, "mesh_errors", None) is not None:
        os.kill(os.getpid(), 9)

Checkpoint.save = killed
from workflows.__main__ import main
main(sys.argv[1:])
"""


@pytest.mark.fem
def test_the_summary_and_the_terminal_say_it(tmp_path, undrawn):
    study = ["run", TINY, "--set", "model.body.cells=[2, 1, 1]", "--set", "method.samples=8", "--out", tmp_path / "out"]
    done = in_process(*study)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["evaluations"] == 9
    assert summary["mesh_error"]["estimates"] == 3
    assert summary["mesh_error"]["failed"] == 0
    assert summary["mesh_error"]["cpu_seconds"] > 0
    of = summary["outputs"]["uy_max"]
    assert of["mean_corrected"] == pytest.approx(of["mean"] + of["mesh_error"])
    assert of["total_error"] == pytest.approx(
        np.hypot(of["mean_error"], abs(of["mesh_error"]) + of["mesh_error_doubt"])
    )
    assert of["std_corrected_error"] == pytest.approx(np.hypot(of["std_error"], of["std_mesh_error_doubt"]), rel=1e-6)
    lines = done.stdout.splitlines()
    (first,) = (k for k, line in enumerate(lines) if line.startswith("uy_max ("))
    assert lines[first - 1].split() == ["value", "±", "sampling", "mesh", "in", "all", "corrected"]
    one = next(one for one, unit in SIZES["m"] if lines[first] == f"uy_max ({unit})")
    printed = [one * float(x) for x in re.findall(r"[+-]?\d\S*", lines[first + 1])]
    keys = (
        "mean",
        "mean_error",
        "mesh_error",
        "mesh_error_doubt",
        "total_error",
        "mean_corrected",
        "mean_corrected_error",
    )
    for number, key, error in zip(printed, keys, [keys[i] for i in (1, 1, 3, 3, 4, 6, 6)], strict=True):
        assert abs(number - of[key]) < 0.501 * 10.0 ** -places(of[error])  # to the place of its error
    assert max(map(len, lines[first - 1 : first + 6])) <= 80
    of_first = summary["quantiles"]["uy_max"]["0.05"]
    assert of_first["corrected"] == pytest.approx(of_first["value"] + of_first["mesh_error"])
    assert summary["local_corrected"]["uy_max"].keys() == summary["local"]["uy_max"].keys()
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Error budget" in page
    assert page.index("Error budget") < page.index("What was computed")
    assert margin(of["total_error"], "m", like=of["mean"]) in page


@pytest.mark.fem
def test_outputs_that_are_zero_by_symmetry_do_no_harm(tmp_path, undrawn):
    """No expansion explains rounding, which is no error of the study."""
    outputs = (
        "[{name='uy', kind='mean-displacement', on='x-max', component='y'}, "
        "{name='uz', kind='mean-displacement', on='x-max', component='z'}, "
        "{name='mises', kind='max-von-mises'}]"
    )
    small = ["model.body.cells=[2,1,1]", "method={kind='chaos', samples=8, max_order=2}", f"model.outputs={outputs}"]
    done = in_process("run", TINY, *(word for one in small for word in ("--set", one)), "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert re.search(r"^uz \(\S+\): zero but for rounding$", done.stdout, re.MULTILINE)
    said = json.loads((tmp_path / "out" / "summary.json").read_text())["findings"]
    assert any(one["text"].startswith("uz is zero but for rounding") for one in said)
    assert not any(" uz" in one["text"] for one in said)
    (mises,) = (one for one in said if "mises" in one["text"])
    assert "not estimated of mises" in mises["text"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Zero but for rounding: uz." in page


def test_the_setting():
    on, off = load(TINY), load(TINY, [OFF])
    assert (on.estimates, off.estimates) == (3, 0)
    assert load(TINY, ["mesh_error=false"]) == off
    assert parse(document(off)) == off
    assert "[accuracy]\nmesh_error = false" in dump(off)
    own = load(ROOT / "configs" / "own-model.toml")  # a function has no mesh
    assert own.estimates == 0
    assert own.accuracy.mesh_error
    assert load(ROOT / "configs" / "beam-multilevel.toml").estimates == 0  # which it has several of
    for wrong in ("accuracy.mesh_error=3", "mesh_error=3", "accuracy.mesh_eror=false"):
        with pytest.raises(StudyError, match="accuracy"):
            load(TINY, [wrong])
    for block_ in ("method", "model", "model.body"):
        with pytest.raises(StudyError, match=rf"{block_}.mesh_error: unknown key; did you mean 'accuracy.mesh_error'"):
            load(TINY, [f"{block_}.mesh_error=false"])
    with pytest.raises(StudyError, match="accuracy: unknown key"):
        load(ROOT / "configs" / "treloar.toml", [OFF])


def test_the_plan_says_what_it_takes():
    on, off = load(TINY), load(TINY, [OFF])
    said = "\n".join(plan(on))
    assert "3 estimates in elements of one degree more" in said
    assert "estimates of the mesh error" in said
    assert "estimates" not in "\n".join(plan(off))
    assert on.memory > off.memory
    assert on.solves == off.solves + 3
    stress = """model.outputs=[{ name = "uy", kind = "max-displacement" }, { name = "vm", kind = "max-von-mises" }]"""
    assert "none of vm, which need not converge" in "\n".join(plan(load(TINY, [stress])))
    assert "none of" not in said


@pytest.mark.fem
def test_models_without_a_mesh_say_so_where_its_error_is_asked_for():
    own = ROOT / "configs" / "own-model.toml"
    texts = [one.text for one in load(own, ["accuracy.mesh_error=true"]).findings]
    assert any("a model of kind 'python' has no mesh of its own" in text for text in texts)
    assert not any("mesh" in one.text for one in load(own).findings)


SMALL = ("model.body.cells=[2, 1, 1]", "method.samples=4")
FAR_TOO_COARSE = (*SMALL, "model.body.cell='tetrahedron'", "model.body.degree=1", "model.material.C2=1e3")


def of_run(directory, *settings):
    """The exit code of a run, what it prints at its end, and its summary."""
    sets = [word for one in settings for word in ("--set", one)]
    done = in_process("run", TINY, *sets, "--out", directory, "--no-report")
    return done.returncode, done.stdout, json.loads((directory / "summary.json").read_text())


@pytest.mark.fem
def test_estimates_that_were_planned_and_failed_are_an_error(tmp_path, undrawn):
    code, printed, summary = of_run(tmp_path / "D", *FAR_TOO_COARSE)
    assert code == 3
    assert summary["failed"] == 0
    first = summary["findings"][0]
    assert first["severity"] == "error"
    assert "estimates of the error of the mesh failed" in first["text"]
    lines = printed.splitlines()
    assert lines[0] == f"error: {first['text']}"
    for output in ("uy_max", "ux_max"):
        at = next(k for k, line in enumerate(lines) if line.startswith(f"{output} ("))
        line = lines[at + 1]
        assert "mesh not known" in line
        value = re.search(r"mean +(\S+) ±", line)[1]
        assert len(value.replace(".", "").strip("-0")) <= 2, line  # digits
    assert main(["report", str(tmp_path / "D")]) == 0
    page = (tmp_path / "D" / "report.html").read_text()
    assert all(part.strip(".") in page for part in re.split("[.;] ", first["text"]))
    assert "mesh not known; ±" in page


@pytest.mark.fem
@pytest.mark.parametrize(
    "method",
    ["{kind='monte-carlo', samples=4}", "{kind='chaos', samples=8, max_order=2}", "{kind='local-sensitivity'}"],
)
def test_no_error_stands_alone_where_that_of_the_mesh_was_not_asked_for(method, tmp_path):
    code, printed, summary = of_run(tmp_path / "D", OFF, f"method={method}", SMALL[0])
    assert code == 0
    assert all("mesh not known" in line for line in printed.splitlines() if re.search(r"\d ±", line))
    assert not [one for one in summary["findings"] if one["severity"] == "error"]


def test_a_function_has_no_mesh_that_could_be_unknown(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "configs")
    found = load(ROOT / "configs" / "own-model.toml").run()
    assert "mesh_unknown" not in found.attrs


@pytest.mark.parametrize(("curved", "meshes", "said"), [(True, 2, 1), (True, 1, 0), (False, 2, 0)])
def test_methods_on_several_meshes_say_that_facets_are_in_no_error(tmp_path, curved, meshes, said):
    solid = body(tmp_path, "tetrahedron", 2, 1) if curved else load(TINY).spec
    study = SimpleNamespace(spec=SimpleNamespace(bodies=[solid]), meshes=[None] * meshes)
    assert [one.code for one in sampling_job._of_facets(study)] == ["facets-uncounted"] * said
