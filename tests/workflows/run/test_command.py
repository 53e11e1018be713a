"""The command line, run as users run it: exit codes, restart, ranks, bad directories."""

import importlib.metadata
import json
import random
import shutil
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr

from tests.launch import (
    ROOT,
    TISSUQ,
    assert_same_bits,
    environment,
    in_process,
    killed,
    run,
    run_script,
    tissuq_on_two_ranks,
    without_pictures,
)

TINY = ROOT / "configs" / "tiny.toml"
# Under a load that no body bears the solver gives up soon.
SOON = ("--set", "model.solver.minimum_load_step=0.5", "--set", "model.solver.iterations=4")


def tissuq(*arguments, ranks=None):
    return run(ranks, TISSUQ, *arguments)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The tiny study, run in one process."""
    directory = tmp_path_factory.mktemp("run") / "tiny"
    with without_pictures():
        done = in_process("run", TINY, "--out", directory)
    assert done.returncode == 0, done.stderr
    return directory


def test_check_needs_neither_fenicsx_nor_mpi():
    script = (
        "import sys; from workflows.__main__ import main; code = main(['check', sys.argv[1]]); "
        "heavy = {'dolfinx', 'mpi4py', 'petsc4py', 'ufl', 'scipy', 'xarray', 'matplotlib', 'pyvista', 'h5py'}; "
        "heavy |= {'inverse'}; "
        "print(sorted(heavy & set(sys.modules))); sys.exit(code)"
    )
    done = run_script(None, script, TINY)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[]"
    assert "unknowns    405" in done.stdout


DRAWING = {"matplotlib", "PIL", "pyvista", "vtkmodules", "jinja2", "chaospy", "inverse", "scipy.stats"}
ENDS = (".draws", ".posteriors", "of_draws", "estimators.shapley", "accuracy.goal", "automatic")


def test_a_run_imports_nothing_that_was_not_asked_for(tmp_path):
    """What draws, scipy.stats for Sobol' points, VTK for files that ParaView reads; draws, tolerances, errors of meshes
    and reduced models."""
    script = (
        "import sys; from workflows.__main__ import main; code = main(['run', *sys.argv[1:], '--no-report']); "
        "print(*sys.modules); sys.exit(code)"
    )
    chaos = ("--set", 'method.kind="chaos"', "--set", "method.samples=6", "--set", "method.max_order=2")
    chaos += ("--set", "model.body.cells=[2, 1, 1]")
    done = run_script(None, script, TINY, *chaos, "--set", "mesh_error=false", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    names = set(done.stdout.splitlines()[-1].split())
    assert "uq.methods.chaos" in names
    assert not DRAWING & names
    assert not [name for name in names if name.endswith(ENDS) or "tolerance" in name]
    assert not [name for name in names if name.startswith("uq.accuracy.") and name != "uq.accuracy.budget"]
    assert not [name for name in names if name.startswith(("forward", "workflows")) and "reduc" in name]
    assert (tmp_path / "out" / "fields" / "displacement.vtu").exists()


def test_uq_does_not_import_fenicsx():
    script = (
        "import sys, uq.methods.monte_carlo, uq.evaluation.evaluate, uq.evaluation.checkpoint; "
        "import uq.inputs.random_parameters; "
        "print(sorted({'dolfinx', 'mpi4py', 'inverse'} & set(sys.modules)))"
    )
    done = run_script(None, script)
    assert done.stdout.strip() == "[]"


def test_check_lists_every_mistake(tmp_path):
    path = tmp_path / "bad.toml"
    path.write_text(TINY.read_text().replace("samples", "sampels").replace('"x-min"', '"x-mid"'))
    done = in_process("check", path)
    assert done.returncode == 2
    lines = done.stderr.splitlines()
    assert len(lines) == 2
    assert "did you mean 'samples'" in done.stderr
    assert "did you mean 'x-min'" in done.stderr


def test_usage_errors_exit_with_2():
    assert tissuq("fly").returncode == 2
    assert in_process("run").returncode == 2
    done = in_process("init", "mcmc")
    assert done.returncode == 2
    assert "expected one of: chaos, compare" in done.stderr


def test_the_version_is_that_of_the_distribution():
    done = tissuq("--version")
    assert (done.returncode, done.stdout) == (0, f"tissuq {importlib.metadata.version('tissuq')}\n")


def test_init_lists_all_kinds():
    done = in_process("init", "list")
    assert done.returncode == 0
    assert {"monte-carlo", "sobol", "select", "invert"} <= set(done.stdout.split())


def test_init_prints_a_study(tmp_path):
    path = tmp_path / "new.toml"
    path.write_text(in_process("init", "monte-carlo").stdout)
    assert in_process("check", path).returncode == 0


def test_report_needs_results(tmp_path):
    done = in_process("report", tmp_path)
    assert done.returncode == 1
    assert "holds no results" in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.fem
def test_the_directory_holds_what_is_promised(finished):
    summary = json.loads((finished / "summary.json").read_text())
    assert summary["study"] == "tiny"
    assert summary["method"] == "sensitivity-monte-carlo"
    assert summary["status"] == "complete"
    assert (summary["evaluations"], summary["failed"]) == (25, 0)
    assert summary["wall_seconds"] > 0
    assert summary["cpu_seconds"] > 0
    for output in ("uy_max", "ux_max"):
        assert {"mean", "mean_error", "std", "std_error"} <= set(summary["outputs"][output])
        assert set(summary["local"][output]) == {"loads.gravity.density", "material.D1"}
    for name in ("study.toml", "results.nc", "evaluations.h5", "report.html", "fields/displacement.vtu"):
        assert (finished / name).stat().st_size > 0
    assert not (finished / "evaluations").exists()
    assert not list(finished.glob(".*"))


@pytest.mark.fem
def test_a_finished_study_is_not_run_again(finished):
    before = {path: path.stat().st_mtime_ns for path in finished.rglob("*") if path.is_file()}
    done = in_process("run", TINY, "--out", finished)
    assert done.returncode == 0
    assert "nothing to do" in done.stdout
    assert {path: path.stat().st_mtime_ns for path in finished.rglob("*") if path.is_file()} == before


@pytest.mark.fem
def test_another_study_is_refused(finished):
    before = (finished / "study.toml").read_bytes()
    done = in_process("run", TINY, "--out", finished, "--set", "method.samples=25")
    assert done.returncode == 2
    assert "method.samples: 24 → 25" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert (finished / "study.toml").read_bytes() == before


@pytest.mark.fem
@pytest.mark.mpi
@pytest.mark.slow
def test_same_bits_on_any_number_of_groups(finished, tmp_path):
    """On three, and without mpirun; one and two are in the test of kills."""
    done = tissuq("run", TINY, "--out", tmp_path / "out", "--no-report", ranks=3)
    assert done.returncode == 0, done.stderr
    assert_same_bits(finished, tmp_path / "out")


@pytest.mark.slow
@pytest.mark.fem
@pytest.mark.mpi
def test_a_model_on_two_ranks_agrees(finished, tmp_path):
    shared = ("--set", "parallel.ranks_per_model=2", "--set", "parallel.blocks=5")
    done = tissuq_on_two_ranks("run", TINY, "--out", tmp_path / "out", "--no-report", *shared)
    assert done.returncode == 0, done.stderr
    one, two = (xr.load_dataset(d / "results.nc") for d in (finished, tmp_path / "out"))
    for name in ("values", "mean", "std", "derivative", "field_mean", "field_std"):
        scale = np.abs(one[name].values).max()
        np.testing.assert_allclose(two[name], one[name], rtol=1e-9, atol=1e-9 * scale)


@pytest.mark.fem
@pytest.mark.mpi
def test_one_solve_at_the_means(finished):
    """The value at the mean parameters that a study states; ranks share the body, and the first of them prints."""
    stated = xr.load_dataset(finished / "results.nc")["nominal"]
    script = "import sys; from workflows.__main__ import main; code = main(['solve', sys.argv[1]]); print(*sys.modules)"
    done = run_script(None, script, TINY)
    assert done.returncode == 0, done.stderr
    first, _, means, took, names = done.stdout.splitlines()
    assert not {"xarray", "pandas", "chaospy", "matplotlib", "h5py"} & set(names.split())
    name, value, unit = first.split()
    assert (name, unit) == ("uy_max", "cm")
    assert float(value) == pytest.approx(100 * stated.sel(output="uy_max").item(), rel=1e-5)
    assert means == "at the means: loads.gravity.density = 750, material.D1 = 300,000"
    assert "error of the mesh not known" in took
    shared = tissuq_on_two_ranks("solve", TINY)
    assert shared.stdout.splitlines()[:3] == done.stdout.splitlines()[:3]


@pytest.mark.fem
def test_what_has_no_single_model_or_no_answer_is_not_solved():
    done = in_process("solve", ROOT / "configs" / "inclusion.toml")
    assert (done.returncode, done.stdout) == (2, "")
    assert "is of kind 'invert', expected a study of one model to solve" in done.stderr
    far = 'parameters."loads.gravity.density"={ kind = "uniform", lower = 1e6, upper = 1e7 }'
    done = in_process("solve", TINY, "--set", far, *SOON)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("failed: stopped at")


@pytest.mark.fem
@pytest.mark.mpi
def test_same_bits_after_kills_and_restarts_on_other_numbers_of_ranks(tmp_path):
    # Kills while errors of the mesh are estimated are in tests/workflows/studies/test_mesh_error.py.
    arguments = ("run", TINY, "--set", "method.samples=240", "--set", "mesh_error=false", "--no-report", "--out")
    whole = tmp_path / "whole"
    assert in_process(*arguments, whole).returncode == 0
    broken = tmp_path / "broken"
    chance = random.Random(1)
    for ranks in (2, 1):
        assert killed(ranks, chance.randint(2, 7), TISSUQ, *arguments, broken)
    done = tissuq_on_two_ranks(*arguments, broken)
    assert done.returncode == 0, done.stderr
    assert_same_bits(whole, broken)


CHEAP = """
[model]
kind = "python"
function = "tests.functions.cube"
parameters = { a = 1 }
outputs = ["y"]

