"""The specification of a specimen: one body in several load cases, with observed displacements and other outputs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, Literal

from pydantic import Field, ValidationError, model_validator

from forward.bodies.geometry import AXES, Vector, holds
from forward.fem.cost import Times, sum_of
from forward.fem.mesh_error_cost import Estimate, own_estimate
from forward.findings import Finding
from forward.hyperelastic import Hyperelastic
from forward.model import ModelError
from forward.observables.integrals import PointDisplacement
from forward.observables.observable import Output
from forward.registry import named
from forward.scalars import Mistake, Ranges, Scalar, repeated
from forward.settings import Settings, nearest
from forward.solid import Solid
from forward.terms.displacement import Displacement
from forward.terms.term import Load

# Blocks that are the same in all cases.
SHARED = ("body", "material", "regions", "inclusions", "fields", "strains", "solver")
ACTING = ("loads.", "displacements.")  # paths of numbers of what acts in a load case


class LoadCase(Settings):
    """What acts on a specimen at one time.

    Parameters
    ----------
    name
        Used in names of observations.
    clamp, displacements, loads
        As in `Hyperelastic`.
    outputs
        What is measured beside displacements, such as the force of a tool: by its name in tables of data.
    """

    name: str = Field(pattern=r"^[^.\s]+$")
    clamp: tuple[str, ...] = ()
    displacements: tuple[Displacement, ...] = ()
    loads: tuple[Load, ...] = ()
    outputs: tuple[Output, ...] = ()


def shared_paths(cases: Sequence[LoadCase]) -> dict[str, dict[str, float]]:
    """Return the paths of numbers that differ between load cases where an item has no name, with values by case.

    Items of one name share their parameters, as is meant where the name is stated. Without names that is by accident:
    two tractions are both called `traction`, and two displacements of a boundary have the name of it.
    """
    found: dict[str, dict[str, float]] = {}
    unnamed: set[str] = set()
    for case in cases:
        for block, items in (("loads", case.loads), ("displacements", case.displacements)):
            for item in items:
                numbers = {f"{block}.{item.label}.{name}": scalar.value for name, scalar in item.scalars.items()}
                unnamed |= set() if item.name else numbers.keys()
                for path, value in numbers.items():
                    found.setdefault(path, {})[case.name] = value
    return {path: values for path, values in found.items() if path in unnamed and len(set(values.values())) > 1}


def in_words(path: str, values: Mapping[str, float]) -> str:
    """Say why such a number can be no parameter, with its values by load case."""
    listed = ", ".join(f"{value:g} in {case}" for case, value in values.items())
    return (
        f"'{path}' is {listed}, without a name: as a parameter it would have one value everywhere; expected a name for "
        "each, or the same name for all if they are one parameter"
    )


class Observed(Settings):
    """Measured displacements (m).

    Parameters
    ----------
    name
        Used in names of observations; by default the boundary, or "points".
    on
        Boundary; they are measured at all of its nodes.
    at
        Points of the undeformed body (m), as an alternative to `on`.
    components
        Those that are measured.
    cases
        Names of the load cases in which they are measured; by default all.
    """

    name: str = Field(default="", pattern=r"^[^.\s]*$")
    on: str | None = None
    at: tuple[Vector, ...] = ()
    components: Literal["x", "y", "z", "xy", "xz", "yz", "xyz"] = "xyz"
    cases: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """The name in names of observations."""
        return self.name or self.on or "points"

    @model_validator(mode="after")
    def _check(self) -> Observed:
        if (self.on is None) == (not self.at):
            raise ValueError("expected either a boundary ('on') or points ('at')")
        return self


class _Loaded(Hyperelastic):
    """The body in one load case; observed displacements are not outputs."""

    outputs: tuple[Output, ...] = ()

    def _mistakes(self) -> Iterator[Mistake]:
        yield from super()._mistakes()
        for i, load in enumerate(self.loads):
            if load.remembers and load.contact:
                message = "a specimen has no friction yet, expected friction = 0 (or a model of kind 'path')"
                yield ("loads", i, "friction"), message, getattr(load, "friction", None)
            elif load.remembers:
                yield ("loads", i), "a specimen remembers nothing yet, expected a model of kind 'path'", load.label


class Specimen(Solid):
    """A body that is tested in several load cases.

    Parameters
    ----------
    body, material, regions, inclusions, fields, strains, solver, formulation
        As in `Hyperelastic`; the same in all cases.
    cases
        Load cases.
    observed
        What is measured; not needed if the data say it.
    """

    shareable: ClassVar[bool] = True
    placed: ClassVar[bool] = True
    kind: Literal["specimen"] = "specimen"
    cases: tuple[LoadCase, ...] = Field(min_length=1)
    observed: tuple[Observed, ...] = ()

    def loaded(self, case: LoadCase) -> Hyperelastic:
        """Return the body in one load case."""
        shared = {name: value for name, value in self if name in SHARED}
        acting = {name: value for name, value in case if name in {"clamp", "displacements", "loads", "outputs"}}
        return _Loaded(formulation=self.formulation, **shared, **acting)

    def seen(self, case: LoadCase) -> tuple[Observed, ...]:
        """Return what is measured in one load case."""
        return tuple(item for item in self.observed if not item.cases or case.name in item.cases)

    @property
    def measurable(self) -> dict[str, dict[str, str]]:
        """Load cases by name, with the units of what is measured in them beside displacements, by name."""
        return {case.name: {output.name: output.unit for output in case.outputs} for case in self.cases}

    @property
    def observable(self) -> dict[str, tuple[str, ...]]:
        """Load cases by name, with the names of what can be observed in them: components of displacements, outputs."""
        return {name: (*AXES, *outputs) for name, outputs in self.measurable.items()}

    @property
    def scalars(self) -> dict[str, Scalar]:
        """Every number of every case that can be made a parameter, by its path; equal paths are one parameter."""
        return {path: number for case in self.cases for path, number in self.loaded(case).scalars.items()}

    def path_in(self, case: LoadCase, path: str) -> str:
        """Return the path of a number of one load case alone: of what acts there `cases.NAME.PATH`, else the same."""
        return f"cases.{case.name}.{path}" if path.startswith(ACTING) else path

    @property
    def every_scalar(self) -> dict[str, Scalar]:
        """Every number, those of what acts apart by load case."""
        numbers = ((case, path, number) for case in self.cases for path, number in self.loaded(case).scalars.items())
        return {self.path_in(case, path): number for case, path, number in numbers}

    @property
    def unavailable(self) -> Mapping[str, str]:
        """Why some of its numbers cannot be parameters, by their paths: unnamed items with other values share them."""
        return {path: in_words(path, values) for path, values in shared_paths(self.cases).items()}

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about the load cases before anything is solved, each once, and about paths of several numbers."""
        found = dict.fromkeys(finding for case in self.cases for finding in self.loaded(case).findings)
        paths = shared_paths(self.cases)
        return (*found, *([Finding("paths-shared", "note", {"paths": ", ".join(paths)})] if paths else ()))

    def mistakes_of_samples(self) -> Iterator[Mistake]:
        """Find that outputs are not known, and random fields whose coefficients cannot be drawn."""
        try:
            outputs = self.outputs
        except ModelError as error:
            yield ("model", "observed"), str(error), [item.on for item in self.observed]
        else:
            if not outputs:
                yield ("model", "observed"), "nothing is observed, expected points", ()
        yield from super().mistakes_of_samples()

    def findings_over(self, ranges: Ranges) -> tuple[Finding, ...]:
        return (*self.findings, *self.locking(ranges))

    @property
    def description(self) -> str:
        cases = ", ".join(case.name for case in self.cases)
        return f"{self.body.description}, {self.body.cells_in_words} cells, in the load cases {cases}"

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Displacements of the observed points and other outputs, case after case.

        Raises
        ------
        ModelError
            If nodes of a boundary are observed: only the mesh knows which these are.
        """
        for i, item in enumerate(self.observed):
            if item.on is not None:
                message = f"observed[{i}].on: its nodes are not known before there is a mesh, expected points ('at')"
                raise ModelError(message)
        found: list[Output] = []
        for number, name, axis, at in self.rows():
            if axis < len(AXES):
                found.append(PointDisplacement(name=name, at=at, component=AXES[axis]))
            else:
                found.append(self.cases[number].outputs[axis - len(AXES)].model_copy(update={"name": name}))
        return tuple(found)

    def rows(self, nodes: Callable[[str], Sequence[Vector]] = lambda _: ()) -> Iterator[tuple[int, str, int, Vector]]:
        """Yield the load case, by number, the name, the component and the place of all that is observed.

        Components 3 and more are the other outputs of the load case, in its order, which have no place: NaN.

        Parameters
        ----------
        nodes
            Returns the places (m) of the nodes of a boundary.
        """
        for number, case in enumerate(self.cases):
            for item in self.seen(case):
                for i, at in enumerate(item.at if item.on is None else nodes(item.on)):
                    for axis in item.components:
                        yield number, f"{case.name}.{item.label}.{i}.{axis}", AXES.index(axis), at
            for k, output in enumerate(case.outputs):
                yield number, f"{case.name}.{output.name}", len(AXES) + k, (math.nan,) * 3

    def cost(self) -> Times:
        """Predict the cost of a solve of all load cases, each with its own factor."""
        return sum_of([self.loaded(case).cost(factors=1) for case in self.cases])

    def mesh_error_cost(self, spare: float = math.inf) -> Estimate:
        return sum_of([own_estimate(self.loaded(case)) for case in self.cases])

    def described(self, ranges: Ranges) -> Iterator[tuple[str, str]]:
        """Say what a mesh file holds, which load cases there are, and which unknowns they have."""
        decision, names = self.decision(ranges), ", ".join(case.name for case in self.cases)
        yield from self.body.listed.items()
        yield "load cases", f"{names}, of {self.over(ranges).unknowns:,} unknowns each"
        yield "form", f"{'mixed' if decision.mixed else 'displacement'}: {decision.why}"

    def build(self, comm: Any, parameters: tuple[str, ...]) -> Any:
        return named("forward.fem.joined:specimen")(self, comm, parameters)

    def _mistakes(self) -> Iterator[Mistake]:
        names = tuple(case.name for case in self.cases)
        yield from repeated("cases", names)
        yield from repeated("observed", [item.label for item in self.observed])
        for i, case in enumerate(self.cases):
            try:
                self.loaded(case)
            except ValidationError as error:
                for line in error.errors(include_url=False):
                    common = line["loc"] and line["loc"][0] in SHARED
                    if i == 0 or not common:  # what is wrong with the body is wrong in every case
                        place = line["loc"] if common else ("cases", i, *line["loc"])
                        yield place, line["msg"], line["input"]
            for k, output in enumerate(case.outputs):
                if output.name in AXES:
                    message = "the name of a component of displacements, expected another one"
                    yield ("cases", i, "outputs", k, "name"), message, output.name
            if self.observed and not self.seen(case) and not case.outputs:
                yield ("cases", i), "nothing is measured in this load case", case.name
        for i, item in enumerate(self.observed):
            if item.on is not None and item.on not in self.body.boundaries:
                yield ("observed", i, "on"), f"unknown boundary; {nearest(item.on, self.body.boundaries)}", item.on
            for name in (name for name in item.cases if name not in names):
                yield ("observed", i, "cases"), f"unknown load case; {nearest(name, names)}", name
            for point in (point for point in item.at if not holds(self.body, point)):
                yield ("observed", i, "at"), "outside the body", list(point)
