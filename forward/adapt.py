"""What a study says of a mesh that is to be refined where that matters; the loop is `forward.fem.adapt`."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Le, Lt
from pydantic import Field

from forward.bodies.geometry import Body
from forward.fem.cost import times
from forward.fem.mesh_error_cost import estimate
from forward.scalars import Mistake
from forward.settings import Settings, nearest

OF_ROUNDING = 1e-9  # relative errors of outputs that are no errors of a mesh
OF_SOLVER = 10.0  # tolerances of the solver below which an error of the mesh cannot be seen


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

    def named(self, spec: Any) -> tuple[int, ...]:
        """Return the places of the outputs that the mesh of a `forward.loaded.LoadedBody` is refined for."""
        known = [i for i, output in enumerate(spec.outputs) if output.estimable]
        return tuple(i for i in known if self.outputs is None or spec.outputs[i].name in self.outputs)

    def in_words(self, spec: Any) -> str:
        """Say what is done, and until when."""
        names = ", ".join(spec.outputs[i].name for i in self.named(spec))
        if self.refined:
            return f"refined for {names}"
        return (
            f"refined at the mean of the parameters until the error of {names} is below {100 * self.tolerance:g} %, to "
            f"at most {self.unknowns:,} unknowns; memory and times below are those of the first mesh"
        )

    def largest_bytes(self, spec: Any) -> float:
        """Predict the memory (bytes) of the largest mesh that a body may be refined to, with estimates of its error."""
        times_as_many = self.unknowns / spec.unknowns
        mixed, symmetric = spec.mixed, spec.symmetric

        def grown(body: Body) -> Any:
            counts = {"cell_count": body.cell_count, "nodes": body.nodes, "vertex_count": body.vertex_count}
            more = {name: int(times_as_many * count) for name, count in counts.items()}
            return SimpleNamespace(cell=body.cell, degree=body.degree, bounds=body.bounds, **more)

        own, enriched = grown(spec.body), grown(spec.enriched().body)
        of_estimate = estimate(own, enriched, mixed=mixed, symmetric=symmetric)
        return times(own, mixed=mixed, symmetric=symmetric).bytes + of_estimate.bytes

    def mistakes(self, spec: Any) -> Iterator[Mistake]:
        """Find what keeps the mesh of a body from being adapted."""
        if spec.body.cell != "tetrahedron":
            instead = "a mesh of tetrahedra" if spec.body.kind == "mesh" else "body.cell = 'tetrahedron'"
            message = (
                f"hexahedra are not refined locally, expected {instead}, or finer cells everywhere (the levels of "
                "method.kind = 'multilevel-monte-carlo' say what that is worth)"
            )
            yield ("adapt",), message, spec.body.cell
        names = [output.name for output in spec.outputs]
        for i, name in enumerate(self.outputs or ()):
            if name not in names:
                yield ("adapt", "outputs", i), f"no output has this name; {nearest(name, tuple(names))}", name
            elif not spec.outputs[names.index(name)].estimable:
                yield ("adapt", "outputs", i), "the error of the mesh in this output cannot be estimated", name
        if self.outputs is None and not self.named(spec):
            yield ("adapt",), "of no output the error of the mesh can be estimated, expected one where it can", names
        least = max(OF_SOLVER * spec.solver.tolerance, OF_ROUNDING)
        if self.tolerance < least:
            message = (
                f"below what the solver reaches (model.solver.tolerance = {spec.solver.tolerance:g}), expected at "
                f"least {least:g}"
            )
            yield ("adapt", "tolerance"), message, self.tolerance
        if self.unknowns < spec.unknowns:
            message = f"the mesh has {spec.unknowns:,} before it is refined, expected at least as many"
            yield ("adapt", "unknowns"), message, self.unknowns
        for i, field in enumerate(spec.fields):
            if field.basis != "modes":
                message = "its coefficients would change with the mesh that model.adapt makes, expected 'modes'"
                yield ("fields", i, "basis"), message, field.basis