[parameters]
a = { kind = "normal", mean = 1, std = 0.5 }
"""


@pytest.mark.fem
@pytest.mark.mpi
@pytest.mark.slow
@pytest.mark.parametrize(("model", "samples"), [(CHEAP, 100_000), (TINY.read_text(), 1000)], ids=["python", "body"])
def test_same_bits_of_many_samples_after_two_kills_on_two_ranks(tmp_path, model, samples):
    """A cheap model at 10⁵ points and a body at 10³: what a laptop does in a minute."""
    (tmp_path / "study.toml").write_text(model)
    method = f"method={{kind='monte-carlo', samples={samples}, seed=1}}"
    arguments = ("run", tmp_path / "study.toml", "--set", method, "--no-report", "--out")
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    done = tissuq_on_two_ranks(*arguments, whole)
    assert done.returncode == 0, done.stderr
    chance = random.Random(samples)
    for _ in range(2):
        assert killed(2, chance.randint(1, 60), TISSUQ, *arguments, broken)
    done = tissuq_on_two_ranks(*arguments, broken)
    assert done.returncode == 0, done.stderr
    assert_same_bits(whole, broken)


@pytest.mark.fem
@pytest.mark.mpi
def test_more_ranks_than_work(tmp_path):
    """The others are idle, and the results the same."""
    settings = ("--set", "parallel.blocks=1", "--set", "mesh_error=false", "--set", "method.samples=6")
    arguments = ("run", TINY, "--no-report", *settings, "--out")
    done = tissuq_on_two_ranks(*arguments, tmp_path / "out")
    assert done.returncode == 0, done.stderr
    (said,) = [line for line in done.stderr.splitlines() if line.startswith("note:")]
    assert said.startswith("note: 2 groups of ranks were started for 1 task: 1 of them will be idle")
    alone = in_process(*arguments, tmp_path / "alone")
    assert "note:" not in alone.stderr
    assert_same_bits(tmp_path / "alone", tmp_path / "out")


@pytest.mark.fem
def test_failed_solves_are_recorded_and_exit_with_3(tmp_path, undrawn):
    changes = (
        "parameters.loads.gravity.density={kind='gamma', shape=1, scale=800, shift=100}",  # a long tail
        "model.solver.minimum_load_step=1.0",
        "model.solver.iterations=10",
        "model.body.cells=[4, 1, 1]",
        "method.samples=12",
        "method.seed=2",
        "method.fields=false",
        "mesh_error=false",
    )
    done = in_process("run", TINY, "--out", tmp_path / "out", *(word for c in changes for word in ("--set", c)))
    assert done.returncode == 3, done.stderr
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["status"] == "partial"
    assert summary["failed"] == len(summary["failures"]) > 0
    assert "of the load" in summary["failures"][0]["reason"]
    assert f"{summary['failed']} of 12 samples have no answer" in summary["note"]
    assert "their errors do not cover" in summary["note"]
    assert summary["failures"][0]["reason"] in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.fem
@pytest.mark.mpi
@pytest.mark.parametrize("ranks_per_model", [1, 2])
def test_a_model_without_answer_does_not_hang_on_two_ranks(tmp_path, ranks_per_model):
    heavy = "parameters.loads.gravity.density={kind='uniform', lower=1e9, upper=2e9}"
    share = f"parallel.ranks_per_model={ranks_per_model}"
    done = tissuq_on_two_ranks("run", TINY, "--out", tmp_path / "out", "--set", heavy, "--set", share, *SOON)
    assert done.returncode == 1
    assert done.stderr.count("failed: the model has no answer at the mean parameters") == 1
    assert not (tmp_path / "out").exists()  # a corrected study may go there


@pytest.mark.fem
def test_a_model_without_answer_exits_with_1_and_one_line(tmp_path):
    heavy = ["--set", "parameters.loads.gravity.density={kind='uniform', lower=1e9, upper=2e9}"]
    done = in_process("run", TINY, "--out", tmp_path / "out", *heavy, *SOON)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("failed: the model has no answer at the mean parameters: stopped at")
    assert "Traceback" not in done.stderr


def test_directories_that_cannot_be_used(tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "thesis.tex").write_text("precious")
    for directory, message in ((file / "out", "Not a directory"), (foreign, "is not empty and holds no study")):
        done = in_process("run", TINY, "--out", directory)
        assert done.returncode == 2
        assert message in done.stderr
        assert len(done.stderr.splitlines()) == 1
    assert (foreign / "thesis.tex").read_text() == "precious"


def test_point_outside_the_body(tmp_path):
    path = tmp_path / "study.toml"
    outside = '{ name = "p", kind = "displacement", at = [1, 0, 0], component = "x" },\n]\n\n[parameters]'
    path.write_text(TINY.read_text().replace("]\n\n[parameters]", outside))
    done = in_process("run", path, "--out", tmp_path / "out")
    assert done.returncode == 2, done.stderr
    assert "model.outputs[2].at" in done.stderr
    shutil.rmtree(tmp_path / "out", ignore_errors=True)


@pytest.mark.mpi
def test_a_process_alone_starts_no_daemon():
    """Open MPI would start one for a process that no launcher has started; with a launcher it has all its ways."""
    alone = "from mpi4py import MPI; import os; print(open(f'/proc/self/task/{os.getpid()}/children').read().split())"
    asked = "import workflows.__main__; import os; print(os.environ.get('OMPI_MCA_ess_singleton_isolated'))"
    env = {name: value for name, value in environment().items() if not name.startswith(("OMPI_MCA_", "SLURM_"))}
    for ranked, code, expected in (
        ({}, f"import workflows.__main__; {alone}", "[]"),
        ({"SLURM_PROCID": "0"}, asked, "None"),
        ({"PMIX_RANK": "0"}, asked, "None"),
    ):
        done = subprocess.run(
            [sys.executable, "-c", code], env=env | ranked, capture_output=True, text=True, check=True
        )
        assert done.stdout.strip() == expected
