"""Studies with one tolerance for all errors: what they choose, what they refuse, and that restarts change nothing."""

import dataclasses
import json

import numpy as np
import pytest

from forward.machine import Headroom
from tests import meshes
from tests.launch import ROOT, assert_same_bits, run_script, tissuq_on_two_ranks
from workflows.__main__ import main
from workflows.accuracy.levers import Assessed, MeshLever, rate_of
from workflows.accuracy.tolerance_words import contradictions, taken
from workflows.accuracy.tolerance_words import out_of_reach as in_words
from workflows.config.mistakes import StudyError
from workflows.config.study import document, load, parse
from workflows.run.plan import plan

TINY = ROOT / "configs" / "tiny.toml"
OWN = ROOT / "configs" / "own-model.toml"
NAMED = ("model.function=configs.own_model.beam", "model.jacobian=configs.own_model.slopes")
COARSE = ("model.body.cells=[2, 1, 1]", "method={kind='automatic'}")


def asked(tolerance, *more, of=TINY):
    return load(of, ["method={kind='automatic'}", f"accuracy.tolerance={tolerance}", *more])


def without_method(tolerance, solves=10_000):
    blocks = {name: block for name, block in document(load(OWN, NAMED)).items() if name != "method"}
    return parse(blocks | {"accuracy": {"tolerance": tolerance, "solves": solves}})


# --- what is asked ---------------------------------------------------------------------------------------------------


def test_a_tolerance_stands_in_place_of_a_method():
    study = without_method(1e-3)
    assert study.method.kind == "automatic"
    assert parse(document(study)) == study
    with pytest.raises(StudyError, match=r"method: missing"):
        parse({name: block for name, block in document(load(OWN)).items() if name != "method"})


@pytest.mark.parametrize(
    ("method", "samples"),
    [
        ("{kind='chaos'}", 500),
        ("{kind='monte-carlo'}", 500),
        ("{kind='quasi-monte-carlo'}", 256),
        ("{kind='quasi-monte-carlo', scrambles=4}", 256),
        ("{kind='chaos', samples=40}", 40),
    ],
)
def test_a_method_that_is_given_is_kept(method, samples):
    study = load(TINY, [f"method={method}", "accuracy={tolerance=1e-2, solves=500}"])
    assert study.method.samples == samples
    assert parse(document(study)) == study
    assert any(f"up to {samples}" in line for line in plan(study))


@pytest.mark.unit
@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (["method={kind='automatic'}"], "method.kind: method.kind = 'automatic' needs a tolerance"),
        (["accuracy.tolerance=0"], "accuracy.tolerance: .*greater than 0"),
        (["accuracy.tolerance=2"], "accuracy.tolerance: .*less than 1"),
        (["accuracy.tolerance=1e-10", "method={kind='automatic'}"], "accuracy.tolerance: below what rounding leaves"),
        (
            ["accuracy.tolerance=1e-3", "model.solver.tolerance=1e-3", "method={kind='automatic'}"],
            "accuracy.tolerance: below what the solver reaches .*at least 0.1, or a smaller model.solver.tolerance",
        ),
        (["accuracy.tolerance=1e-3", "method={kind='local-sensitivity'}"], "method.kind: does not stop at accuracy"),
        (["accuracy.tolerance=1e-3", "method={kind='chaos', fit='projection'}"], "method.kind: does not stop at acc"),
        (
            ["accuracy.tolerance=1e-3", "method={kind='chaos', tolerance=1e-2}"],
            "method.tolerance: another tolerance than accuracy.tolerance",
        ),
        (["accuracy.solves=3"], "accuracy.solves: .*16"),
        (["accuracy.tolerence=1e-3"], "accuracy.tolerence: unknown key; did you mean 'tolerance'"),
    ],
)
def test_what_cannot_be_asked_is_said_in_a_line(settings, said):
    with pytest.raises(StudyError, match=said) as refused:
        load(TINY, settings)
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.unit
def test_the_solver_is_as_exact_as_the_tolerance_needs():
    assert asked(1e-3).spec.solver.tolerance == 1e-8
    assert asked(1e-7).spec.solver.tolerance == pytest.approx(1e-9)
    assert load(TINY).spec.solver.tolerance == 1e-8


