"""What `tissuq check` predicts."""

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from forward.fem import cost
from forward.fem.cost import CORRECTIONS, Linear
from workflows.config.study import load
from workflows.run.plan import plan
from workflows.studies.sampling import parts

CONFIGS = Path(__file__).parent.parent.parent.parent / "configs"


@pytest.mark.parametrize("cell", ["hexahedron", "tetrahedron"])
@pytest.mark.parametrize("form", ["displacement", "mixed"])
def test_predicted_times_grow_with_the_body(cell, form):
    found = []
    for n in (1, 2, 8, 30):
        changes = [f"model.body.cells=[{n}, {n}, {n}]", f"model.body.cell={cell}", f"model.formulation={form}"]
        changes.append("model.solver.linear=factor")
        study = load(CONFIGS / "tiny.toml", [*changes, "accuracy.memory=1e6"])
        found.append([part.seconds for part in parts(study)])
    assert np.isfinite(found).all()
    assert (np.array(found) > 0).all()
    grown = np.diff(np.sum(found, axis=1))
    assert (grown > 0).all()
    assert sum(found[0]) < 60  # little but the start of the program


@pytest.mark.unit
def test_estimates_take_a_fifth_of_the_study():
    large = ["model.body.cells=[30, 6, 12]", "model.formulation=mixed", "accuracy.memory=1e6"]
    for settings, count in (([], 3), (large, 2), ([*large, "method.samples=6144"], 16)):
        study = load(CONFIGS / "beam-qmc.toml", ["method.samples=48", "method.scrambles=3", *settings])
        assert study.estimates == count
        said = [one for one in study.findings if "at 2 points only" in one.text]
        assert len(said) == (count == 2)


def test_estimates_that_take_too_much_memory_are_left_out_and_it_is_said():
    study = load(CONFIGS / "organ.toml", ["accuracy.memory=500"])
    assert study.estimates == 0
    assert not any(line.startswith("mesh error") for line in plan(study, 1))
    (found,) = (one for one in study.findings if "accuracy.memory" in one.text)
    assert found.severity == "warning"
    whole = load(CONFIGS / "organ.toml")  # one large factor at a time
    assert whole.estimates > 0
    assert whole.memory > whole.spec.mesh_error_cost().bytes
    off = load(CONFIGS / "organ.toml", ["accuracy.mesh_error=false"])
    assert not any("accuracy.memory" in one.text for one in off.findings)


@pytest.mark.unit
def test_the_finer_mesh_that_calibrates_estimates_counts():
    study = load(CONFIGS / "beam.toml")
    cost = study.spec.mesh_error_cost(study.spare)
    assert cost.calibration_bytes > cost.bytes
    between = (cost.bytes + cost.calibration_bytes / 2) / 2**20
    short = load(CONFIGS / "beam.toml", [f"accuracy.memory={between:.0f}"])
    assert short.estimates == 0
    assert study.estimates > 0
    (found,) = (one for one in short.findings if "accuracy.memory" in one.text)
    assert f"{(cost.bytes + cost.calibration_bytes) / 2**20:,.0f} MiB" in found.text


