"""What studies that infer take for granted: the model with the numbers that it holds, and what it is asked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import Field, model_validator

from forward.bodies.geometry import AXES
from forward.model import FloatArray, ForwardModel, ModelError, SolveError
from forward.scalars import Mistake, Scalar
from forward.settings import Settings, nearest
from inverse.criticism.assumptions import (
    PART,
    Ask,
    Assumption,
    Assumptions,
    Moved,
    by_evaluation,
    merged,
    of_data,
    of_outputs,
)
from inverse.data.measurements import STEP_OF, Measurements
from uq.findings import add
from workflows.data.measured import observing, onto

if TYPE_CHECKING:
    import xarray as xr

    from uq.evaluation.request import Evaluate
    from uq.inputs.random_parameters import Inputs

ASSUMED, SAMPLED = "taken for granted", "what is sampled"  # in names of models
KEPT = ("size", "unit", "part")  # of what is taken for granted, in results


def of_numbers(numbers: Mapping[str, Scalar], unknown: Sequence[str], extent: float) -> list[Assumption]:
    """Return what numbers of a model, by their paths, take for granted that are not unknown.

    Places may be otherwise by a part of the extent (m) of the body, directions by an angle, other numbers by a part of
    themselves.
    """
    found = []
    for path, one in numbers.items():
        whole, place = path.split(".", 2)[-1] if path.startswith("cases.") else path, one.field in AXES
        size, part = PART * one.value, PART
        if place and one.unit == "m" and not whole.startswith("displacements."):
            size, part = PART * extent, 0.0
        elif one.field.startswith("direction"):
            size, part = PART, 0.0
        if whole not in unknown:
            found.append(Assumption(path, size, one.unit, part))
    return found


class Uncertain(Settings):
    """How uncertain something is that is taken for granted: a number alone is its standard deviation.

    Parameters
    ----------
    relative
        Standard deviation over the stated value.
    std
        Standard deviation in the unit of the number; of scales of the data relative.
    group
        Those of one name err together: by as many of their deviations.
    """

    relative: Annotated[float, Field(gt=0)] | None = None
    std: Annotated[float, Field(gt=0)] | None = None
    group: str = ""

    @model_validator(mode="before")
    @classmethod
    def _of_number(cls, given: Any) -> Any:
        return {"std": given} if isinstance(given, int | float) else given

    @model_validator(mode="after")
    def _check(self) -> Uncertain:
        if (self.relative is None) == (self.std is None):
            raise ValueError("expected either relative or std")
        return self


def means(name: str, path: str) -> bool:
    """Whether what is stated by a name means an assumption: itself, a part of it, or the same in a load case."""
    return name == path or path.startswith(f"{name}.") or path.split(".", 2)[-1] == name


@dataclass(frozen=True, eq=False)
class TakenForGranted:
    """What is taken for granted of a model with some unknown numbers, and of the data sets of a study.

    What is stated to be uncertain may be otherwise by its standard deviation; `alone`, nothing else may be.
    """

    label: ClassVar[str] = ASSUMED

    spec: Any
    unknown: tuple[str, ...]
    found: Sequence[Measurements | None]
    stated: Mapping[str, Uncertain] = field(default_factory=dict)
    alone: bool = False

    @cached_property
    def _scalars(self) -> Mapping[str, Scalar]:
        found: Mapping[str, Scalar] = self.spec.every_scalar
        return found

    @cached_property
    def _extent(self) -> float:
        return max((high - low for one in self.spec.bodies for low, high in one.body.bounds), default=0.0)

    @cached_property
    def numbers(self) -> list[Assumption]:
        """Numbers of the model, but for those that are zero, and not stated to be uncertain."""
        found = of_numbers(self._scalars, self.unknown, self._extent)
        return [one for one in map(self._as_stated, filter(self._counts, found)) if one.size]

    @cached_property
    def beside(self) -> list[Assumption]:
        """Of the data."""
        return [self._as_stated(one) for one in of_data(self.found, self._units, self._extent) if self._counts(one)]

    def _counts(self, one: Assumption) -> bool:
        return not self.alone or any(means(name, one.name) for name in self.stated)

    def _as_stated(self, one: Assumption) -> Assumption:
        for name, how in self.stated.items():
            if means(name, one.name):
                if how.relative is not None:  # a place or a direction has no part of itself, which is refused
                    return one._replace(size=one.size / PART * how.relative, part=how.relative) if one.part else one
                assert how.std is not None
                return one._replace(size=how.std, part=how.std if one.name.startswith("data.scale.") else 0.0)
        return one

    @cached_property
    def groups(self) -> dict[str, FloatArray]:
        """What is uncertain independently, by its name: weights (k,) of all in it."""
        found: dict[str, FloatArray] = {}
        for name, how in self.stated.items():
            row = np.array([float(means(name, one.name)) for one in self.all])
            if row.any():
                label = how.group or name
                found[label] = found.get(label, 0.0) + row
        return found

    @cached_property
    def _units(self) -> dict[str, str]:
        if self.spec.placed:
            return {name: unit for units in self.spec.measurable.values() for name, unit in units.items()}
        return {output.name: output.unit for output in self.spec.returned}

    @property
    def all(self) -> list[Assumption]:
        """All of them, in this order."""
        return [*self.numbers, *self.beside]

    @property
    def shown(self) -> list[Assumption]:
        """What is told of: what is uncertain together is one."""
        return merged(self.all, self.groups)[0]

    def described(self, *, field: bool) -> str:
        """Say what is looked at, and how many solves that takes."""
        solves = 0 if not self.asked else 1 if field else 1 + len(self.unknown)
        by = f", by {solves} solve{'s' if solves > 1 else ''}" if solves else ""
        return f"{len(self.numbers)} numbers of the model and {len(self.beside)} of the data{by}: what they move"

    @property
    def values(self) -> FloatArray:
        """Values (k,) of the numbers as stated."""
        return np.array([self._scalars[one.name].value for one in self.numbers])

    def build(self, comm: Any) -> Any:
        """Make the model with all of these numbers among its parameters; collective."""
        return self.spec.build(comm, (*self.unknown, *(one.name for one in self.numbers)))

    @property
    def loadings(self) -> FloatArray:
        """How much larger (k, g) each number is if what is uncertain is larger by its deviation."""
        weights = np.array(list(self.groups.values())).reshape(len(self.groups), len(self.all))
        return np.asarray(weights[:, : len(self.numbers)].T * np.array([one.size for one in self.numbers])[:, None])

    def by_deviations(self, comm: Any) -> ForwardModel:
        """Make the model with what is uncertain among its parameters, each in its standard deviations; collective."""
        found: ForwardModel = self.build(comm)
        return self._by(found, tuple(self.groups), (*self.unknown, *self.groups)) if self.groups else found

    def _by(self, model: ForwardModel, groups: Sequence[str], names: tuple[str, ...]) -> ForwardModel:
        """Return a model with all of these numbers, of parameters of some names: the unknown, and groups."""
        from forward.combine import along_columns

        columns = {name: self.loadings[:, k] for k, name in enumerate(self.groups) if name in groups}
        return along_columns(model, names, columns, self.values)

    @property
    def sampled(self) -> tuple[str, ...]:
        """Names of what is uncertain of the model only, which can be sampled."""
        k = len(self.numbers)
        return tuple(name for name, row in self.groups.items() if row[:k].any() and not row[k:].any())

    def sampling(self, model: ForwardModel, inputs: Inputs) -> ForwardModel:
        """Return a model with all of these numbers, of parameters as `Inputs.beside` has them with those sampled."""
        return self._by(model, self.sampled, inputs.beside(self.sampled).names)

    @property
    def asked(self) -> bool:
        """Whether the model has to be asked of the data sets."""
        moved = any(one is not None and self._moved(one) is not None for one in self.found)
        return bool(self.numbers or self.groups) or moved

    @property
    def data(self) -> Measurements:
        """The first data set."""
        data = self.found[0]
        assert data is not None
        return data

    def model(self, comm: Any) -> ForwardModel:
        """Make what is asked of the first data set; collective."""
        found = self.observed(self.build(comm), self.data)
        assert found is not None
        return found

    def observed(self, model: Any, data: Measurements) -> ForwardModel | None:
        """Return what that model is asked of a data set; collective. None where nothing has to be asked."""
        moved = self._moved(data)
        if moved is not None:
            return moved.observed(model)
        return observing(model, data) if self.numbers or self.groups else None

    def of(self, data: Measurements, ask: Ask | None) -> Assumptions:
        """Return what is taken for granted of a data set."""
        known = data, self.numbers, self.beside, self.values, self._units
        return Assumptions(*known, ask, self._moved(data), self.groups)

    def _moved(self, data: Measurements) -> Moved | None:
        shifts = self.spec.placed and any(one.name.startswith("data.shift.") for one in self.beside)
        if not shifts or not data.placed.any():
            return None
        body = self.spec.bodies[0].body
        return Moved(data, self._extent, onto(body) if data.on_surface else body.nearest, data.on_surface)

    @property
    def of_data(self) -> list[str]:
        """Names of what is taken for granted of the data, whatever may be measured."""
        measured = dict.fromkeys(
            STEP_OF.sub("", name) if unit != "m" else "displacement" for name, unit in self._units.items()
        )
        scales = [*(["displacement"] if self.spec.placed else []), *measured]
        shifts = [f"data.shift.{axis}" for axis in AXES] if self.spec.placed else []
        return [*(f"data.scale.{name}" for name in scales), *shifts]

    def mistakes(self) -> Iterator[Mistake]:
        """Find what is stated to be uncertain and is not taken for granted; of data what may be measured counts."""
        known = [*(one.name for one in self.all), *self.of_data]
        zeros = [one.name for one in of_numbers(self._scalars, self.unknown, self._extent) if not one.size]
        for name, how in self.stated.items():
            if name in self.unknown:
                yield ("uncertain", name), "is a parameter too, expected one of both", name
            elif how.group in self.unknown:
                yield ("uncertain", name, "group"), "is the name of a parameter, expected another", how.group
            elif not any(means(name, path) for path in known):
                if how.relative is not None and any(means(name, path) for path in zeros):
                    yield ("uncertain", name), "a part of zero is zero, expected std", how.relative
                else:
                    yield ("uncertain", name), f"not a number that is taken for granted; {nearest(name, known)}", name
            elif how.relative is not None and not name.startswith("data.scale"):
                numbers = [one for one in self.numbers if means(name, one.name)]
                if not all(one.part for one in numbers):
                    yield ("uncertain", name), "a place or a direction, expected std", how.relative

    def of_heavy_tails(self, kind: str, *, field: bool) -> Iterator[Mistake]:
        """Find what is stated to be uncertain and cannot be sampled, as errors of that kind need."""
        paths = [*self.of_data, *(one.name for one in self.numbers if field)]
        beside, others = (" with a field", "") if field else ("", "only numbers of the model, or ")
        message = (
            f"cannot be sampled{beside}, as errors of kind '{kind}' need, expected {others}errors of kind 'normal'"
        )
        wrong = (name for name in self.stated if any(means(name, path) for path in paths))
        yield from ((("uncertain", name), message, name) for name in wrong)

    def with_changes(self, found: xr.Dataset, mean: FloatArray, evaluate: Evaluate) -> xr.Dataset:
        """Add how far outputs are larger at the mean (d,) if each number that is not random is; NaN without an answer.

        A ModelError says that the model has no derivatives.
        """
        if not evaluate.differentiable:
            raise ModelError("sensitivity.all: the model has no derivatives, expected one that has")
        outputs = list(evaluate.outputs)
        changes = np.full((len(self.numbers), len(outputs)), np.nan)
        with suppress(SolveError):
            _, slopes = by_evaluation(evaluate)(mean[None], self.values[None], None)
            changes = (slopes[0] * [one.size for one in self.numbers]).T
        kept: dict[str, Any] = {f"assumption_{key}": [getattr(one, key) for one in self.numbers] for key in KEPT}
        held: dict[str, Any] = {name: ("assumption", values) for name, values in kept.items()}
        held["assumption_change"] = (("assumption", "output"), changes)
        found = found.assign(held).assign_coords(assumption=[one.name for one in self.numbers], output=outputs)
        if "std" in found and found["std"].dims == ("output",):
            add(found, *of_outputs(self.numbers, outputs, changes, found["std"].to_numpy()))
        return found


def of_none(each: Sequence[TakenForGranted]) -> Iterator[Mistake]:
    """Find what is stated to be uncertain of models of which none takes that for granted."""
    first, *others = [{one[0]: one for one in taken.mistakes()} for taken in each]
    yield from (one for place, one in first.items() if all(place in other for other in others))
