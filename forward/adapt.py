"""What a study says of a mesh that is to be refined where that matters; the loop is `forward.fem.adapt`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal, Protocol

from annotated_types import Ge, Gt, Le, Lt
from pydantic import Field

from forward.fem.cost import times
from forward.fem.mesh_error_cost import estimate
from forward.scalars import Mistake
from forward.settings import Settings, nearest

if TYPE_CHECKING:
    from forward.observables.observable import Observable
    from forward.solvers.settings import SolverSettings

OF_ROUNDING = 1e-9  # relative errors of outputs that are no errors of a mesh
OF_SOLVER = 10.0  # tolerances of the solver below which an error of the mesh cannot be seen


class Meshed(Protocol):
    """What is asked of the specification of a body."""

    @property
    def adapt(self) -> Adapt | None:
        """What is to be done."""

    @property
    def body(self) -> Any:
        """Geometry and mesh."""

    @property
    def outputs(self) -> tuple[Observable, ...]:
        """What is computed."""

    @property
    def fields(self) -> tuple[Any, ...]:
        """Random fields."""

    @property
    def solver(self) -> SolverSettings:
        """Tolerances."""

    @property
    def unknowns(self) -> int:
        """Number of unknowns."""

    @property
    def mixed(self) -> bool:
        """Whether pressures are unknowns too."""

    @property
    def symmetric(self) -> bool:
        """Whether the stiffness is symmetric."""

    def enriched(self) -> Meshed:
        """Return the same in elements of one degree more."""


class Adapt(Settings):
    """Refine the mesh at the mean of the parameters, until the errors that it makes of outputs are small.

    Parameters
    ----------
    tolerance
        Estimated error of each output that is enough, relative to its value.
    outputs
        Their names; by default all outputs whose error can be estimated.
    indicator
        What says where cells are refined: "dual-weighted", what each adds to the errors of these outputs; or
        "recovery", how far stresses are from their averages at the vertices, whatever the outputs
        (O. C. Zienkiewicz, J. Z. Zhu, Int. J. Numer. Meth. Eng. 24 (1987) 337–357).
    unknowns
        Most unknowns that the mesh may have.
    cycles
        How often it is refined at most.
    refined
        Whether the mesh of the body is the refined one; written by the run.
    """

    tolerance: Annotated[float, Gt(0), Lt(1)]
    outputs: Annotated[tuple[str, ...], Field(min_length=1)] | None = None
    indicator: Literal["dual-weighted", "recovery"] = "dual-weighted"
    unknowns: Annotated[int, Gt(0)] = 100_000
    cycles: Annotated[int, Ge(1), Le(100)] = 20
    refined: bool = False

    def named(self, spec: Meshed) -> tuple[int, ...]:
        """Return the places of the outputs that the mesh is refined for."""
        known = [i for i, output in enumerate(spec.outputs) if output.estimable]
        return tuple(i for i in known if self.outputs is None or spec.outputs[i].name in self.outputs)

    def in_words(self, spec: Meshed) -> str:
        """Say what is done, and until when."""
        names = ", ".join(spec.outputs[i].name for i in self.named(spec))
        if self.refined:
            return f"refined for {names}"
        return (
            f"refined at the mean of the parameters until the error of {names} is below {100 * self.tolerance:g} %, to "
            f"at most {self.unknowns:,} unknowns; memory and times below are those of the first mesh"
        )


@dataclass(frozen=True)
class _Grown:
    """A body with so many nodes, for predictions."""

    cell: str
    degree: int
    cell_count: int
    nodes: int
    vertex_count: int
    bounds: tuple[tuple[float, float], ...]


def largest_bytes(spec: Meshed) -> float:
    """Predict the memory (bytes) of a body on the largest mesh, with its equations in elements of one degree more."""
    assert spec.adapt is not None
    times_as_many = spec.adapt.unknowns / spec.unknowns
    mixed, symmetric = spec.mixed, spec.symmetric

    def grown(body: Any) -> _Grown:
        cells, nodes, vertices = (int(times_as_many * n) for n in (body.cell_count, body.nodes, body.vertex_count))
        return _Grown(body.cell, body.degree, cells, nodes, vertices, body.bounds)

    own, enriched = grown(spec.body), grown(spec.enriched().body)
    of_estimate = estimate(own, enriched, mixed=mixed, symmetric=symmetric)
    return times(own, mixed=mixed, symmetric=symmetric).bytes + of_estimate.bytes


def of_fields(spec: Meshed) -> str | None:
    """Say why random fields keep a mesh from being changed, or None if they do not."""
    if any(field.basis != "modes" for field in spec.fields):
        return "a random field with a coefficient at every vertex would change with the mesh, expected basis = 'modes'"
    return None


def mistakes(spec: Meshed) -> Iterator[Mistake]:
    """Find what keeps the mesh of a body from being adapted."""
    adapt = spec.adapt
    if adapt is None or adapt.refined:
        return
    if spec.body.cell != "tetrahedron":
        instead = "a mesh of tetrahedra" if spec.body.kind == "mesh" else "body.cell = 'tetrahedron'"
        message = (
            f"hexahedra are not refined locally, expected {instead}, or finer cells everywhere (the levels of "
            "method.kind = 'multilevel-monte-carlo' say what that is worth)"
        )
        yield ("adapt",), message, spec.body.cell
    names = [output.name for output in spec.outputs]
    for i, name in enumerate(adapt.outputs or ()):
        if name not in names:
            yield ("adapt", "outputs", i), f"no output has this name; {nearest(name, tuple(names))}", name
        elif not spec.outputs[names.index(name)].estimable:
            yield ("adapt", "outputs", i), "the error of the mesh in this output cannot be estimated", name
    if adapt.outputs is None and not adapt.named(spec):
        yield ("adapt",), "of no output the error of the mesh can be estimated, expected one where it can", names
    least = max(OF_SOLVER * spec.solver.tolerance, OF_ROUNDING)
    if adapt.tolerance < least:
        message = (
            f"below what the solver reaches (model.solver.tolerance = {spec.solver.tolerance:g}), expected at least "
            f"{least:g}"
        )
        yield ("adapt", "tolerance"), message, adapt.tolerance
    if adapt.unknowns < spec.unknowns:
        message = f"the mesh has {spec.unknowns:,} before it is refined, expected at least as many"
        yield ("adapt", "unknowns"), message, adapt.unknowns
    for i, field in enumerate(spec.fields):
        if field.basis != "modes":
            message = "its coefficients would change with the mesh that model.adapt makes, expected 'modes'"
            yield ("fields", i, "basis"), message, field.basis
