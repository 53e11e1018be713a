"""What a body consists of, whatever acts on it: geometry and mesh, materials, inclusions, random fields, unknowns."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from functools import cache
from typing import Annotated, Any, Literal, Self, get_args, get_origin

import numpy as np
from annotated_types import Ge, Gt, Le, Unit
from pydantic import Field, create_model, field_validator

from forward.bodies.geometry import AXES, Body, Direction, Vector, extent, outside
from forward.bodies.inclusions import Inclusion
from forward.bodies.random_fields import RandomField
from forward.fem.locking import Decision, Formulation, decide, of_locking
from forward.findings import Finding
from forward.materials.admissible import Materials, moduli
from forward.materials.material import MATERIALS, Energy, constants, energy_of, measures, splits
from forward.registry import OfKind
from forward.scalars import Mistake, Ranges, Scalar
from forward.settings import Settings, nearest
from forward.solvers.settings import SolverSettings
from forward.spec import ModelSpec

CONTRAST = "contrast"  # of a region: factor (1) on the stiffness that follows from its constants


class _Fibrous(Settings):
    """A material with one or two families of fibres, along vectors in the undeformed body."""

    fibres: tuple[Direction, ...] = Field(min_length=1, max_length=2)


def block(kind: str) -> type[Settings]:
    """Return the block of a kind of material."""
    return _block(kind, energy_of(kind))


@cache
def _block(kind: str, energy: Energy) -> type[Settings]:
    name = kind.rpartition(".")[2].replace("-", "_").title().replace("_", "")
    fields: dict[str, Any] = {"kind": (Literal[kind], kind)}
    fields |= {
        constant: (Annotated[(float, *(get_args(hint)[1:] if get_origin(hint) is Annotated else (Unit("1"),)))], ...)
        for constant, hint in constants(energy).items()
    }
    base: type[Settings] = _Fibrous if "i4" in measures(energy) else Settings
    made: type[Settings] = create_model(name, __base__=base, __doc__=energy.__doc__, **fields)
    return made


Material = Annotated[Settings, OfKind(MATERIALS, make=block)]


class Solid(ModelSpec):
    """A body of a hyperelastic material: the part of a specification that knows neither supports nor loads.

    What its fields mean is said in `forward.hyperelastic.Hyperelastic`, from which the reference of settings is made.
    """

    formulation: Formulation = "auto"
    body: Body
    material: Material
    regions: dict[str, dict[str, float]] = Field(default={})
    inclusions: tuple[Inclusion, ...] = ()
    fields: tuple[RandomField, ...] = ()
    strains: Literal["finite", "small"] = "finite"
    solver: SolverSettings = SolverSettings()

    @field_validator("solver", mode="before", json_schema_input_type=SolverSettings | str)
    @classmethod
    def _kind_alone(cls, given: Any) -> Any:
        return {"kind": given} if isinstance(given, str) else given

    @property
    def numbers(self) -> dict[str, Any]:
        """What the block of the material holds, whose names depend on its kind."""
        return dict(self.material)

    @property
    def own_scalars(self) -> dict[str, Scalar]:
        """Numbers of the material, of regions and of inclusions that can be made parameters, by their paths."""
        found = {}
        for name in constants(self.energy):
            found[f"material.{name}"] = Scalar(self.numbers[name], type(self.material), name)
        for region, numbers in self.regions.items():
            for name, value in numbers.items():
                path = f"regions.{region}.{name}"
                if name == CONTRAST:
                    found[path] = Scalar(value, besides=(Gt(0),))
                elif name in type(self.material).model_fields:
                    found[path] = Scalar(value, type(self.material), name)
        for inclusion in self.inclusions:
            for name, value in inclusion:
                if name not in {"kind", "name"}:
                    within: tuple[Any, ...] = ()
                    if name in AXES:  # the centre stays in the body
                        low, high = self.body.bounds[AXES.index(name)]
                        within = Ge(low), Le(high)
                    found[f"inclusions.{inclusion.label}.{name}"] = Scalar(value, type(inclusion), name, within)
        return found

    @property
    def bodies(self) -> tuple[Solid, ...]:
        return (self,)

    @property
    def energy(self) -> str:
        """Kind of the material."""
        return str(self.numbers["kind"])

    @property
    def fibres(self) -> tuple[Vector, ...]:
        """Unit vectors along the families of fibres in the undeformed body."""
        given = self.numbers.get("fibres", ())
        return tuple((x / length, y / length, z / length) for x, y, z in given for length in [math.hypot(x, y, z)])

    def materials(self, parameters: Collection[str] = ()) -> Materials:
        def own(place: str, values: Mapping[str, float]) -> dict[str, float | str]:
            paths = {name: f"{place}.{name}" for name in values}
            return {name: paths[name] if paths[name] in parameters else value for name, value in values.items()}

        names = constants(self.energy)
        shared = own("material", {name: self.numbers[name] for name in names})
        found = {"material": shared}
        for region, numbers in self.regions.items():
            place = f"regions.{region}"
            found[place] = shared | own(place, {name: value for name, value in numbers.items() if name in names})
        return Materials(self.energy, found)

    @property
    def contact_modulus(self) -> float:
        """E/(1 − ν²) (Pa) of the stiffest material of the body, with the constants as they are stated."""
        largest = 0.0
        for place, values in self.materials().constants.items():
            shear, bulk = moduli(self.energy, values)
            contrast = self.regions.get(place.removeprefix("regions."), {}).get(CONTRAST, 1.0)
            share = 1.0 if np.isinf(bulk) else (3 * bulk + shear) / (3 * bulk + 4 * shear)
            largest = max(largest, float(contrast * 4 * shear * share))
        return largest

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Paths of the coefficients of the random fields, which can be parameters too."""
        return tuple(path for field in self.fields for path in field.paths(self.body))

    @property
    def unknowns(self) -> int:
        """Number of unknowns: displacements and, in the mixed form, pressures."""
        return 3 * self.body.nodes + (self.body.vertex_count if self.mixed else 0)

    @property
    def mixed(self) -> bool:
        """Whether pressures are unknowns too."""
        return self.decision({}).mixed

    def decision(self, ranges: Ranges) -> Decision:
        """Return the formulation for values of parameters within ranges, by their paths, and why it is chosen."""
        return decide(self.formulation, self.body.degree, self.materials(ranges), ranges)

    def over(self, ranges: Ranges) -> Self:
        return self.model_copy(update={"formulation": "mixed" if self.decision(ranges).mixed else "displacement"})

    def linearised(self) -> Self:
        """Return the same body with small strains, whose stiffness is that at rest and never unstable."""
        solver = self.solver.model_copy(update={"accept_unstable": True})
        return self.model_copy(update={"strains": "small", "solver": solver})

    def locking(self, ranges: Ranges) -> Iterator[Finding]:
        """Find where displacements alone are too stiff for values of parameters within ranges."""
        yield from of_locking(self.decision(ranges), self.body.cell, self.body.degree, self.materials(ranges))

    def mistakes_of_samples(self) -> Iterator[Mistake]:
        """Find random fields whose coefficients cannot be drawn."""
        for i, field in enumerate(self.fields):
            if field.basis == "nodes":
                message = "values at the vertices are not independent, expected 'modes' or 'noise'"
                yield ("model", "fields", i, "basis"), message, field.basis

    def own_mistakes(self) -> Iterator[Mistake]:
        """Find what no single block can see: inclusions outside, unknown regions, no material, a form that is not."""
        for i, inclusion in enumerate(self.inclusions):
            centre = (inclusion.x, inclusion.y, inclusion.z)
            if outside(self.body, centre):
                message = f"its centre lies outside the body, which lies in {extent(self.body)}"
                yield ("inclusions", i), message, list(centre)
        of_regions = list(self._mistakes_of_regions())
        yield from of_regions
        if not of_regions:
            for where, objection in self.materials().objections({}):
                yield tuple(where.split(".", 1)), objection, {}
        for i, field in enumerate(self.fields):
            if field.modes is not None and field.modes > self.body.vertex_count:
                message = f"more modes than the mesh has vertices, expected at most {self.body.vertex_count}"
                yield ("fields", i, "modes"), message, field.modes
        if self.formulation == "mixed" and not splits(self.energy):
            split = ", ".join(name for name in MATERIALS if splits(name))
            message = f"the energy '{self.energy}' has no part of the volume alone; a mixed form has: {split}"
            yield ("formulation",), message, self.formulation
        if self.formulation == "mixed" and self.body.degree < 2:
            message = "a mixed form on cells of degree 1 is not stable, expected body.degree = 2"
            yield ("formulation",), message, self.formulation

    def _mistakes_of_regions(self) -> Iterator[Mistake]:
        known = (*(name for name in type(self.material).model_fields if name != "kind"), CONTRAST)
        for region, numbers in self.regions.items():
            if region not in self.body.regions:
                hint = nearest(region, self.body.regions) if self.body.regions else "this body has none"
                yield ("regions", region), f"unknown region; {hint}", numbers
            for name, value in numbers.items():
                if name not in known:
                    yield ("regions", region, name), f"not a constant of '{self.energy}'; {nearest(name, known)}", value
                    continue
                objection = self.own_scalars[f"regions.{region}.{name}"].objection(value)
                if objection is not None:
                    yield ("regions", region, name), objection, value