def test_check_says_what_is_held_and_what_is_not(tmp_path):
    found = "\n".join(plan(asked(1e-2)))
    assert "0.01 of every mean and standard deviation" in found
    assert "the method, the number of solves (up to 10,000) and the mesh follow" in found
    assert "gets more cells along all edges" in found
    assert "is refined where its error arises" in "\n".join(plan(asked(1e-2, "model.body.cell=tetrahedron")))
    off = asked(1e-2, "accuracy.mesh_error=false").findings
    assert any("does not count the error of the mesh: accuracy.mesh_error = false" in one.text for one in off)
    small = asked(1e-2, "accuracy.memory=1").findings
    assert any("does not count the error of the mesh: it is not estimated" in one.text for one in small)
    stress = "model.outputs=[{kind='max-von-mises', name='stress'}, {kind='max-displacement', name='u', component='y'}]"
    text = "does not count the error of the mesh in stress"
    assert any(text in one.text for one in asked(1e-2, stress).findings)
    noise = "model.fields=[{of='stiffness', length=0.1, std=0.1, basis='noise'}]"
    kept = [one.text for one in asked(1e-2, noise).findings if "the mesh is not refined" in one.text]
    assert len(kept) == 1
    assert "basis = 'modes'" in kept[0]
    path = tmp_path / "box.msh"
    meshes.box("hexahedron").write(path, file_format="gmsh22")
    body = f"model.body={{kind='mesh', file='{path}', degree=1}}"
    assert "gets more cells" in "\n".join(plan(asked(1e-2, body)))
    divided = asked(1e-2, f"model.body={{kind='mesh', file='{path}', degree=1, divide=['x-min']}}").findings
    assert any("the mesh is not refined: its mesh is divided already" in one.text for one in divided)


# --- which mesh ------------------------------------------------------------------------------------------------------


def mesh(study, share, estimates=3, between=0.0):
    share_close = np.sqrt(max(share**2 - between**2, 0.0))
    return Assessed(
        study.spec.unknowns,
        study.model.body.cells,
        estimates,
        share,
        2,
        "uy_max",
        "mean",
        [[share_close], [0.0]],
        [[between], [0.0]],
        0.01,
        [],
        4,
        1.0,
    )


def following(study, first, seen):
    """What is looked at next, and why none is, in words."""
    lever = MeshLever.of(first)
    step = lever.step(study, seen)
    return step.model, step.estimates, taken(first, lever, seen, step)


def out_of_reach(first, seen):
    reach = MeshLever.of(first).out_of_reach(seen)
    return None if reach is None else in_words(first, seen[-1], reach)


def test_a_mesh_that_takes_little_is_kept():
    study = asked(1e-2)
    model, count, why = following(study, study, [mesh(study, 0.3)])
    assert model is None
    assert count == 3
    assert "takes 30 % of the tolerance" in why


def test_where_estimates_are_few_there_are_more_of_them():
    study = asked(1e-2)
    model, count, _ = following(study, study, [mesh(study, 0.9, between=0.89)])
    assert model is study.model
    assert count > 3


def test_a_mesh_that_takes_too_much_is_refined_as_errors_fall():
    study = asked(1e-2)
    first = mesh(study, 8.0)
    model, _, _ = following(study, study, [first])
    assert model.body.cells[0] in range(6, 14)  # between: an assumed rate says little far away
    finer = study.of(model)
    factor = min(n / m for m, n in zip(study.model.body.cells, model.body.cells, strict=True))
    meshes_seen = [first, mesh(finer, 8.0 / factor**2)]
    assert rate_of(meshes_seen) == pytest.approx(2.0)
    model, _, _ = following(finer, study, meshes_seen)
    last = min(n / m for m, n in zip(study.model.body.cells, model.body.cells, strict=True))
    assert 8.0 / last**2 <= 0.61
    assert 8.0 / (0.7 * last) ** 2 > 0.6


def test_a_layer_of_plane_strain_is_refined_in_its_plane():
    study = load(ROOT / "configs" / "cook.toml", ["method={kind='automatic'}", "accuracy.tolerance=1e-3"])
    first = mesh(study, 8.0)
    model, _, _ = following(study, study, [first])
    assert model.body.cells[2] == 1
    assert model.body.cells[0] > study.model.body.cells[0]
    finer = study.of(model)
    factor = model.body.cells[0] / study.model.body.cells[0]
    assert rate_of([first, mesh(finer, 8.0 / factor**2)]) == pytest.approx(2.0)


