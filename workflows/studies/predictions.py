"""Parts of what studies say about themselves before they run, and the finer meshes that they look at models on."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import TYPE_CHECKING, Any

from forward.fem.cost import REPORT, START, Times
from forward.finer_meshes import finer, graded
from uq.accuracy.budget import SHARE

if TYPE_CHECKING:
    from forward.spec import ModelSpec

HOPELESS = 100  # times a textbook solve: what a failing solve may take, with its load steps
NONE_TO_SPARE = -1e9  # solves: for estimates without what calibrates them
PRODUCT = 0.12  # time of a product, of that of a solve by Newton's method from a state nearby
LOOKS = 4  # solves on finer meshes: at the mean of the prior, at the mode, and at the corrected one
FINER = "finer mesh"  # in names of models
NOT_ASKED = "not requested: no result will be called trusted"


def times_of(spec: ModelSpec) -> Times:
    """Return the predicted times of a model that has some."""
    found = spec.cost()
    assert found is not None
    return found


def estimates_paid(spec: ModelSpec, parameters: int, solves: int) -> float:
    """Predict how many estimates of the error of a mesh take a fifth of a study of so many solves."""
    cost, one = spec.cost(), spec.mesh_error_cost(NONE_TO_SPARE)
    if cost is None or one is None:
        return math.inf
    once = START + REPORT + cost.first + cost.reference_factor(parameters)
    return float((SHARE * (once + solves * cost.sample) - one.once) / (cost.sample + one.seconds))


def of_file(spec: ModelSpec) -> bool:
    """Whether the mesh of a model, if it has one, is that of a file."""
    return any(not one.body.structured for one in spec.bodies)


def never_estimable(spec: ModelSpec, names: Collection[str] | None = None) -> tuple[str, ...]:
    """Return those outputs of a body, of some by their names, of which no error of a mesh can be estimated."""
    outputs = spec.returned if spec.bodies else ()
    some = outputs if names is None else [one for one in outputs if one.name in names]
    return tuple(one.name for one in some if not getattr(one, "estimable", True))


def meshes_of(spec: ModelSpec) -> tuple[Any, ...]:
    """Return the bodies of a model on the finer meshes that they are looked at on, where these are known before a run.

    A ValueError says that there are none, or that they would be too large.
    """
    both = ((finer(one), graded(one)) for one in spec.bodies if one.body.structured)
    return tuple(mesh for pair in both for mesh in pair if mesh is not None)


def mesh_check(spec: ModelSpec) -> tuple[float, str]:
    """Predict the processor time (s) of solves on finer meshes, and say what is solved."""
    try:
        fine = meshes_of(spec)
    except ValueError as error:
        return 0.0, f"not possible: {error}; no result will be called trusted"
    unknowns, once = max((one.unknowns for one in fine), default=0), sum(times_of(one).textbook for one in fine)
    for one in spec.bodies:
        if not one.body.structured:  # divided in a run; a factor grows faster than the mesh
            unknowns, once = max(unknowns, 8 * one.unknowns), once + 8**2 * times_of(one).textbook
    longest = duration(HOPELESS * once)
    each = f"each about {duration(once)}; up to {longest} if it has no answer"
    return LOOKS * once, f"about {LOOKS} solves of {unknowns:,} displacements on finer meshes, {each}"


def duration(seconds: float) -> str:
    """Write a time for a prediction."""
    if seconds < 9.5:
        return f"{seconds:.2g} s"
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
