"""Runs that are killed: what is computed again, and that results have the same bytes."""

import json
import signal
from contextlib import contextmanager

import numpy as np
import pytest

from forward.fem.finer import FromStart
from forward.reduced.reduction import Reduction
from inverse.criticism.chains import Lengths, gradient_chains
from inverse.low_dimensional.posterior import Posterior
from tests.launch import in_process, on_kept_ranks, run_script
from uq.evaluation import kept
from uq.evaluation.block import BlockSolver

# Ends, or only counts, after so many solves.
SCRIPT = """
import os, signal, sys
from tests.workflows.run.test_kills import solves
from workflows.__main__ import main

with solves(int(sys.argv[1]), lambda: os.kill(os.getpid(), signal.SIGKILL)):
    main(sys.argv[2:])
"""
TESTS = """
[data]
file = "rubber.csv"
measured = "P_MPa"
unit = 1e6

[candidates.neo-hookean]
material = { kind = "neo-hookean" }
parameters.C1 = { kind = "log-normal", mean = 2e5, std = 1e5 }

[candidates.mooney-rivlin]
material = { kind = "mooney-rivlin" }
parameters.C1 = { kind = "log-normal", mean = 2e5, std = 1e5 }
parameters.C2 = { kind = "uniform", lower = 0, upper = 2e5 }

[method]
kind = "select"
samples = 32
starts = 1
noise = { relative = 0.05, absolute = 5e3 }
other_noises.larger = { relative = 0.1, absolute = 5e3 }
"""
TABLE = "test,mode,stretch,P_MPa\n" + "".join(
    f"one,uniaxial,{s},{0.4 * (s - s**-2)}\n" for s in (1.1, 1.3, 1.5, 1.8, 2.1)
)
# Twice, as two runs do: how often a start was solved for, the states that were kept, and the outputs.
STARTS = """
import sys
from pathlib import Path
from unittest.mock import patch
from mpi4py import MPI
from forward.fem import finer
from uq.evaluation.checkpoint import Checkpoint
from workflows.config.study import load
from workflows.studies.job import kept_starts

study, begun, begin = load(Path(sys.argv[1])), [], finer.FromStart._begin
with patch.object(finer.FromStart, "_begin", lambda *given: begun.append(1) or begin(*given)):
    for _ in range(2):
        keep = kept_starts(Checkpoint(Path(sys.argv[2]), "study"), MPI.COMM_WORLD)
        model = study.model.build(MPI.COMM_WORLD, tuple(study.parameters))
        there = finer.extrapolated(model, study.inputs.mean, keep).of(model)
        outputs = [there.solve(study.inputs.mean * factor).outputs.tolist() for factor in (1.0, 1.1)]
        if MPI.COMM_WORLD.rank == 0:
            print(len(begun), outputs, flush=True)
"""
CHAINS = """
[model]
kind = "python"
function = "bent.value"
jacobian = "bent.slopes"
parameters = { a = 1, b = 1 }
outputs = ["y"]

[parameters]
a = { kind = "normal", mean = 1, std = 0.5 }
b = { kind = "normal", mean = 1, std = 0.5 }

[data]
outputs = { y = 1.4 }
sigma = { y = 0.2 }

[method]
kind = "invert"
chains = "hmc"
samples = 32
starts = 1
seed = 1
"""
MESH = """
[model]
kind = "hyperelastic"
body = { kind = "box", size = [1, 1, 1], cells = [2, 2, 2], cell = "hexahedron", degree = 1 }
material = { kind = "neo-hookean", C1 = 1e4, D1 = 2e4 }
clamp = ["z-min"]
loads = [{ kind = "gravity", direction = [1, 0, 0], density = 200 }]
outputs = [{ name = "u", kind = "max-displacement" }]

[parameters]
"material.C1" = { kind = "log-normal", mean = 1e4, std = 3e3 }

[data]
outputs = { u = 0.08 }
sigma = { u = 0.004 }

[method]
kind = "invert"
samples = 32
starts = 1
seed = 1
"""
MODEL = """
def value(p):
    return [p[0] + 0.3 * p[1] ** 2]

def slopes(p):
    return [[1.0, 0.6 * p[1]]]
"""


class Killed(BaseException):
    """In place of a kill, where another process would take too long."""


@contextmanager
def solves(most, end):
    """Give the numbers of points of all solves, those of chains included; end after so many."""
    counts, kept_methods = [], (BlockSolver.__call__, Posterior.potential)

    def counted(solve, number):
        def solved(self, first, *more):
            found = solve(self, first, *more)
            counts.append(number(first))
            if sum(counts) - counts[-1] < most <= sum(counts):
                end()
            return found

        return solved

    BlockSolver.__call__, Posterior.potential = counted(kept_methods[0], len), counted(kept_methods[1], lambda _: 1)
    try:
        yield counts
    finally:
        BlockSolver.__call__, Posterior.potential = kept_methods


