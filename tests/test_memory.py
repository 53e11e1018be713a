"""Long sample loops do not leak communicators, PETSc objects or anything else."""

import numpy as np
import pytest
from mpi4py import MPI

from benchmarks.throughput import resident
from tests.launch import ROOT
from workflows.config import load


@pytest.mark.fem
@pytest.mark.slow
def test_memory_is_flat_over_ten_thousand_realisations():
    study = load(ROOT / "configs" / "tiny.toml", ["model.body.cells=[2, 1, 1]"])
    model = study.model.build(MPI.COMM_SELF, study.inputs.names)
    start = model.solve(study.inputs.mean).state
    sizes = []
    for i in range(10_000):
        model.solve(study.inputs.mean * (1 + 0.01 * np.sin(i)), start).tangent(np.ones(2))
        if i % 1000 == 999:
            sizes.append(resident())
    assert max(sizes) - sizes[0] < 1, sizes