@pytest.mark.unit
def test_estimates_that_contradict_each_other_are_said():
    outputs = {"u": {"mean": {"error": 0.001}}}

    def looked_at(unknowns, value, error, doubt):
        return {"unknowns": unknowns, "means": [["u", value, error, doubt]]}

    right = [looked_at(100, 1.0, 0.1, 0.025), looked_at(800, 1.08, 0.03, 0.0075)]
    assert list(contradictions(right, outputs)) == []
    wrong = [looked_at(100, 1.0, 0.1, 0.025), looked_at(800, 0.95, -0.01, 0.0025)]
    (found,) = contradictions(wrong, outputs)
    assert found.severity == "warning"
    assert "moved by -0.05, where they foresaw 0.11" in found.text
    assert list(contradictions(wrong, {"u": {"mean": {"error": 0.5}}})) == []  # within the error that is said anyway
    for few in ([], wrong[:1], [wrong[0], wrong[0]], [{"unknowns": 10, "means": []}, wrong[0]]):
        assert list(contradictions(few, outputs)) == []


@pytest.mark.unit
def test_memory_ends_refinement():
    # Room for a few more cells, but not for those that it takes.
    study = asked(1e-2, "accuracy.memory=50")
    assert study.estimates
    seen, model = [mesh(study, 50.0)], study.model
    for _ in range(5):
        model, _, why = following(study, study, seen)
        if model is None:
            break
        study = study.of(model)
        seen.append(mesh(study, 0.8 * seen[-1].share))
    assert model is None
    assert "accuracy.memory = 50 MiB" in why


@pytest.mark.unit
def test_what_memory_is_too_small_for_is_known_by_one_mesh_or_two():
    study = asked(1e-4, "accuracy.memory=400", "model.body.cell=tetrahedron", "model.body.degree=1")
    assert out_of_reach(study, [mesh(study, 5.0)]) is None
    assert out_of_reach(study, [mesh(study, np.inf)]) is None
    said = out_of_reach(study, [mesh(study, 2000.0)])
    assert "even where errors fall as fast as they can" in said
    assert "elements of degree 2 (model.body.degree), more accuracy.memory or a tolerance of" in said
    # What one mesh leaves open, the rate between two tells.
    finer = dataclasses.replace(mesh(study, 20.0 / 2.0), unknowns=8 * study.spec.unknowns)
    assert out_of_reach(study, [mesh(study, 20.0)]) is None
    assert "as errors have fallen so far" in out_of_reach(study, [mesh(study, 20.0), finer])
    better = dataclasses.replace(finer, share=20.0 / 4, close=[[20.0 / 4], [0.0]])
    assert out_of_reach(study, [mesh(study, 20.0), better]) is None
    flat = load(ROOT / "configs" / "cook.toml", ["method={kind='automatic'}", "accuracy.tolerance=1e-3"])
    assert (MeshLever.of(study).dimension, MeshLever.of(flat).dimension) == (3, 2)


# --- whole studies ---------------------------------------------------------------------------------------------------


def test_a_function_of_two_parameters(tmp_path):
    found = without_method(1e-5).run(tmp_path / "out")
    told = json.loads(found.attrs["accuracy"])
    assert told["kept"]
    assert told["method"] == "chaos"
    assert told["mesh"] is None
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["accuracy"] == told
    assert summary["method"] == "automatic"
    of = told["outputs"]["weight"]["mean"]
    assert of["value"] == found["mean"].sel(output="weight").item()
    assert of["error"] <= 1e-5 * of["value"]
    # E[q] L of a normal distribution that is cut at five standard deviations on either side.
    assert of["value"] == pytest.approx(0.1, rel=1e-5)


