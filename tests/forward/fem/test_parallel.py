"""A model spread over several ranks gives what one rank gives."""

import json

import numpy as np
import pytest

from tests.bodies import MIXED
from tests.launch import run_script

pytestmark = [pytest.mark.fem, pytest.mark.mpi]

SCRIPT = """
import json
import sys
import numpy as np
from forward.conformance import check_derivatives
from forward.model import Guess, SolveError
from tests.bodies import OUTPUTS, loaded_body
from tests.ranks import groups

# Corners, edges and faces of cells, and their insides: every kind of place that ranks can share.
places = [(x, y, z) for x in (1.0, 0.25, 0.37) for y in (0.35, 0.51) for z in (0.8, 0.4, 0.11)]
points = tuple(
    {"kind": "displacement", "name": f"point {i}", "at": at, "component": "xyz"[i % 3]} for i, at in enumerate(places)
)

def solve(material, comm):
    spec = loaded_body(material, body={"cells": (4, 2, 2)}, outputs=OUTPUTS + points)
    parameters = tuple(spec.scalars)
    values = np.array([scalar.value for scalar in spec.scalars.values()])
    model = spec.build(comm, parameters)

    if comm.size == 3 and material == "mooney-rivlin":
        soon = spec.model_copy(update={"solver": spec.solver.model_copy(update={"minimum_load_step": 0.25})})
        try:
            soon.build(comm, parameters).solve(np.where(np.array(parameters) == "loads.gravity.density", 1e9, values))
        except SolveError as error:
            reasons = comm.allgather(str(error))
        assert len(set(reasons)) == 1, reasons

    solution = model.solve(values)
    state = model.space.gather(solution.state[None])
    slopes = model.space.gather(np.array([solution.state_tangent(direction) for direction in np.diag(values)]))
    tangents = np.array([solution.tangent(direction) for direction in np.diag(values)])
    gradients = np.array([solution.adjoint(weights) for weights in np.eye(len(model.outputs))])
    for array in (solution.outputs, tangents, gradients):
        assert all(np.array_equal(array, other) for other in comm.allgather(array)), "ranks disagree"

    # Back and forth through the canonical order; a state from elsewhere is a start.
    whole = comm.bcast(state)
    assert np.array_equal(model.space.scatter(whole)[0], solution.state)
    again = model.solve(values, Guess(model.space.scatter(whole)[0]))
    assert again.work.factorisations == 1  # that which counts eigenvalues

    if comm.size == 2 and material == "neo-hookean":  # of the others they are those of one rank, as is compared
        steps, directions = (1 / 32, 1 / 64, 1 / 128), np.ones((1, len(values)))
        check_derivatives(model, values, 0.3 * values, directions=directions, steps=steps, accuracy=1e-12).require()
    cells, _ = model.space.cells()
    return {
        "outputs": solution.outputs,
        "state": state,
        "slopes": slopes,
        "tangents": tangents,
        "gradients": gradients,
        "coordinates": model.space.coordinates,
        "cells": cells,
    }

for comm in groups(*map(int, sizes := json.loads(sys.argv[2]))):
    for material in sizes[str(comm.size)]:
        arrays = solve(material, comm)
        if comm.rank == 0:
            np.savez(f"{sys.argv[1]}/{material} {comm.size}.npz", **arrays)
"""
SHAPES = ("mooney-rivlin", "neo-hookean", *MIXED)  # hexahedra and tetrahedra
SOME = ("mooney-rivlin", "neo-hookean mixed")  # hexahedra and tetrahedra, displacements and pressures
OTHERS = ("neo-hookean", "mooney-rivlin mixed")


def solved(place, sizes):
    """What is found on groups of ranks: of each material that is named for their number."""
    done = run_script(max(sizes), SCRIPT, place, json.dumps(sizes), timeout=1200)  # compiling all forms takes minutes
    assert done.returncode == 0, done.stdout + done.stderr
    return {ranks: {shape: dict(np.load(place / f"{shape} {ranks}.npz")) for shape in sizes[ranks]} for ranks in sizes}


@pytest.mark.parametrize(
    "sizes",
    [
        {1: SHAPES[1:3], 2: OTHERS[:1], 3: SOME[1:]},  # tetrahedra: displacements on two ranks, pressures on three
        *(
            pytest.param({1: SHAPES, **shared}, marks=pytest.mark.slow)
            for shared in ({2: OTHERS, 3: SOME}, {2: SOME, 3: OTHERS})
        ),
    ],
)
def test_ranks_agree_with_one(tmp_path, sizes):
    one, *shared = solved(tmp_path, sizes).values()
    for shape, found in (pair for group in shared for pair in group.items()):
        expected = one[shape]
        np.testing.assert_allclose(found["coordinates"], expected["coordinates"], rtol=0, atol=1e-14)
        np.testing.assert_array_equal(found["cells"], expected["cells"])
        np.testing.assert_allclose(found["outputs"], expected["outputs"], rtol=1e-9)
        for name in ("state", "slopes", "tangents", "gradients"):
            scales = np.abs(expected[name]).max(axis=-1, keepdims=True)
            np.testing.assert_allclose(found[name] / scales, expected[name] / scales, rtol=0, atol=1e-9, err_msg=name)
