"""Models that are restricted to what was measured."""

import numpy as np
import pytest

from forward.model import MeshError, Saturation, Work
from inverse.data.measured_model import MeasuredSolution

FACTORS = Saturation(np.array([1.0, 2.0, 3.0]), 1.5, 1.6, shifts=np.array([0.1, 0.2, 0.3]), doubts=None)


class Estimated:
    """A solution with estimates of the error of its mesh."""

    def mesh_error(self):
        return MeshError(np.array([0.5, 0.6, 0.7]), np.zeros(2), 0.0, 0.0, Work())

    def saturation(self, spare):
        return FACTORS


@pytest.mark.unit
def test_calibrations_are_those_of_the_measured_outputs():
    """All of them: an output may be measured twice, or not at all."""
    solution = MeasuredSolution(Estimated(), [2, 0, 2], 3)
    found = solution.saturation()
    assert found.outputs.tolist() == [3.0, 1.0, 3.0]
    assert found.shifts.tolist() == [0.3, 0.1, 0.3]
    assert found.doubts is None
    calibrated = solution.mesh_error().calibrated(found)
    np.testing.assert_allclose(calibrated.outputs, [2.4, 0.6, 2.4])