@pytest.mark.slow
@pytest.mark.fem
def test_a_body_is_refined_until_all_errors_are_within_the_tolerance(tmp_path, undrawn):
    load(TINY, [*COARSE, "accuracy.tolerance=0.05"]).run(tmp_path / "out", report=True)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    told = summary["accuracy"]
    assert told["kept"]
    assert told["mesh"]["tried"][0]["share"] > 1
    assert told["mesh"]["unknowns"] > told["mesh"]["tried"][0]["unknowns"]
    # Against 6 × 2 × 3 cells, corrected.
    settings = ["model.body.cells=[6, 2, 3]", "method={kind='chaos', samples=8}"]
    exact = load(TINY, settings).run()
    for output, estimates in told["outputs"].items():
        for name, of in estimates.items():
            right = exact[f"{name}_corrected"].sel(output=output).item()
            assert abs(of["value"] - right) < 0.05 * right
            assert of["error"] <= 0.05 * of["relative_to"]
    assert set(summary["accuracy_seconds"]) == {"sampling", "mesh"}
    page = (tmp_path / "out" / "report.html").read_text()
    assert "value ± 95 %" in page
    assert "The mesh was refined" in page


@pytest.mark.slow
@pytest.mark.fem
def test_tetrahedra_are_refined_where_errors_arise(tmp_path):
    settings = [*COARSE, "accuracy.tolerance=0.02", "model.body.cell=tetrahedron", "model.body.size=[0.2, 0.1, 0.1]"]
    study = load(TINY, settings)
    found = study.run(tmp_path / "whole" / "out")
    told = json.loads(found.attrs["accuracy"])
    assert told["kept"]
    assert told["mesh"]["tried"][0]["share"] > 1
    assert (tmp_path / "whole" / "out" / "mesh.npz").exists()
    assert found["cycle_unknowns"].values[-1] == told["mesh"]["unknowns"]
    # Interrupted once the mesh is refined, before that is written down: its mesh is made again.
    other = tmp_path / "other" / "out"
    other.mkdir(parents=True)
    for name in ("study.toml", "mesh.npz", "mesh.json"):
        (other / name).write_bytes((tmp_path / "whole" / "out" / name).read_bytes())
    (other / "mesh.npz").write_bytes(b"of another attempt")
    study.run(other)
    assert_same_bits(tmp_path / "whole" / "out", other)


@pytest.mark.slow
@pytest.mark.fem
@pytest.mark.mpi
def test_the_same_bits_on_any_number_of_ranks_and_after_kills(tmp_path):
    settings = [*COARSE, "accuracy.tolerance=0.1"]
    study = ["run", TINY, *(word for one in settings for word in ("--set", one)), "--no-report", "--out"]
    assert main([*map(str, study), str(tmp_path / "1")]) == 0
    # Killed as it looks at the second mesh, and on two ranks as it samples on the last one.
    for ranks, meshes_seen in ((None, 2), (2, 99)):
        killed = run_script(ranks, KILLED.replace("MESHES", str(meshes_seen)), *study, tmp_path / "killed")
        assert killed.returncode in (-9, 137), killed.stderr
        assert any((tmp_path / "killed" / "evaluations").glob("*.block"))
    assert "mesh of" in killed.stderr
    done = tissuq_on_two_ranks(*study, tmp_path / "killed")
    assert done.returncode == 0, done.stderr
    assert "tolerance 0.1: kept" in done.stdout
    assert_same_bits(tmp_path / "1", tmp_path / "killed")


KILLED = """
import os, sys
import workflows.accuracy.tolerance as meshes
from uq.evaluation.checkpoint import Checkpoint
save, assessed = Checkpoint.save, meshes._assessed
seen = []

def counted(*given):
    seen.append(1)
    return assessed(*given)

def killed(self, key, block):
    save(self, key, block)
    sampling = os.path.exists(os.path.join(self._directory, meshes.TOLERANCE)) and block.tangents is not None
    if len(seen) == MESHES or sampling:
        os.kill(os.getpid(), 9)

meshes._assessed = counted
Checkpoint.save = killed
from workflows.__main__ import main
main(sys.argv[1:])
"""


@pytest.mark.fem
@pytest.mark.mpi
def test_a_body_without_an_answer_is_one_line_on_all_ranks(tmp_path):
    heavy = "parameters={'loads.gravity.density'={kind='uniform', lower=1e9, upper=2e9}}"
    settings = [*COARSE, "accuracy.tolerance=0.1", "model.solver.minimum_load_step=0.5", heavy]
    study = ["run", TINY, *(word for one in settings for word in ("--set", one)), "--out", tmp_path / "out"]
    done = tissuq_on_two_ranks(*study)
    assert done.returncode == 1
    assert done.stderr.count("no answer at the mean parameters") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.unit
