"""Bodies that buckle somewhere in the range of their parameters: which unstable equilibria are returned, at what cost.

Every sample is solved twice: with ``accept_unstable``, whose state is judged by the eigenvalues of its dense stiffness
(its symmetric part under a pressure; less one negative for each pressure of the mixed form), and as it is, which must
refuse every state that the eigenvalues refute.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI

from benchmarks.beams import CONFIG
from forward.fem.model import HyperelasticModel
from forward.fem.reference import ReferenceFactor
from forward.hyperelastic import Hyperelastic
from forward.model import FloatArray, SolveError, Stability
from forward.solvers.stability import NOT_SCREENED, Screened
from forward.solvers.steps import finish
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import Distribution, Uniform
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import random_points
from uq.surrogates.linearisation import linearise
from workflows.config.study import load

SAMPLES = 125  # of each problem: 1 000 in all
LARGE = [24, 4, 6]  # cells of a beam with about 10⁴ unknowns


@dataclass(frozen=True)
class Problem:
    """A body and the parameters in whose range it loses stability."""

    spec: Hyperelastic
    inputs: Inputs


def uniform(**ranges: tuple[float, float]) -> dict[str, Distribution]:
    """Return uniform distributions by path, with _ and __ for the dots and the dashes that names cannot have."""
    return {
        path.replace("__", "-").replace("_", "."): Uniform(kind="uniform", lower=low, upper=high)
        for path, (low, high) in ranges.items()
    }


def problem(parameters: dict[str, Distribution], **blocks: Any) -> Problem:
    """Return a problem of neo-Hookean material, hexahedra and the clamp x-min, unless `blocks` say something else."""
    body = {"degree": 2} | blocks.pop("body")
    usual = {
        "material": {"kind": "neo-hookean", "C1": 1e4, "D1": 1e5},
        "clamp": ["x-min"],
        "formulation": "displacement",
        "outputs": [{"kind": "strain-energy", "name": "W"}],
    }
    spec = Hyperelastic.model_validate(usual | {"body": body} | blocks)
    return Problem(spec, Inputs(parameters))


def pushed(size: float) -> list[dict[str, Any]]:
    """Return a dead load along −x on the end."""
    return [{"kind": "traction", "on": "x-max", "direction": [-1, 0, 0], "size": size}]


def column() -> Problem:
    """Column under a dead load."""
    body = {"size": [1.0, 0.1, 0.1], "cells": [8, 1, 1]}
    return problem(uniform(loads_traction_size=(80, 150)), body=body, loads=pushed(115))


def soft_column() -> Problem:
    """Column under a dead load, of uncertain stiffness."""
    body = {"size": [1.0, 0.1, 0.1], "cells": [8, 1, 1]}
    ranges = uniform(loads_traction_size=(70, 130), material_C1=(0.8e4, 1.2e4), material_D1=(0.5e5, 2e5))
    return problem(ranges, body=body, loads=pushed(100))


def block() -> Problem:
    """Block compressed between clamps."""
    moved = [{"on": "x-max", "x": -0.5, "y": 0.0, "z": 0.0}]
    body = {"size": [1.0, 0.7, 0.8], "cells": [4, 2, 2]}
    ranges = uniform(displacements_x__max_x=(-0.66, -0.5))
    return problem(ranges, body=body, displacements=moved)


def plate() -> Problem:
    """Plate compressed in its plane between clamps."""
    moved = [{"on": "x-max", "x": -0.01, "y": 0.0, "z": 0.0}]
    body = {"size": [1.0, 0.05, 0.5], "cells": [6, 1, 3]}
    ranges = uniform(displacements_x__max_x=(-0.016, -0.002), material_D1=(0.5e5, 2e5))
    return problem(ranges, body=body, displacements=moved)


def cantilever() -> Problem:
    """Narrow cantilever that is bent in its plane and buckles sideways."""
    body = {"size": [1.0, 0.03, 0.15], "cells": [8, 1, 2]}
    loads = [{"kind": "traction", "on": "x-max", "direction": [0, 0, -1], "size": 30}]
    return problem(uniform(loads_traction_size=(5, 36)), body=body, loads=loads)


def arch() -> Problem:
    """Clamped arch under a vertical load on its top."""
    body = {"kind": "mesh", "file": str(arch_file()), "degree": 2}
    loads = [{"kind": "gravity", "direction": [0, 0, -1], "density": 100}]
    return problem(uniform(loads_gravity_density=(10, 45)), body=body, clamp=["ends"], loads=loads)


def mixed() -> Problem:
    """Nearly incompressible column in the mixed form."""
    body = {"size": [1.0, 0.2, 0.2], "cells": [4, 1, 1]}
    material = {"kind": "neo-hookean", "C1": 1e4, "D1": 1e7}
    ranges = uniform(loads_traction_size=(300, 700), material_D1=(0.5e7, 2e7))
    return problem(ranges, body=body, material=material, loads=pushed(500), formulation="mixed")


def follower() -> Problem:
    """Column under a pressure on its end, which follows it."""
    body = {"size": [1.0, 0.1, 0.1], "cells": [8, 1, 1]}
    loads = [{"kind": "pressure", "on": "x-max", "size": 200}]
    return problem(uniform(loads_pressure_size=(100, 800)), body=body, loads=loads)


def arch_file() -> Path:
    """Write the mesh of a shallow arch with a rectangular section, held at both ends; return its path."""
    import meshio

    n, thickness, width, rise = 10, 0.03, 0.1, 0.12
    s = np.linspace(-1, 1, n + 1)
    layers = [
        np.column_stack([s / 2, np.full(n + 1, y), rise * (1 - s**2) + z])
        for z in (-thickness / 2, thickness / 2)
        for y in (0.0, width)
    ]
    points = np.concatenate(layers)
    i, k = np.arange(n), n + 1
    cells = np.column_stack([i, i + 1, i + 1 + k, i + k, i + 2 * k, i + 1 + 2 * k, i + 1 + 3 * k, i + 3 * k])
    ends = np.array([[0, k, 3 * k, 2 * k], [n, n + k, n + 3 * k, n + 2 * k]])
    path = Path(tempfile.mkdtemp()) / "arch.msh"
    tags = [np.full(len(cells), 1), np.full(2, 2)]
    mesh = meshio.Mesh(
        points,
        [("hexahedron", cells), ("quad", ends)],
        cell_data={"gmsh:physical": tags, "gmsh:geometrical": tags},
        field_data={"body": np.array([1, 3]), "ends": np.array([2, 2])},
    )
    meshio.write(path, mesh, file_format="gmsh22", binary=True)
    return path


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "column": column,
    "column, stiffness too": soft_column,
    "clamped block": block,
    "plate": plate,
    "arch": arch,
    "sideways cantilever": cantilever,
    "mixed form": mixed,
    "follower pressure": follower,
}


@dataclass(frozen=True)
class Sample:
    """What came of a sample.

    Attributes
    ----------
    negative
        Negative eigenvalues at the state that is found where none is refused; −1 where there is none.
    lowest
        Smallest eigenvalue of the dense stiffness there over its largest.
    screened
        What the screen says of it.
    returned
        Negative eigenvalues at the state that is returned; −1 where none is.
    stability
        What is claimed.
    """

    negative: int
    lowest: float
    screened: Screened
    returned: int
    stability: int


def dense_inertia(model: HyperelasticModel, state: FloatArray, point: FloatArray) -> tuple[int, float]:
    """Negative eigenvalues of the dense stiffness, those of pressures apart, and the smallest over the largest."""
    equations = model.equations
    equations.set_parameters(point)
    equations.at_load(1.0)
    equations.set_state(state)
    dense = equations.sparse_stiffness().toarray()
    values = np.linalg.eigvalsh((dense + dense.T) / 2)
    return int((values < 0).sum()) - equations.unknowns.pressures, float(np.abs(values).min() / values.max())


def samples(case: Problem, count: int, seed: int = 0) -> list[Sample]:
    """Solve samples of a problem."""
    spec, inputs = case.spec, case.inputs
    lax = Hyperelastic.model_validate(spec.model_dump() | {"solver": {"accept_unstable": True}})
    strict, accepting = (one.build(MPI.COMM_SELF, inputs.names) for one in (spec, lax))
    centre = linearise(inputs, SerialEvaluate(strict))
    assert centre.prediction is not None
    guess = centre.prediction.on(strict)
    reference = guess(inputs.mean).reference
    found = []
    for point in inputs.points(random_points(seed, 0, count, len(inputs.names))):
        negative, lowest, seen = -1, np.nan, NOT_SCREENED
        try:
            state = np.array(accepting.solve(point, guess(point)).state)
        except SolveError:
            pass
        else:
            negative, lowest = dense_inertia(accepting, state, point)
            seen = screened(strict.reference.at(reference), strict, state, point)
        try:
            solution = strict.solve(point, guess(point))
        except SolveError as error:
            found.append(Sample(negative, lowest, seen, -1, error.stability))
            continue
        returned, _ = dense_inertia(accepting, np.array(solution.state), point)
        found.append(Sample(negative, lowest, seen, returned, solution.stability))
    return found


def screened(factor: ReferenceFactor, model: HyperelasticModel, state: FloatArray, point: FloatArray) -> Screened:
    """Return what the screen says of a state."""
    if not factor.prepare_screen():
        return NOT_SCREENED
    equations = model.equations
    equations.set_parameters(point)
    equations.at_load(1.0)
    residual = equations.residual(state)
    return finish(factor.screen(state, residual.vector, factor.rotation(state)), factor.solve)


def main() -> None:
    """Print the table of problems, and that of costs."""
    print("| problem | samples | unstable | returned | screen alone misses | false alarms | counted | refused |")
    print("|---|---|---|---|---|---|---|---|")
    for name, make in PROBLEMS.items():
        found = samples(make(), SAMPLES)
        unstable = [one for one in found if one.negative > 0]
        stable = [one for one in found if one.negative == 0]
        returned = sum(one.returned > 0 for one in found)
        missed = sum(one.screened.clear for one in unstable)
        alarms = sum(not one.screened.clear for one in stable)
        counted = sum(one.stability == Stability.COUNTED for one in found)
        refused = sum(one.returned < 0 for one in found)
        print(
            f"| {name} | {len(found)} | {len(unstable)} | {returned} | {missed} | {alarms} | {counted} | {refused} |",
            flush=True,
        )
    costs()


def costs(count: int = 30) -> None:
    """Print what testing stability adds to the processor time of samples, solved in turns with and without it."""
    print("\n| samples | unknowns | ms without | ms with | more | counted | set up |")
    print("|---|---|---|---|---|---|---|")
    beam = load(CONFIG)
    for name, cells, solver, n in (
        ("published beam", [12, 2, 4], "predict-correct", count),
        ("the same, finer", LARGE, "predict-correct", count),
        ("the same, textbook", [12, 2, 4], "newton", count // 6),
    ):
        body = beam.model.body.model_dump() | {"cells": cells}
        specs = [
            Hyperelastic.model_validate(
                beam.model.model_dump() | {"body": body, "solver": {"kind": solver, "accept_unstable": lax}}
            )
            for lax in (True, False)
        ]
        models = [spec.build(MPI.COMM_SELF, beam.inputs.names) for spec in specs]
        centre = linearise(beam.inputs, SerialEvaluate(models[0]))
        assert centre.prediction is not None
        seconds, ready, counted = np.zeros((n, 2)), np.zeros(2), 0
        starts = [centre.prediction.on(model) for model in models]
        for k, (model, guess) in enumerate(zip(models, starts, strict=True)):
            reference = guess(beam.inputs.mean).reference
            begin = time.process_time()
            if solver != "newton":
                model.reference.at(reference)
                if k == 1:
                    model.reference.prepare_screen()
            ready[k] = time.process_time() - begin
        for i, point in enumerate(beam.inputs.points(random_points(1, 0, n, len(beam.inputs.names)))):
            for k in (i % 2, 1 - i % 2):
                guess = starts[k]
                begin = time.process_time()
                solution = models[k].solve(point, guess(point))
                seconds[i, k] = time.process_time() - begin
                counted += k == 1 and solution.stability == Stability.COUNTED
        plain, tested = 1e3 * seconds.mean(axis=0)
        more = f"{100 * (tested / plain - 1):.0f} %"
        extra = f"{1e3 * (ready[1] - ready[0]):.0f} ms"
        unknowns = specs[0].unknowns
        print(f"| {name} | {unknowns} | {plain:.1f} | {tested:.1f} | {more} | {counted} of {n} | {extra} |", flush=True)
