"""What finite elements ask of the specification of a hyperelastic body under loads.

What the body consists of is in `forward.solid`, what holds it in `forward.terms.displacement`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, ValidationInfo, field_validator

from forward.adapt import Adapt
from forward.bodies.geometry import AXES, Axis, extent, holds, moved_points
from forward.bodies.inclusions import too_narrow
from forward.bodies.mesh import Contents
from forward.bodies.mesh_file import MeshFile
from forward.fem.cost import HELD, SINGLE_FROM, Linear, Times, factor, linear_solver, sum_of, times, together
from forward.fem.mesh_error_cost import Estimate, finer, own_estimate
from forward.findings import Finding
from forward.materials.material import splits
from forward.model import ModelError
from forward.observables.observable import Output
from forward.scalars import Mistake, Ranges, Scalar, repeated
from forward.settings import nearest, shown
from forward.solid import Solid
from forward.solvers.settings import SolverSettings
from forward.terms.displacement import Block, Displacement, Support, lists, too_far
from forward.terms.term import Load

INCREMENTS = 10  # of a load with friction
IN_WORDS = {  # what linear systems are solved with
    Linear.FACTOR: "factors of the stiffness",
    Linear.BOTH: "multigrid; a factor of the stiffness for the reference only",
    Linear.MULTIGRID: "multigrid, without a factor of the stiffness",
}


class LoadedBody(Solid):
    """A hyperelastic body under loads, as finite elements ask for it; its fields are those of `Hyperelastic`."""

    meshed: ClassVar[bool] = True
    iterative: ClassVar[bool] = True
    shareable: ClassVar[bool] = True
    kind: str
    clamp: tuple[str, ...] = ()
    displacements: tuple[Displacement, ...] = ()
    loads: tuple[Load, ...] = ()
    outputs: tuple[Output, ...] = Field(min_length=1)
    adapt: Adapt | None = None
    stresses: bool = False

    @field_validator("loads", "displacements", mode="before")
    @classmethod
    def _no_lists(cls, given: Any, of: ValidationInfo) -> Any:
        """Refuse lists in place of numbers."""
        block: Block = "loads" if of.field_name == "loads" else "displacements"
        for item in given if isinstance(given, tuple) else ():
            for name, values in lists(block, item).items():
                raise ValueError(f"{name} = {shown(values)}, expected a number; several steps need model.kind = 'path'")
        return given

    @property
    def scalars(self) -> dict[str, Scalar]:
        found = self.own_scalars
        for block, items in (("loads", self.loads), ("displacements", self.displacements)):
            for item in items:
                found |= {f"{block}.{item.label}.{name}": scalar for name, scalar in item.scalars.items()}
        return found

    @property
    def symmetric(self) -> bool:
        """Whether the stiffness is symmetric: no load follows the body, and no tool rubs on it."""
        return all(load.symmetric for load in self.loads)

    @property
    def linear(self) -> Linear:
        """What its linear systems are solved with."""
        if self.mixed or self.body.degree < 2 or self.unenriched_with:
            return Linear.FACTOR
        if self.solver.linear != "auto":
            return Linear(self.solver.linear)
        if self.solver.kind == "newton" or self.touched or not self.symmetric:
            return Linear.FACTOR
        return linear_solver(self.body, symmetric=self.symmetric)

    @property
    def single(self) -> bool:
        """Whether the factor of a reference is in single precision, where that is there and leaves enough digits."""
        if self.solver.precision != "auto":
            return self.solver.precision == "single"
        return factor(self.body, mixed=self.mixed, symmetric=self.symmetric).bytes > SINGLE_FROM

    @property
    def cases(self) -> tuple[Self]:
        """Its load cases, which it is the only one of."""
        return (self,)

    @property
    def path_dependent(self) -> bool:
        """Whether a tool rubs on it, or another load remembers, so that its state depends on the states before."""
        return any(load.remembers for load in self.loads)

    @property
    def unavailable(self) -> Mapping[str, str]:
        smooth = [load.label for load in self.loads if load.contact and load.symmetric]
        why = "a tool without friction has no such number, expected a friction above 0 in the load too"
        return {f"loads.{label}.friction": why for label in smooth}

    @property
    def unenriched_with(self) -> str:
        """What it has no place for in other elements: friction, and loads that are no forms; empty without."""
        rubbing = ["friction"] if any(load.contact and load.remembers for load in self.loads) else []
        return " and ".join((*rubbing, *(f"'{load.label}'" for load in self.loads if not load.written)))

    @property
    def unestimated_with(self) -> str:
        """With what no error of its mesh is estimated: that, and tools of which the area in contact has an edge.

        Elements of one degree more enter such a tool between the points where the body touches it: errors of forces
        came out larger than the forces, mostly ten times and more.
        """
        tools = [f"the tool '{load.label}', whose area in contact has an edge" for load in self.loads if load.edged]
        return self.unenriched_with or " and ".join(tools)

    @property
    def touched(self) -> bool:
        return any(load.contact for load in self.loads)

    @property
    def stepped(self) -> Mapping[str, tuple[float, ...]]:
        """Numbers that change step by step, by their paths, with a value for each step."""
        return {}

    @property
    def labels(self) -> tuple[str, ...]:
        """What each step is called; empty without steps."""
        return ()

    @property
    def whole(self) -> LoadedBody:
        """The body at the last step, with the numbers that change among the others."""
        return self

    @property
    def increments(self) -> int:
        """In how many increments the load grows where states depend on those before, in all; 1 elsewhere."""
        if not self.path_dependent:
            return 1
        tools, steps = [load for load in self.loads if load.contact], max(len(self.labels), 1)
        return steps * max([getattr(load, "increments", None) or -(-INCREMENTS // steps) for load in tools], default=1)

    def unlocked(self) -> Self:
        """Return the same body on the same mesh in the form that locks least."""
        body = self.body.model_copy(update={"degree": 2, "quadrature_degree": None})
        return self.model_copy(update={"body": body, "formulation": "mixed" if splits(self.energy) else "displacement"})

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about the body before anything is solved."""
        points = {output.name: output.at for output in self.outputs if hasattr(output, "at")}
        # Loads that follow the body, under which the stability test cannot see everything.
        followers = [load.label for load in self.loads if not load.symmetric and not load.contact]
        unseen = followers and self.strains == "finite" and not self.solver.accept_unstable
        return (
            *self.body.findings,
            *too_narrow(self.body, self.inclusions),
            *too_far(self.body, {p: (number.value,) * 2 for p, number in self.scalars.items()}),
            *moved_points(self.body, points),
            *([Finding("followers", "note", {"loads": ", ".join(followers)})] if unseen else ()),
            *(finding for load in self.loads for finding in load.findings(self.body)),
            *(finding for field in self.fields for finding in field.findings(self.body)),
        )

    def enriched(self) -> Self:
        """Return the same problem on the same mesh with elements of one degree higher, in the same formulation."""
        return self.over({}).model_copy(update={"body": self.body.enriched()})

    @property
    def adaptive(self) -> bool:
        return self.adapt is not None

    @property
    def unrefined(self) -> bool:
        return self.adapt is not None and not self.adapt.refined

    @property
    def largest_bytes(self) -> float:
        """Predicted memory (bytes) of the largest mesh that it may be refined to, with estimates; 0 where it is not."""
        return 0.0 if self.adapt is None or self.adapt.refined else self.adapt.largest_bytes(self)

    def on_mesh(self, file: str, contents: Contents | None = None) -> Self:
        """Return the same problem with the same elements on a refined mesh in a file, or one that holds the same.

        Raises
        ------
        ValidationError
            If the file cannot be read.
        """
        elements = {"degree": self.body.degree, "quadrature_degree": self.body.quadrature_degree}
        known = {} if contents is None else {"contents": contents}
        body = MeshFile.model_validate({"file": file, **known, **elements})
        adapt = None if self.adapt is None else self.adapt.model_copy(update={"refined": True})
        return self.model_copy(update={"body": body, "adapt": adapt})

    def require_modes(self) -> None:
        """Make sure that random fields let the mesh be changed.

        Raises
        ------
        ModelError
            If coefficients of fields are those of its vertices.
        """
        if any(field.basis != "modes" for field in self.fields):
            message = (
                "a random field with a coefficient at every vertex would change with the mesh, expected basis = 'modes'"
            )
            raise ModelError(message)

    def refined(self, level: int) -> Self:
        """Return the same problem on a finer mesh, see the body's `refined`; `formulation` does not change."""
        return self.model_copy(update={"body": self.body.refined(level)})

    @property
    def plane(self) -> tuple[Axis, ...]:
        """Axes along which a box or block is one cell thick between faces that slide: nothing varies along them.

        Not of bodies with inclusions or random fields, which vary everywhere.
        """
        if self.body.kind == "mesh" or self.inclusions or self.fields:
            return ()
        held = {on: set(AXES) for on in self.clamp}
        for item in self.displacements:
            held.setdefault(item.on, set()).update(item.components)
        thick = zip(AXES, self.body.cells, strict=True)
        return tuple(
            axis for axis, n in thick if n == 1 and all(held.get(f"{axis}-{end}") == {axis} for end in ("min", "max"))
        )

    def finer(self, times: float) -> Self:
        """Return the same problem with so many times the cells along each edge but those of a plane, or a few more.

        Raises
        ------
        ModelError
            If the mesh is divided already, or coefficients of fields are those of its vertices.
        """
        self.require_modes()
        if self.body.kind == "mesh":
            return self.refined(math.ceil(math.log2(times) - 1e-9))
        return self.model_copy(update={"body": self.body.with_cells(times, self.plane)})

    def coarser(self, times: float, degree: Literal[1, 2] | None = None) -> Self:
        """Return the same problem with longer cells, perhaps linear ones, which have displacements only.

        Raises
        ------
        ModelError
            If a mesh from a file was not divided as often, coefficients of fields are those of its vertices, or there
            are fewer of these than modes.
        """
        self.require_modes()
        body = self.body.coarser(times, degree)
        for field in self.fields:
            if (field.modes or 0) > body.vertex_count:
                few = f"has {body.vertex_count} vertices, expected at least as many as a random field has modes"
                raise ModelError(f"the mesh with cells {times:g} times as long {few}, {field.modes}")
        changed = {"formulation": "displacement"} if body.degree == 1 else {}
        return self.model_copy(update={"body": body, "adapt": None, **changed})

    @property
    def solver_tolerance(self) -> float:
        return self.solver.tolerance

    def findings_over(self, ranges: Ranges) -> tuple[Finding, ...]:
        of_loads: list[Finding] = []
        for load in self.loads:
            own = f"loads.{load.label}."
            numbers = {path.removeprefix(own): ends for path, ends in ranges.items() if path.startswith(own)}
            of_loads += load.findings_over(self.body, numbers) if numbers else ()
        return (*dict.fromkeys((*self.findings, *of_loads, *too_far(self.body, ranges))), *self.locking(ranges))

    def textbook(self) -> Self:
        """Return the same problem solved by Newton's method from zero, with a new factor for every step."""
        return self.model_copy(update={"solver": self.solver.model_copy(update={"kind": "newton"})})

    def tighter(self, factor: float) -> Self:
        own = self.solver
        both = {"tolerance": factor * own.tolerance, "derivative_tolerance": factor * own.derivative_tolerance}
        return self.model_copy(update={"solver": own.model_copy(update=both)})

    def solved_to(self, tolerance: Any) -> Self:
        solver = SolverSettings.model_validate(self.solver.model_dump() | {"tolerance": tolerance})
        return self.model_copy(update={"solver": solver})

    def cost(self, factors: int = 2) -> Times:
        """Predict the cost of a solve; the factors of one solution and of one reference are kept."""
        predicted = self.solver.kind != "newton" and not self.path_dependent
        contact, mixed, symmetric = self.touched, self.mixed, self.symmetric
        one = times(
            self.body,
            mixed=mixed,
            symmetric=symmetric,
            predicted=predicted,
            factors=factors,
            contact=contact,
            linear=self.linear,
        )
        if self.increments == 1:
            if not predicted or factors < 2 or contact or self.linear == Linear.MULTIGRID:
                return one
            held = 8 * HELD * self.unknowns * together(self.unknowns)  # by the points that are corrected together
            return replace(one, bytes=one.bytes + held)
        whole = sum_of([one] * self.increments)  # each from the one before
        return replace(whole, setup=one.setup, bytes=one.bytes)

    def mesh_error_cost(self, spare: float = math.inf) -> Estimate:
        own, calibrating = own_estimate(self), finer(self, spare)
        if calibrating is None:
            return own
        return replace(own, calibration=calibrating.seconds, calibration_bytes=calibrating.bytes)

    def described(self, ranges: Ranges) -> Iterator[tuple[str, str]]:
        """Say what a mesh file holds, and how many unknowns there are of which kind."""
        decision, body, whole = self.decision(ranges), self.body, self.over(ranges)
        form = "mixed form: displacements and pressures" if decision.mixed else "displacement form"
        yield from body.listed.items()
        count = f"{'at first ' if self.unrefined else ''}{whole.unknowns:,}"
        yield "unknowns", f"{count} ({body.cell_count:,} cells: {body.cell}, degree {body.degree}; {form})"
        yield "form", f"{'mixed' if decision.mixed else 'displacement'}: {decision.why}"
        referred = whole.linear != Linear.MULTIGRID and whole.solver.kind != "newton" and not whole.path_dependent
        precision = "; that of the reference in single precision" if referred and whole.single else ""
        yield "linear", IN_WORDS[whole.linear] + precision
        if self.adapt is not None:
            yield "mesh", self.adapt.in_words(self)

    def identity(self) -> dict[str, Any]:
        """Return everything that results depend on; a mesh file counts by its hash, not by its path."""
        found = super().identity()
        found["body"].pop("file", None)
        return found

    def _mistakes(self) -> Iterator[Mistake]:
        """Mistakes that no single block can see: unknown boundaries, repeated names, a body that can move freely."""
        boundaries, blocks = self.body.boundaries, dict(self)
        places: list[tuple[tuple[str | int, ...], str]] = [(("clamp", i), on) for i, on in enumerate(self.clamp)]
        for block in ("displacements", "loads", "outputs"):
            places += [((block, i, "on"), item.on) for i, item in enumerate(blocks[block]) if hasattr(item, "on")]
        unknown = [(place, on) for place, on in places if on not in boundaries]
        for place, on in unknown:
            yield place, f"unknown boundary; {nearest(on, boundaries)}", on
        for block in ("inclusions", "fields", "displacements", "loads"):
            yield from repeated(block, [item.label for item in blocks[block]])
        yield from repeated("outputs", [item.name for item in self.outputs])
        yield from self.own_mistakes()
        for i, field in enumerate(self.fields):
            if field.of == "density" and not any(load.of_density for load in self.loads):
                yield ("fields", i, "of"), "no load is gravity, expected one where the density varies", field.of
        yield from self._mistakes_of_outputs()
        yield from self._mistakes_of_linear_solver()
        support = Support(self.body, self.clamp, self.displacements, self.loads)
        yield from support.contradictions()
        if self.adapt is not None and self.unrefined:
            yield from self.adapt.mistakes(self)
        what = self.unestimated_with
        if self.adapt is not None and what:
            expected = "friction = 0" if what == "friction" else "neither"
            yield ("adapt",), f"errors of the mesh are not estimated with {what}, expected {expected}", True
        yield from support.mistakes(complete=not unknown)

    def _mistakes_of_outputs(self) -> Iterator[Mistake]:
        held = set(self.clamp) | {item.on for item in self.displacements}
        tools = [load.label for load in self.loads if load.contact]
        for i, output in enumerate(self.outputs):
            on, at, tool = (getattr(output, name, None) for name in ("on", "at", "tool"))
            if tool is not None and tool not in tools:
                hint = nearest(tool, tools) if tools else "no load is an indenter"
                if "tool" in output.model_fields_set:
                    yield ("outputs", i, "tool"), f"unknown tool; {hint}", tool
                else:
                    yield ("outputs", i, "tool"), f"which tool? {hint}", {}
            if output.of_held and on in self.body.boundaries and on not in held:
                yield ("outputs", i, "on"), "nothing holds this boundary, expected one that is clamped or moved", on
            if at is not None and not holds(self.body, at):
                yield ("outputs", i, "at"), f"outside the body, which lies in {extent(self.body)}", list(at)

    def _mistakes_of_linear_solver(self) -> Iterator[Mistake]:
        asked = self.solver.linear
        if asked not in {"multigrid", "both"}:
            return
        objection = ""
        if self.body.degree < 2:
            objection = "multigrid needs cells of degree 2, between which and linear ones it goes to and fro"
        elif self.formulation == "mixed":
            objection = "multigrid solves for displacements only, and the form is mixed"
        elif self.unenriched_with:
            objection = f"multigrid is not available with {self.unenriched_with}"
        elif self.solver.kind == "newton":
            objection = "the textbook solver has a factor for every step"
        if objection:
            yield ("solver", "linear"), f"{objection}; expected 'factor' or 'auto'", asked