def test_memory_for_refined_meshes_is_looked_at_before(monkeypatch):
    monkeypatch.setattr("workflows.run.plan.limits", lambda: [Headroom(2**30, "1 GiB is left")])
    said = [line for line in plan(asked(1e-2)) if "as far as memory allows" in line]
    assert len(said) == 1
    assert "are needed for what accuracy.memory says" in said[0]
    assert not any("as far as" in line for line in plan(asked(1e-2, "accuracy.memory=500")))


@pytest.mark.slow
@pytest.mark.fem
def test_what_is_not_reached_is_said(tmp_path):
    settings = [*COARSE, "accuracy={tolerance=1e-4, solves=16, memory=16}", "model.body.degree=1"]
    study = load(TINY, settings)
    assert study.estimates
    study.run(tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert not summary["accuracy"]["kept"]
    texts = [
        one["text"] for one in summary["findings"] if "is not reached" in one["text"] and one["severity"] == "error"
    ]
    assert len(texts) == 1
    assert "accuracy.memory = 16 MiB" in texts[0]


@pytest.mark.slow
@pytest.mark.fem
def test_what_is_out_of_reach_is_refused_in_a_line_before_the_long_work(tmp_path, capsys):
    tiny = ("model.body.cell=tetrahedron", "model.body.degree=1", "accuracy={tolerance=1e-6, memory=100}")
    settings = (word for one in (*COARSE, *tiny) for word in ("--set", one))
    assert main(["run", str(TINY), "--out", str(tmp_path / "out"), "--quiet", *settings]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "accuracy.tolerance = 1e-06 is out of reach: the mesh of" in line
    assert not (tmp_path / "out" / "results.nc").exists()


@pytest.mark.fem
@pytest.mark.parametrize(
    ("setting", "kept", "said"),
    [
        ("accuracy={tolerance=0.1, memory=1}", False, "more than accuracy.memory = 1 MiB"),
        ("accuracy={tolerance=0.1, mesh_error=false}", True, "accuracy.mesh_error = false"),
    ],
)
def test_an_error_of_the_mesh_that_is_not_known_keeps_no_tolerance_unless_it_was_not_asked_for(
    tmp_path, setting, kept, said
):
    study = load(TINY, [*COARSE, setting, "model.body.degree=1"])
    assert not study.estimates
    study.run(tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    told, errors = summary["accuracy"], [one for one in summary["findings"] if one["severity"] == "error"]
    assert told["kept"] is kept
    assert not told["mesh"]["estimated"]
    assert told["shares"]["total"] <= 1
    assert len(errors) == (not kept)
    assert kept or "The error of the mesh is not known" in errors[0]["text"]
    assert any(said in one["text"] for one in summary["findings"])


def test_too_few_solves_are_said(tmp_path):
    study = without_method(1e-9, solves=16)
    wide = {"kind": "uniform", "lower": 1e5, "upper": 1e6}
    parse(document(study) | {"parameters": document(study)["parameters"] | {"E": wide}}).run(tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert not summary["accuracy"]["kept"]
    assert any("accuracy.solves = 16" in one["text"] for one in summary["findings"])


@pytest.mark.unit
def test_no_number_of_estimates_is_told_that_a_tolerance_does_not_keep_to():
    fine = "model.body.cells=[40, 4, 12]"
    given, study = load(TINY, [fine, "method={kind='chaos', samples=4}"]), asked(1e-3, fine)
    assert any("at 2 points only" in one.text for one in given.findings)
    assert study.estimates == 2
    assert not any("points only" in one.text for one in study.findings)
    assert any("3 to 9 estimates on each mesh" in line for line in plan(study))


def test_a_number_of_samples_of_the_method_is_the_limit_that_is_named(tmp_path):
    study = without_method(1e-9, solves=100)
    wide = {"kind": "uniform", "lower": 1e5, "upper": 1e6}
    blocks = {"parameters": document(study)["parameters"] | {"E": wide}, "method": {"kind": "chaos", "samples": 8}}
    found = parse(document(study) | blocks)
    assert any("the number of solves (up to 8)" in line for line in plan(found))
    found.run(tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert any(
        "More solves than accuracy.solves = 100 and method.samples = 8" in one["text"] for one in summary["findings"]
    )