def run(folder, name, most=0, end=lambda: None):
    """Run the study of a folder in this process; the number of solves."""
    with solves(most, end) as counts:
        done = in_process("run", folder / "study.toml", "--out", folder / name, "--no-report", "--quiet")
    assert done.returncode in ({1} if most else {0, 3}), done.stderr
    return sum(counts)


def same(folder):
    """Whether the results of both runs are the same."""
    first, second = (json.loads((folder / name / "summary.json").read_text()) for name in ("whole", "parts"))
    assert first["evaluations"] == second["evaluations"]
    return (folder / "whole" / "results.nc").read_bytes() == (folder / "parts" / "results.nc").read_bytes()


def test_a_comparison_of_materials_goes_on_where_it_was_killed(tmp_path):
    """A step, of which there are two for each evidence, is lost at most: of 64 solves, and of the search for a mode."""
    (tmp_path / "study.toml").write_text(TESTS)
    (tmp_path / "rubber.csv").write_text(TABLE)
    whole = run(tmp_path, "whole")
    command = ("run", tmp_path / "study.toml", "--out", tmp_path / "parts", "--no-report", "--quiet")
    assert run_script(None, SCRIPT, int(0.8 * whole), *command).returncode == -signal.SIGKILL
    rest = run(tmp_path, "parts")
    assert rest <= 0.2 * whole + 64
    assert same(tmp_path)


@pytest.mark.slow
def test_chains_that_follow_gradients_go_on_where_they_were_killed(tmp_path, monkeypatch):
    """What is lost is what was not written yet."""
    pytest.importorskip("mici")
    monkeypatch.setattr(kept, "SECONDS_BETWEEN_STRETCHES", 0.005)
    few = gradient_chains.__wrapped__.__kwdefaults__
    monkeypatch.setitem(few, "lengths", Lengths(2, 40, 40, 1))
    monkeypatch.setitem(few, "budget", 1)
    (tmp_path / "study.toml").write_text(CHAINS)
    (tmp_path / "bent.py").write_text(MODEL)
    whole = run(tmp_path, "whole")

    def end():
        raise Killed

    before, after = run(tmp_path, "parts", whole // 2, end), run(tmp_path, "parts")
    assert before == whole // 2
    assert after < 0.6 * whole
    assert same(tmp_path)


@pytest.mark.slow
@pytest.mark.fem
def test_finer_meshes_are_not_solved_at_the_start_again(tmp_path, monkeypatch):
    """That takes most of an inversion for few parameters on a small machine."""
    begun, begin = [], FromStart._begin
    monkeypatch.setattr(FromStart, "_begin", lambda *given: begun.append(1) or begin(*given))
    (tmp_path / "study.toml").write_text(MESH)
    whole = run(tmp_path, "whole")
    assert len(begun) == 1

    def end():
        raise Killed

    parts = run(tmp_path, "parts", 5, end)  # in the search
    assert len(begun) == 2
    assert parts + run(tmp_path, "parts") <= whole + 1
    assert len(begun) == 2
    assert same(tmp_path)


@pytest.mark.slow
@pytest.mark.fem
@pytest.mark.mpi
def test_ranks_that_share_a_body_keep_its_start_too(tmp_path):
    (tmp_path / "study.toml").write_text(MESH)
    found = {}
    for ranks in (None, 2):
        done = on_kept_ranks(ranks, STARTS, tmp_path / "study.toml", tmp_path / str(ranks))
        assert done.returncode == 0, done.stderr
        (times, first), (again, second) = (line.split(maxsplit=1) for line in done.stdout.splitlines())
        assert (times, again) == ("1", "1")
        found[ranks] = json.loads(first)
        np.testing.assert_allclose(json.loads(second), found[ranks], rtol=1e-10)  # ranks add up in any order
    np.testing.assert_allclose(found[2], found[None], rtol=1e-8)


@pytest.mark.fem
def test_a_reduced_model_is_made_once(tmp_path, monkeypatch):
    """Killed while its errors are measured, a run finds the model and what chose its snapshots."""
    made, reduced = [], Reduction.reduced
    monkeypatch.setattr(Reduction, "reduced", lambda *given: made.append(1) or reduced(*given))
    blocks = MESH[: MESH.index("[data]")]
    few = '[method]\nkind = "reduce"\nsnapshots = 6\nrounds = 1\nunseen = 4\nmodes = 4\n'
    (tmp_path / "study.toml").write_text(blocks + few)
    whole = run(tmp_path, "whole")
    assert len(made) == 2

    def end():
        raise Killed

    assert run(tmp_path, "parts", whole - 1, end) >= whole - 1  # among those unseen
    assert len(made) == 4
    run(tmp_path, "parts")
    assert len(made) == 4
    assert same(tmp_path)
    one, other = (tmp_path / name / "reduced.npz" for name in ("whole", "parts"))
    assert one.read_bytes() == other.read_bytes()
