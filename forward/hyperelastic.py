"""The specifications of a hyperelastic body under loads, which may change step by step; no FEniCSx until built."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Literal

from annotated_types import Gt
from pydantic import Field, GetJsonSchemaHandler, model_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from forward.bodies.random_fields import RandomField
from forward.fem.cost import Times, sum_of
from forward.fem.mesh_error_cost import Estimate
from forward.findings import Finding
from forward.loaded import LoadedBody
from forward.materials.material import constants, energy_of
from forward.model import FloatArray, ModelError
from forward.observables.observable import Output
from forward.readable import listed, number, scale, settings, with_unit
from forward.readable import named as name_with_unit
from forward.registry import named
from forward.scalars import Mistake, Scalar
from forward.settings import nearest, shown
from forward.spec import UNREFINED
from forward.terms.displacement import Block, label, lists, too_far

LEAST = 2  # steps of a path
LISTED = 6  # steps that are named
BLOCKS: tuple[Block, ...] = ("loads", "displacements")  # whose numbers may have steps


class Hyperelastic(LoadedBody):
    """A hyperelastic body under loads, solved by finite elements.

    Parameters
    ----------
    body
        Geometry and mesh.
    material
        Strain energy and its constants.
    regions
        Numbers of named regions of the mesh: constants of the material, which replace those of `material`,
        and `contrast`, by which the energy density is multiplied: ``{ tumour = { contrast = 9 } }``.
    inclusions
        Balls that are stiffer or softer: their factors multiply the energy density.
    fields
        Random fields that multiply the stiffness or the density.
    strains
        "small": the linear model, with the moduli that the material has at rest. Loads act on the undeformed body,
        tools on the deformed one; stress, energy and change of volume are those of small strains, other outputs are
        functions of the displacements as ever. Fibres carry only tension and add nothing. No stability is tested.
    solver
        Path, tolerance and limits of the solver; a word stands for its kind, `solver = "newton"`.
    formulation
        Unknowns: "displacement", or "mixed" with pressures, which nearly incompressible bodies need (quadratic cells,
        and a material with a constant D1 or a stated volumetric part). "auto" is mixed where that is possible and κ/μ
        may be above 3: for some values of the inputs in a study, otherwise for the constants as given.
    clamp
        Boundaries that do not move.
    displacements
        Boundaries with components that are moved by a given amount. Where boundaries share an edge, clamps take
        precedence, then later entries over earlier ones.
    loads
        Gravity, tractions and pressures.
    outputs
        What is computed from the deformed body.
    adapt
        Whether the mesh is refined first, and until when; tetrahedra only, in studies that sample.
    stresses
        Whether results hold stresses and strains too, at the mean of the inputs.
    """

    kind: Literal["hyperelastic"] = "hyperelastic"

    def adapted(self, comm: Any, parameters: tuple[str, ...], point: FloatArray, say: Callable[[str], None]) -> Any:
        return named("forward.fem.adapt:adapt")(self, comm, parameters, point, say)

    def words(self, said: Callable[[str], str], where: str = "") -> Iterator[tuple[str, list[str]]]:
        def numbers(place: str, names: Iterable[str]) -> str:
            return ", ".join(f"{name} = {said(f'{place}.{name}')}" for name in names)

        body = self.body
        yield "body", [f"{body.description}; {body.cells_in_words} cells ({body.cell}, degree {body.degree}){where}"]
        pressures = " and pressures (mixed form)" if self.mixed else ""
        yield "unknowns", [f"{self.unknowns:,} displacements{pressures}{where}"]
        fibres = [f"fibres along {' and '.join(map(listed, self.fibres))}"] if self.fibres else []
        law = str(energy_of(self.energy).__doc__).partition("\n")[0]
        small = ["small strains: its moduli at rest"] if self.strains == "small" else []
        yield "material", [law, numbers("material", constants(self.energy)), *fibres, *small]
        if self.regions:
            yield "regions", [f"{one}: {numbers(f'regions.{one}', names)}" for one, names in self.regions.items()]
        inclusions = []
        for one in self.inclusions:
            own = [name for name in type(one).model_fields if name not in {"kind", "name"}]
            label = f"{one.name} ({one.kind})" if one.name else one.kind
            inclusions.append(f"{label}: {numbers(f'inclusions.{one.label}', own)}")
        if inclusions:
            yield "inclusions", inclusions
        if self.fields:
            yield "random fields", [_field(field) for field in self.fields]
        held = [f"{boundary} clamped" for boundary in self.clamp] + [
            f"{item.on}: u{axis} = {said(f'displacements.{item.label}.{axis}')}"
            for item in self.displacements
            for axis in item.components
        ]
        yield "held", held
        loads = [load.words({name: said(f"loads.{load.label}.{name}") for name in load.scalars}) for load in self.loads]
        yield "loads", loads or ["none"]
        outputs = []
        for output in self.outputs:
            block = output.model_dump()
            words = ", ".join(filter(None, [block["kind"], settings(block, "kind", "name")]))
            outputs.append(name_with_unit(f"{output.name}: {words}", output.unit))
        yield "outputs", outputs

    def build(self, comm: Any, parameters: tuple[str, ...]) -> Any:
        """Mesh the body and compile the forms; collective. Coefficients of fields that are no parameters are zero.

        Raises
        ------
        ModelError
            If its mesh is to be refined first.
        """
        if self.unrefined:
            raise ModelError(f"model.adapt: {UNREFINED}")
        alone = "joined:path" if self.stepped else "model:HyperelasticModel"
        model = "history:HistoryModel" if self.path_dependent else alone
        return named(f"forward.fem.{model}")(self, comm, parameters)


class Path(Hyperelastic):
    """A hyperelastic body in several steps, each solved from the one before: every output is a curve over the path.

    Numbers of loads and prescribed displacements may be lists, with a value for each step
    (``depth = [0.5e-3, 1e-3, 2e-3]``); the other numbers are the same in all steps and can be parameters. The material
    has no memory, so that steps only say where the curve is known.

    Parameters
    ----------
    steps
        The lists by the paths of the numbers; lists in the loads and displacements themselves are added to it.
    """

    kind: Literal["path"] = "path"  # type: ignore[assignment]
    steps: dict[str, tuple[float, ...]] = Field(default={})

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Loads and displacements whose numbers are lists are tables too."""
        found = handler.resolve_ref_schema(handler(core))
        lists_too = {"type": "object", "description": "as in kind = 'hyperelastic'; a number may be a list"}
        for block in BLOCKS:
            items = found["properties"][block]["items"]
            found["properties"][block]["items"] = {"anyOf": [items, lists_too]}
        return found

    @model_validator(mode="before")
    @classmethod
    def _lists(cls, given: Any) -> Any:
        """Collect the lists in loads and displacements, which keep their last values."""
        if not isinstance(given, Mapping):
            return given
        stated = given.get("steps", {})
        found: dict[str, Any] = dict(stated) if isinstance(stated, Mapping) else {}
        changed: dict[str, Any] = {}
        for block in BLOCKS:
            items = given.get(block, ())
            if not isinstance(items, list | tuple):
                continue
            changed[block] = ()
            for item in items:
                of_item = lists(block, item)
                found |= {f"{block}.{label(block, item)}.{name}": values for name, values in of_item.items()}
                last = {name: values[-1] for name, values in of_item.items()}
                changed[block] += ({**item, **last} if last else item,)
        return {**given, **changed, "steps": stated if found == stated else found}

    @property
    def stepped(self) -> Mapping[str, tuple[float, ...]]:
        return self.steps

    @property
    def count(self) -> int:
        """Number of steps."""
        return len(next(iter(self.steps.values())))

    @property
    def leading(self) -> str:
        """Path of the number over which curves are drawn: the first that has steps."""
        return next(iter(self.steps))

    @property
    def whole(self) -> Hyperelastic:
        names = Hyperelastic.model_fields.keys() - {"kind"}
        return Hyperelastic(**{name: value for name, value in self if name in names})

    @property
    def scalars(self) -> dict[str, Scalar]:
        """Every number that can be made a parameter, by its path: not those that have steps."""
        return {path: number for path, number in super().scalars.items() if path not in self.steps}

    @property
    def every_scalar(self) -> dict[str, Scalar]:
        """Every number, and of what has steps a factor on all of them, `steps.PATH`, unless the body remembers."""
        factors = () if self.path_dependent else self.steps
        return {**super().every_scalar, **{f"steps.{path}": Scalar(1.0, besides=(Gt(0),)) for path in factors}}

    @property
    def unavailable(self) -> Mapping[str, str]:
        """Why some of its numbers cannot be parameters, by their paths: they have steps."""
        why = "has a value for each step, and what has steps cannot be random; expected one value, or another parameter"
        return dict(super().unavailable) | dict.fromkeys(self.steps, why)

    @property
    def returned(self) -> tuple[Output, ...]:
        """All outputs at the first step, then at the second, and so on: each with the number of the step, from 1."""
        return tuple(one.model_copy(update={"name": f"{one.name}.{step}"}) for one, step in self._at_steps)

    @property
    def _at_steps(self) -> list[tuple[Output, int]]:
        return [(output, step) for step in range(1, self.count + 1) for output in self.outputs]

    @property
    def labels(self) -> tuple[str, ...]:
        where = [", ".join(f"{p} = {v[k]:g}" for p, v in self.steps.items()) for k in range(self.count)]
        return tuple(f"step {k} of {self.count} ({numbers})" for k, numbers in enumerate(where, 1))

    @property
    def axes_of_outputs(self) -> dict[str, tuple[str, list[Any]]]:
        """Which output and which step each of these is, and the numbers that have steps there."""
        found: dict[str, tuple[str, list[Any]]] = {
            "output_of": ("", [output.name for output, _ in self._at_steps]),
            "step": ("1", [step for _, step in self._at_steps]),
        }
        for path, values in self.steps.items():
            found[path] = self.unit_of(path), [values[step - 1] for _, step in self._at_steps]
        return found

    @property
    def findings(self) -> tuple[Finding, ...]:
        ends = {path: (min(values), max(values)) for path, values in self.steps.items()}
        return tuple(dict.fromkeys((*super().findings, *too_far(self.body, ends))))

    def cost(self, factors: int = 1) -> Times:
        """Predict the cost of a solve of all steps, each from the one before and with a factor of its own."""
        found = super().cost(factors)
        return found if self.path_dependent else sum_of([found] * self.count)

    def mesh_error_cost(self, spare: float = math.inf) -> Estimate:
        return sum_of([super().mesh_error_cost(spare)] * self.count)

    def described(self, ranges: Any) -> Iterator[tuple[str, str]]:
        """Say what the body is, and which steps there are."""
        yield from super().described(ranges)
        for path in self.steps:
            yield "steps", f"{path} = {self.in_words(path)}"

    def unit_of(self, path: str) -> str:
        """SI unit of a number that has steps."""
        return super().scalars[path].unit

    def in_words(self, path: str) -> str:
        """The values of a number that has steps."""
        values = self.steps[path]
        one, unit = scale(max(map(abs, values)), self.unit_of(path))
        said = [number(value / one) for value in values]
        listed = ", ".join(said) if len(said) <= LISTED else f"from {said[0]} to {said[-1]}"
        return f"{with_unit(listed, unit)} in {len(said)} steps"

    def words(self, said: Callable[[str], str], where: str = "") -> Iterator[tuple[str, list[str]]]:
        return super().words(lambda path: self.in_words(path) if path in self.steps else said(path), where)

    def _mistakes(self) -> Iterator[Mistake]:
        yield from super()._mistakes()
        if not self.steps:
            yield ("steps",), "no number has steps, expected a list for a number of a load or of a displacement", {}
            return
        known = {path: one for path, one in super().scalars.items() if path.partition(".")[0] in BLOCKS}
        for path, values in self.steps.items():
            if path not in known:
                yield ("steps", path), f"no number of a load or displacement; {nearest(path, tuple(known))}", path
                continue
            if len(values) < LEAST:
                yield ("steps", path), f"{len(values)} values, expected at least {LEAST}", list(values)
            for i, value in enumerate(values):
                objection = known[path].objection(value) if math.isfinite(value) else "input should be a finite number"
                if objection is not None:
                    yield ("steps", path, i), objection, value
            again = next((i for i, (a, b) in enumerate(itertools.pairwise(values), 1) if a == b), None)
            if again is not None and len(self.steps) == 1:
                yield ("steps", path, again), "the same as the step before, expected another value", values[again]
        lengths = {path: len(values) for path, values in self.steps.items()}
        if len(set(lengths.values())) > 1:
            told = ", ".join(f"{path} {n}" for path, n in lengths.items())
            message = f"lists of different lengths ({told}), expected a value of each for every step"
            yield ("steps",), message, shown(lengths)
        if self.adapt is not None:
            message = "a mesh is refined for one state, expected no steps (or the mesh that such a study leaves)"
            yield ("adapt",), message, True


def _field(field: RandomField) -> str:
    made_of = {
        "modes": f"{field.modes} Karhunen–Loève modes",
        "noise": "white noise",
        "nodes": "values at the vertices",
    }
    return (
        f"{field.label}: log-normal factor on the {field.of} with mean {field.mean:g} and standard deviation "
        f"{field.std:g}, Matérn correlation of length {field.length:g} m (ν = {field.smoothness - 1.5:g}), "
        f"from {made_of[field.basis]}"
    )
