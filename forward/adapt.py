"""What a study says of a mesh that is to be refined where that matters; the loop is `forward.fem.adapt`."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from annotated_types import Ge, Gt, Le, Lt
from pydantic import Field

from forward.bodies.mesh_file import MeshFile
from forward.fem.cost import times
from forward.fem.mesh_error_cost import estimate
from forward.model import ModelError
from forward.scalars import Mistake
from forward.settings import Settings, nearest
from forward.solid import Solid

if TYPE_CHECKING:
    from forward.bodies.geometry import Body
    from forward.bodies.mesh import Contents
    from forward.observables.observable import Output

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

    def named(self, spec: Refinable) -> tuple[int, ...]:
        """Return the places of the outputs that the mesh is refined for."""
        known = [i for i, output in enumerate(spec.outputs) if output.estimable]
        return tuple(i for i in known if self.outputs is None or spec.outputs[i].name in self.outputs)

    def in_words(self, spec: Refinable) -> str:
        """Say what is done, and until when."""
        names = ", ".join(spec.outputs[i].name for i in self.named(spec))
        if self.refined:
            return f"refined for {names}"
        return (
            f"refined at the mean of the parameters until the error of {names} is below {100 * self.tolerance:g} %, to "
            f"at most {self.unknowns:,} unknowns; memory and times below are those of the first mesh"
        )


class Refinable(Solid):
    """A body whose mesh can be refined where that matters for its outputs."""

    if TYPE_CHECKING:  # fields and properties of those that descend from it
        adapt: Adapt | None
        outputs: tuple[Output, ...]

        @property
        def symmetric(self) -> bool:
            """Whether the stiffness is symmetric."""

    def enriched(self) -> Self:
        """Return the same problem on the same mesh with elements of one degree higher, in the same formulation."""
        formulation = "mixed" if self.mixed else "displacement"
        return self.model_copy(update={"body": self.body.enriched(), "formulation": formulation})

    @property
    def adaptive(self) -> bool:
        """Whether the mesh is refined before anything else is solved."""
        return self.adapt is not None

    @property
    def unrefined(self) -> bool:
        """Whether that is still to be done."""
        return self.adapt is not None and not self.adapt.refined

    @property
    def largest_bytes(self) -> float:
        """Predicted memory (bytes) of the largest mesh that it may be refined to, with estimates; 0 where it is not."""
        if self.adapt is None or self.adapt.refined:
            return 0.0
        times_as_many = self.adapt.unknowns / self.unknowns
        mixed, symmetric = self.mixed, self.symmetric

        def grown(body: Body) -> Any:
            counts = {"cell_count": body.cell_count, "nodes": body.nodes, "vertex_count": body.vertex_count}
            more = {name: int(times_as_many * count) for name, count in counts.items()}
            return SimpleNamespace(cell=body.cell, degree=body.degree, bounds=body.bounds, **more)

        own, enriched = grown(self.body), grown(self.enriched().body)
        of_estimate = estimate(own, enriched, mixed=mixed, symmetric=symmetric)
        return times(own, mixed=mixed, symmetric=symmetric).bytes + of_estimate.bytes

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

    def mistakes_of_adapt(self) -> Iterator[Mistake]:
        """Find what keeps the mesh from being adapted."""
        adapt = self.adapt
        if adapt is None or adapt.refined:
            return
        if self.body.cell != "tetrahedron":
            instead = "a mesh of tetrahedra" if self.body.kind == "mesh" else "body.cell = 'tetrahedron'"
            message = (
                f"hexahedra are not refined locally, expected {instead}, or finer cells everywhere (the levels of "
                "method.kind = 'multilevel-monte-carlo' say what that is worth)"
            )
            yield ("adapt",), message, self.body.cell
        names = [output.name for output in self.outputs]
        for i, name in enumerate(adapt.outputs or ()):
            if name not in names:
                yield ("adapt", "outputs", i), f"no output has this name; {nearest(name, tuple(names))}", name
            elif not self.outputs[names.index(name)].estimable:
                yield ("adapt", "outputs", i), "the error of the mesh in this output cannot be estimated", name
        if adapt.outputs is None and not adapt.named(self):
            yield ("adapt",), "of no output the error of the mesh can be estimated, expected one where it can", names
        least = max(OF_SOLVER * self.solver.tolerance, OF_ROUNDING)
        if adapt.tolerance < least:
            message = (
                f"below what the solver reaches (model.solver.tolerance = {self.solver.tolerance:g}), expected at "
                f"least {least:g}"
            )
            yield ("adapt", "tolerance"), message, adapt.tolerance
        if adapt.unknowns < self.unknowns:
            message = f"the mesh has {self.unknowns:,} before it is refined, expected at least as many"
            yield ("adapt", "unknowns"), message, adapt.unknowns
        for i, field in enumerate(self.fields):
            if field.basis != "modes":
                message = "its coefficients would change with the mesh that model.adapt makes, expected 'modes'"
                yield ("fields", i, "basis"), message, field.basis
