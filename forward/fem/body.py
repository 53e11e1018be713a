"""A discrete body, and what is made of it once: equations, outputs, a reference factor, the same in richer elements.

Its equilibria are found by `forward.fem.model`, and are `forward.fem.solution`.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, Generic, Protocol, TypeVar

from forward.fem.cost import MOST_BYTES
from forward.fem.enriched import Enriched
from forward.fem.equations import Discretisation
from forward.fem.mesh_error_cost import Way, own_estimate
from forward.fem.reference import ReferenceFactor
from forward.fem.space import BodySpace, Observation
from forward.loaded import LoadedBody
from forward.materials.admissible import Admission
from forward.model import FloatArray, Guess, NodalSpace, Saturation, SolveError

AT_REST = 1e-12  # norm of displacements over the extent of a body that nothing has moved
UNSEEN = 0.02  # of the depth, by which a tool may enter a body that nothing has moved
STIFFER, RAISES = 4.0, 3  # factor on the stiffness of tools that the body enters too far, and how often it is raised

S = TypeVar("S")
S_contra = TypeVar("S_contra", contravariant=True)


class Calibrating(Protocol[S_contra]):
    """What calibrates estimates of the error of the mesh at solutions."""

    def calibrated(self, solution: S_contra) -> Saturation | None:
        """Calibrate those at a solution; None where that takes too much."""

    def hidden(self, solution: S_contra) -> FloatArray | None:
        """Return what flat facets hide of a curved surface in the outputs (m,); None where they hide nothing."""


def not_estimated(what: str) -> SolveError:
    """Return the refusal of an estimate of the error of the mesh."""
    return SolveError(f"the error of the mesh is not estimated with {what}; compare with a finer mesh")


class DiscreteBody(Generic[S]):
    """A body on one mesh, with one set of forms and one solver for every realisation, and solutions of one kind.

    Ranks of a communicator share it; parameter vectors hold the numbers of these paths.

    Raises
    ------
    ValueError
        For a path that is not a number of the model, or an output at a point outside the body.
    """

    differentiable = True

    def __init__(self, spec: LoadedBody, comm: Any, parameters: tuple[str, ...]) -> None:
        scalars = spec.scalars
        coefficients = set(spec.coefficients)
        for path in parameters:
            if path not in scalars and path not in coefficients:
                known = [*scalars, *(f"fields.{field.label}.0" for field in spec.fields)]
                raise ValueError(f"'{path}' is not a number of the model, expected one of: {', '.join(known)}")
        self.spec = spec = spec.linearised() if spec.strains == "small" else spec
        self.parameters = parameters
        self.outputs = tuple(output.name for output in spec.outputs)
        self.equations = Discretisation(spec, comm, parameters)
        self.space: NodalSpace = BodySpace(self.equations)
        self.rows: Observation | None = None  # what is observed in place of the outputs
        self.functionals = [output.functional(self.equations) for output in spec.outputs]
        self._richer: dict[int, Enriched] = {}  # by how many degrees; copies share it
        self.require_admissible = Admission(spec, parameters).require  # refuses parameters (d,) without a model
        self._extent = max(high - low for low, high in spec.body.bounds)

    @cached_property
    def reference(self) -> ReferenceFactor:
        """The factor at the last reference given."""
        return ReferenceFactor(self.equations)

    @property
    def enriched(self) -> Enriched:
        """The body in elements of one degree higher, to estimate the error of its mesh; collective when first used.

        Raises
        ------
        SolveError
            If something acts on it that has no place there.
        """
        if self.spec.unenriched_with:
            raise not_estimated(self.spec.unenriched_with)
        if 1 not in self._richer:
            self._richer[1] = Enriched(self.equations, self.spec.enriched(), self.functionals)
        return self._richer[1]

    @property
    def enriched_twice(self) -> Enriched | None:
        """The same of two degrees more, to calibrate that; None where they take too much or are solved too roughly."""
        spec = self.spec.enriched().enriched()
        cost = own_estimate(self.spec, spec)
        # What steps with pressures leave is too much of what two degrees say more than one: typical factors are closer.
        rough = spec.mixed and cost.way == Way.SMOOTHING
        if cost.bytes <= MOST_BYTES and not rough and 2 not in self._richer:
            self._richer[2] = Enriched(self.equations, spec, self.functionals)
        return self._richer.get(2)

    def solve(self, parameters: FloatArray, guess: Guess | None = None) -> S:
        """Find the equilibrium at `parameters` (d,); collective."""
        raise NotImplementedError

    def finer_mesh(self, spare: float) -> Calibrating[S]:
        """Return the body on a finer mesh, which may cost so many solves."""
        raise NotImplementedError

    def enters(self, state: FloatArray, stiffer: float) -> bool:
        """Whether the body in a state (U_local,) enters a tool farther than is aimed at, with tools so much stiffer.

        Raises
        ------
        SolveError
            If it does, and tools cannot be stiffer.
        """
        equations = self.equations
        equations.set_state(state)
        penetrations = equations.penetrations()
        for load in (load for load in self.spec.loads if load.contact):
            depth, aim = equations.number(f"loads.{load.label}.depth"), load.penetration  # type: ignore[attr-defined]
            penetration = penetrations[load.label]
            if depth <= 0 or penetration <= aim * depth:
                continue
            if stiffer >= STIFFER**RAISES:
                message = (
                    f"the body enters the tool '{load.label}' by {penetration / depth:.2g} of its depth, where {aim:g} "
                    f"is aimed at, even with tools {stiffer:g} times as stiff as the depth and the constants as stated "
                    "ask for: pressures are far above these; state constants, or a depth, near those of the samples"
                )
                raise SolveError(message, work=equations.work)
            return True
        return False

    def refuse_sharp(self, state: FloatArray) -> None:
        """Refuse a state (U_local,) at rest though a tool is inside the body, between the points that are looked at."""
        equations = self.equations
        if equations.norm(state) > AT_REST * self._extent:
            return
        for load in (load for load in self.spec.loads if load.contact):
            numbers = {name: equations.number(f"loads.{load.label}.{name}") for name in load.scalars}
            if load.entered(self.spec.body, numbers) > UNSEEN * numbers["depth"]:  # type: ignore[attr-defined]
                message = (
                    f"the tool '{load.label}' enters the body between the points at which contact is looked for: it is "
                    "too sharp, or its depth too small, for the mesh; refine the mesh there"
                )
                raise SolveError(message, work=equations.work)
