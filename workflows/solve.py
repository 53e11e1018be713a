"""One solve of the model of a study, at the means of its random parameters."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from mpi4py import MPI

from forward.readable import number, told

if TYPE_CHECKING:
    from workflows.studies.study import Sampled


def solved(sampled: Sampled) -> str:
    """Solve, and return the outputs, the point, and what it took, in lines; collective.

    All ranks share the model, where it can be shared; else the first has it. The others return "". A ModelError says
    that it cannot be made, a SolveError that it has no answer.
    """
    inputs, spec = sampled
    world = MPI.COMM_WORLD
    if world.rank and not spec.shareable:
        return ""
    begin = time.process_time()
    model = spec.build(world if spec.shareable else MPI.COMM_SELF, inputs.names)
    made = time.process_time()
    solution = model.solve(inputs.mean)
    took, setup = time.process_time() - made, made - begin
    if world.rank:
        return ""
    longest = max(len(output.name) for output in spec.returned)
    values = zip(spec.returned, solution.outputs.tolist(), strict=True)
    lines = [f"{output.name:{longest}}  {told(value, output.unit, 6)}" for output, value in values]
    means = zip(inputs.names, inputs.mean.tolist(), strict=True)
    lines.append("at the means: " + ", ".join(f"{name} = {number(mean, 4)}" for name, mean in means))
    lines.append(
        f"one solve, {took:.2f} s of processor time after a set-up of {setup:.2f} s; error of the mesh not known"
    )
    return "\n".join(lines) + "\n"
