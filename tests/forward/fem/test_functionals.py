"""Outputs of finite elements: forms that live as long as their output."""

import numpy as np
import pytest
from mpi4py import MPI

from forward.observables.integrals import StrainEnergy, VolumeChange
from tests.bodies import loaded_body

pytestmark = pytest.mark.fem


def test_outputs_that_are_made_and_dropped_never_get_forms_of_each_other():
    """An address of memory is used again by what is made next: it says nothing of what a form is of."""
    spec = loaded_body("mooney-rivlin")
    model = spec.build(MPI.COMM_SELF, ("material.C1",))
    model.solve(np.array([1.1e4])).visit()
    outputs = (StrainEnergy(name="energy"), VolumeChange(name="volume"))
    kept = [output.functional(model.equations) for output in outputs]
    expected = [(one.gradient(), one.partial()) for one in kept]
    for turn in range(40):
        which = turn % 2
        made = outputs[which].functional(model.equations)
        np.testing.assert_array_equal(made.gradient(), expected[which][0])
        np.testing.assert_array_equal(made.partial(), expected[which][1])
        del made
