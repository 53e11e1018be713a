"""Models against which the errors of cheaper ones are learnt, as studies that infer have them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from typing import Any

from pydantic import ValidationError

from forward.scalars import Mistake
from forward.spec import ModelSpec
from inverse.methods.model_error import LearntError
from workflows.config.priors import ranges
from workflows.studies.candidates import SPEC, changed

TRUTH = "other model"  # in names of models
UNSEEN = "the errors of the model are learnt against another one, whose mesh is taken as it is"


def truth_of(model: Mapping[str, Any] | ModelSpec, learnt: LearntError, parameters: Mapping[str, Any]) -> ModelSpec:
    """Return the other model, given that of the study, in the form that suits all values of its parameters.

    Raises
    ------
    pydantic.ValidationError
        If it is none.
    """
    own = model.model_dump(mode="json", exclude_none=True) if isinstance(model, ModelSpec) else model
    made = SPEC.validate_python(changed({"model": own}, {"model": learnt.against})["model"])
    return made.over(ranges({name: one for name, one in parameters.items() if name in made.scalars}))


def mistakes_of_truth(make: Callable[[], ModelSpec], own: Any, unknown: Collection[str]) -> Iterator[Mistake]:
    """Find what the other model lacks, or that it is the model itself; places begin with "against"."""
    place = ("against",)
    try:
        truth: Any = make()
    except ValidationError as error:
        for one in error.errors(include_url=False):
            yield (*place, *one["loc"]), one["msg"], one["input"]
        return
    if truth.placed != own.placed:
        yield place, f"expected a model of kind '{own.kind}', which is observed as this one is", truth.kind
        return
    if truth.identity() == own.identity():
        yield place, "is the model itself, expected another one", truth.kind
    has = {*truth.scalars, *truth.coefficients}
    lost = [name for name in unknown if name not in has]
    if lost:
        yield (*place, "parameters"), f"has no {', '.join(lost[:3])}, expected all unknown numbers", list(has)[:8]
    seen, needed = (_observable(one) for one in (truth, own))
    missing = [name for name in needed if name not in seen]
    if missing:
        yield (*place, "outputs"), f"has no {', '.join(missing[:3])}, expected all that the model has", list(seen)[:8]


def _observable(spec: Any) -> list[str]:
    """Return the names of what can be observed of a model, of a specimen by load case."""
    if spec.placed:
        return [f"{case}.{name}" for case, names in spec.observable.items() for name in names]
    return [output.name for output in spec.returned]
