"""Long sample loops do not leak communicators, PETSc objects or anything else."""

import pytest

from benchmarks.throughput import memory_over


@pytest.mark.fem
@pytest.mark.slow
def test_memory_is_flat_over_ten_thousand_realisations():
    sizes = memory_over(10_000)
    assert max(sizes) - sizes[0] < 1, sizes
