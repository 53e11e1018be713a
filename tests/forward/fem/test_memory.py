"""Long sample loops do not leak communicators, PETSc objects or anything else; what a factor takes is foreseen."""

import gc
import resource
from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from forward.fem.cost import factor
from forward.hyperelastic import Hyperelastic
from forward.machine import MIB
from tests.launch import run_script


@pytest.mark.fem
@pytest.mark.slow
def test_memory_is_flat_over_ten_thousand_realisations():
    done = run_script(None, "from benchmarks.throughput import memory_over; print(*memory_over(10_000))", timeout=3600)
    sizes = [float(size) for size in done.stdout.split()]  # in a process of its own: those of other tests free memory
    assert len(sizes) > 1, done.stderr
    assert max(sizes) - sizes[0] < 1, sizes


@pytest.mark.fem
def test_without_symmetry_two_triangles_are_foreseen_and_a_factor_of_the_symmetric_part():
    blocks = {
        "body": {"size": [1.0, 1.0, 1.0], "cells": [4, 4, 4], "degree": 2},
        "material": {"kind": "neo-hookean", "C1": 1e4, "D1": 1e5},
        "clamp": ["x-min"],
        "formulation": "displacement",
        "outputs": [{"kind": "strain-energy", "name": "W"}],
    }
    following, dead = (
        Hyperelastic.model_validate(blocks | {"loads": [load]})
        for load in (
            {"kind": "pressure", "on": "x-max", "size": 100.0},
            {"kind": "traction", "on": "x-max", "direction": [1, 0, 0], "size": 100.0},
        )
    )
    whole, half = (factor(following.body, mixed=False, symmetric=symmetric) for symmetric in (False, True))
    assert following.cost().bytes - dead.cost().bytes == pytest.approx(2 * whole.bytes)
    equations = following.build(MPI.COMM_SELF, ()).equations
    found = {}
    for solver, expected in ((equations.new_factor(), whole), (equations.new_symmetric_solver(), half)):
        assert solver._stiffness.expected == expected  # what is asked for before it is made
        solver.factorise()
        found[expected] = solver._ksp.pc.getFactorMatrix().getMumpsInfog(29)  # entries, by MUMPS
    assert found[whole] / found[half] == pytest.approx(whole.entries / half.entries, rel=0.15)


@pytest.mark.slow
@pytest.mark.fem
def test_models_that_are_gone_give_their_factors_back():
    """Before, a process that made one model after another kept all their factors."""
    spec = Hyperelastic.model_validate(
        {
            "body": {"size": [1.0, 1.0, 1.0], "cells": [6, 6, 6], "degree": 2},
            "material": {"kind": "neo-hookean", "C1": 1e4, "D1": 1e5},
            "clamp": ["x-min"],
            "formulation": "displacement",
            "loads": [{"kind": "traction", "on": "x-max", "direction": [1, 0, 0], "size": 100.0}],
            "outputs": [{"kind": "strain-energy", "name": "W"}],
        }
    )
    sizes = []
    for _ in range(3):
        spec.build(MPI.COMM_SELF, ("material.C1",)).solve(np.array([1e4]))
        gc.collect()
        sizes.append(int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize())
    assert sizes[-1] - sizes[0] < factor(spec.body, mixed=False, symmetric=True).bytes, [size / MIB for size in sizes]
