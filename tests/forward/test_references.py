"""Every DOLFINx gives the same numbers."""

import json

import numpy as np
import pytest

from tests.references import BODIES, KEPT, computed

pytestmark = [pytest.mark.fem, pytest.mark.flags]


@pytest.mark.parametrize("name", BODIES)
def test_outputs_and_derivatives_are_those_of_every_dolfinx(name):
    expected = json.loads(KEPT.read_text(encoding="utf-8"))[name]
    for what, values in computed(name).items():
        rounding = 1e-14 * np.abs(expected[what]).max()  # for clamped points, which do not move
        np.testing.assert_allclose(values, expected[what], rtol=1e-9, atol=rounding, err_msg=what)