def test_the_plan_is_the_sum_of_its_parts(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    study = load(CONFIGS / "beam.toml")

    def shown(rank_groups):
        lines = plan(study, rank_groups)
        (first,) = [i for i, line in enumerate(lines) if line.startswith("time ")]
        return lines[first:]

    told = "\n".join(shown(1))
    for what in ("start", "compilation", "first solve", "its tangents", "reference factor", "256 further", "report"):
        assert what in told
    total, *each = [float(re.search(r"([0-9.]+) s", line)[1]) for line in shown(1)]
    assert sum(each) == pytest.approx(total, abs=0.6)
    assert float(re.search(r"about ([0-9.]+) s", shown(8)[0])[1]) < total  # samples are shared, the rest is not
    (tmp_path / "tissuq" / "forms-0" / "libffcx_form").mkdir(parents=True)
    assert "  compilation" not in "\n".join(shown(1))
    assert "are not compiled yet" in shown(1)[-1]


@pytest.mark.unit
def test_newton_from_zero_takes_longer_than_corrections():
    study, textbook = (load(CONFIGS / "beam.toml", [f"model.solver={kind}"]) for kind in ("predict-correct", "newton"))
    seconds = [{part.what.partition(",")[0]: part.seconds for part in parts(one)} for one in (study, textbook)]
    assert seconds[1]["256 further solves"] > 5 * seconds[0]["256 further solves"]
    assert "reference factor" not in seconds[1]


CONTACT = """
[model]
kind = "KIND"
body = { kind = "box", size = [0.01, 0.01, 0.01], cells = [4, 4, 4], degree = 2 }
material = { kind = "neo-hookean-coupled", mu = 1e3, lmbda = 1e3 }
clamp = ["z-min"]
outputs = [{ name = "force", kind = "force" }]
loads = [{ kind = "indenter", shape = "sphere", radius = 0.005, on = "z-max", at = [0.005, 0.005, 0.01], direction = [0, 0, -1], depth = DEPTH }]

[method]
kind = "synthesize"
noise = { relative = 0.03 }
"""  # noqa: E501


@pytest.mark.unit
def test_every_step_under_a_tool_costs_what_one_from_afar_does(tmp_path):
    """What is in contact changes at every step: a sample takes six corrections a step, as one depth does.

    One study names no kind: it has outputs and no load cases, so it is a body.
    """
    (tmp_path / "once.toml").write_text(CONTACT.replace('kind = "KIND"\n', "").replace("DEPTH", "1e-3"))
    (tmp_path / "steps.toml").write_text(CONTACT.replace("KIND", "path").replace("DEPTH", "[0.5e-3, 1e-3]"))
    once, steps = (load(tmp_path / f"{name}.toml").spec.cost() for name in ("once", "steps"))
    assert once.contact
    assert once.textbook == pytest.approx(steps.textbook / 2)
    assert once.corrected == pytest.approx(steps.corrected / 2)
    assert once.factorisation == pytest.approx(steps.factorisation / 2)


def test_many_samples_share_passes_through_the_factor():
    """Samples of a block are corrected together from 32 on; what is left are residuals, and a share of the solves."""
    cost = load(CONFIGS / "beam.toml").model.cost()
    assert cost.in_company(1) == cost.sample
    assert cost.in_company(16) == pytest.approx(cost.sample - (CORRECTIONS[True] + 2) * 0.703125 * cost.substitution)
    assert dataclasses.replace(cost, contact=True).in_company(16) == dataclasses.replace(cost, contact=True).sample
    each = []
    for samples in (16, 256):  # without expansions in between
        study = load(CONFIGS / "beam.toml", [f"method.samples={samples}"])
        (line,) = (line for line in plan(study, 1) if "further solves" in line)
        each.append(float(line.split()[-3]))
    assert each[1] == pytest.approx(cost.in_company(16), rel=0.05)
    assert each[0] == pytest.approx(cost.sample, rel=0.05)


@pytest.mark.unit
def test_a_million_unknowns_fit_into_the_memory_of_one_machine():
    study = load(CONFIGS / "beam-million.toml")
    assert study.spec.unknowns > 1e6
    said = {part.what: part.seconds for part in parts(study)}
    assert study.memory < 12 * 2**30
    assert "reference factor" not in said
    assert 60 < sum(said.values()) < 4 * 3600
    factors = load(CONFIGS / "beam-million.toml", ["model.solver.linear=factor"])
    assert factors.memory > 24 * 2**30
    (line,) = (words for what, words in study.model.described({}) if what == "linear")
    assert line == "multigrid, without a factor of the stiffness"


@pytest.mark.unit
def test_what_takes_the_place_of_factors_is_cheaper_where_it_is_chosen():
    """And takes less memory; smaller bodies have factors."""
    body = load(CONFIGS / "beam-million.toml").spec.body
    few = body.model_copy(update={"cells": (20, 2, 7)})
    some = body.model_copy(update={"cells": (44, 6, 16)})
    assert cost.linear_solver(few, symmetric=True) == Linear.FACTOR
    assert cost.linear_solver(some, symmetric=True) == Linear.BOTH
    assert cost.linear_solver(body, symmetric=True) == Linear.MULTIGRID
    for one in (some, body):
        factor, both, alone = (cost.times(one, mixed=False, factors=2, linear=linear) for linear in Linear)
        assert alone.bytes < both.bytes < factor.bytes
        assert both.first < factor.first
        assert both.factorisation == factor.factorisation


def test_a_check_imports_no_library_of_methods():
    """These take as long as all else of a check."""
    names = [str(CONFIGS / f"{name}.toml") for name in ("inclusion", "beam", "slab")]
    code = f"""
import sys
from pathlib import Path
from workflows.config.study import load
from workflows.run.plan import plan
for name in {names}:
    plan(load(Path(name)))
print([name for name in ("scipy", "xarray", "chaospy", "dolfinx", "mpi4py") if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
