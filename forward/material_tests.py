"""Homogeneous tests of a material as a model of a study: its outputs are stresses, its numbers constants."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from typing import Any, ClassVar, Literal

from pydantic import Field

from forward.bodies.geometry import Vector
from forward.materials.admissible import Materials
from forward.materials.material import MATERIALS, constants, incompressible, of_volume
from forward.materials.material_point import HomogeneousModel, MaterialTest, stresses_of, unfit
from forward.registry import KindError
from forward.scalars import Mistake, Ranges, Scalar
from forward.settings import nearest, shown
from forward.solid import block
from forward.spec import ModelSpec, PlainOutput

Constants = dict[str, float | str | tuple[Vector, ...]]  # of a material: its kind, constants and fibres by name


class MaterialTests(ModelSpec):
    """Stresses of homogeneous tests of a material; without constants of the volume (D1), an energy is incompressible.

    Parameters
    ----------
    material
        Its kind, its constants, and fibres where it has them, by their components along the first stretch, along the
        second one and across both.
    tests
        What is prescribed, and which stress is measured.
    """

    material: Constants
    kind: Literal["material-tests"] = "material-tests"
    tests: tuple[MaterialTest, ...] = Field(min_length=1)

    @property
    def energy(self) -> str:
        """Kind of the material."""
        return str(self.material["kind"])

    @property
    def fixed(self) -> dict[str, float]:
        """Constants by name."""
        return {name: value for name, value in self.material.items() if isinstance(value, float)}

    @property
    def paths(self) -> dict[str, str]:
        """Paths of the constants by their names, as in the model of a body."""
        return {name: f"material.{name}" for name in self.fixed}

    @property
    def varied(self) -> tuple[str, ...]:
        """Constants that are parameters without a value: only a candidate has some."""
        return ()

    @property
    def fibres(self) -> tuple[Vector, ...]:
        """Directions of the families of fibres."""
        found = self.material.get("fibres", ())
        return found if isinstance(found, tuple) else ()

    @property
    def outputs(self) -> tuple[PlainOutput, ...]:
        """The stresses of all tests, one after the other."""
        return tuple(PlainOutput(name, "Pa") for name in stresses_of(self.tests))

    @property
    def axes_of_outputs(self) -> dict[str, tuple[str, list[Any]]]:
        """Of a single test at several places, which is a curve: its name, and where each stress is."""
        if len(self.tests) > 1 or len(self.tests[0].at) == 1:
            return {}
        (test,) = self.tests
        over = "shear" if test.mode == "simple-shear" else "stretch"
        steps = list(range(1, len(test.at) + 1))
        return {"output_of": ("", [test.label] * len(steps)), "step": ("1", steps), over: ("1", list(test.at))}

    @property
    def scalars(self) -> dict[str, Scalar]:
        made, values = block(self.energy), self.fixed
        return {path: Scalar(values.get(name, math.nan), made, name) for name, path in self.paths.items()}

    def materials(self, parameters: Collection[str] = ()) -> Materials:
        varied = {name: path for name, path in self.paths.items() if path in parameters}
        return Materials(self.energy, {"material": {**self.fixed, **varied}})

    @property
    def description(self) -> str:
        return f"{self.energy}, in {', '.join(test.label for test in self.tests)}"

    def described(self, ranges: Ranges) -> Iterator[tuple[str, str]]:
        yield "material", self.description

    def build(self, comm: Any, parameters: tuple[str, ...]) -> HomogeneousModel:
        """Make the model; constants that are no parameters keep their values."""
        return HomogeneousModel(self.energy, self.fixed, self.tests, parameters, self.fibres)

    def _mistakes(self) -> Iterator[Mistake]:
        wrong = self._of_material()
        if wrong is not None:
            yield (), wrong, self.material
            return
        labels = [test.label for test in self.tests]
        for i, test in enumerate(self.tests):
            if labels.index(test.label) < i:
                yield ("tests", i, "name"), "the name of a test before, expected another one", test.label
        said = next(filter(None, (unfit(self.energy, test.mode, self.fibres) for test in self.tests)), None)
        if said is not None:
            yield ("material",), said, self.material
        for _, said in () if self.varied else self.materials().objections({}):
            yield ("material",), said, dict(self.fixed)

    def _of_material(self) -> str | None:
        """Say what is wrong with the kind or the constants, or None if nothing is."""
        kind = self.material.get("kind")
        if kind is None:
            return "material.kind: missing"
        try:
            MATERIALS[str(kind)]
        except KindError as error:
            return f"material.kind: {shown(kind)}; {str(error).removeprefix('unknown kind; ')}"
        words = [name for name in self.material if name not in {"kind", "fibres", *self.fixed}]
        if words:
            return f"material.{words[0]}: {shown(self.material[words[0]])}, expected a number"
        known = constants(self.energy)
        given = dict.fromkeys([*self.fixed, *self.varied])
        for name in given:
            if name not in known:
                return f"'{name}' is no constant of '{kind}'; {nearest(name, tuple(known))}"
            if name in self.fixed and name in self.varied:
                return f"'{name}' is given in material and in parameters, expected one of them"
        left_out = of_volume(self.energy) if incompressible(self.energy, given) else ()
        missing = ", ".join(name for name in known if name not in given and name not in left_out)
        return f"missing: {missing}, expected in material{' or parameters' if self.varied else ''}" if missing else None


class CandidateTests(MaterialTests):
    """The same of a candidate, whose parameters are constants that have no value besides; ranks may all work on it.

    Parameters
    ----------
    parameters
        Their names.
    """

    shareable: ClassVar[bool] = True

    parameters: tuple[str, ...]

    @property
    def description(self) -> str:
        """The model in words: tests are those of the data."""
        return self.energy

    @property
    def paths(self) -> dict[str, str]:
        return {name: name for name in self.parameters}

    @property
    def varied(self) -> tuple[str, ...]:
        return self.parameters
