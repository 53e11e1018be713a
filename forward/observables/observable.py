"""What every output is: a block of settings with a unit that knows its value and its derivatives.

An output is a class, here or in a file beside a study (``kind = "my_tissue.Lengthening"``):

    class Lengthening(Observable):
        "Mean of λ² − 1 along x."

        kind: str
        unit: ClassVar[str] = "1"

        def functional(self, equations: Equations) -> Functional:
            return Integral(equations, (equations.F.T * equations.F)[0, 0] - 1, equations.volume)

A field called `on` is the name of a boundary, a field called `at` is a point (m) of the undeformed body. UFL
and FEniCSx are imported inside the methods, so that a study can be checked without them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Annotated, Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from forward.model import FloatArray
from forward.registry import Kinds, OfKind
from forward.settings import Settings


class Functional(Protocol):
    """An output ψ(u, ω) of a discretised body, at the state and the parameters that its equations are set to.

    All methods are collective over the ranks of the equations. Forces, which friction is part of, have a
    `gradient_before` too: ∂ψ/∂u by the state at the end of the increment before. What a reduced model can have says as
    what it is an output there (`reduced_as`, a kind of `forward.reduced.data.Output`).
    """

    def value(self) -> float:
        """Return ψ, the same on every rank."""

    def gradient(self) -> FloatArray:
        """Return this rank's part (U_local,) of ∂ψ/∂u, over free and prescribed unknowns, pressures included."""

    def partial(self) -> FloatArray:
        """Return the explicit derivative ∂ψ/∂ω (d,)."""


class Equations(Protocol):
    """What outputs ask of the discrete equations of a body (`forward.fem.equations`); UFL and DOLFINx are `Any`.

    Attributes
    ----------
    spec
        Specification of the model.
    comm
        Communicator of the ranks that share the body.
    parameters
        Paths of the parameters.
    scalars
        Which of them (s,) are numbers of the model rather than coefficients of random fields.
    fields
        Random fields.
    mesh, facets, space
        Mesh, facets of each boundary, space of the displacements.
    layout
        Order of the nodes.
    nodes_owned, size
        Numbers of this rank's nodes and unknowns.
    dx
        Measure of the undeformed body.
    u, test, F, J
        Displacement, virtual displacement, deformation gradient and its determinant.
    """

    spec: Any
    comm: Any
    parameters: tuple[str, ...]
    scalars: NDArray[np.int64]
    fields: tuple[Any, ...]
    mesh: Any
    facets: Any
    space: Any
    layout: Any
    nodes_owned: int
    size: int
    dx: Any
    u: Any
    test: Any
    F: Any
    J: Any
    stored_energy: Any
    dilation: Any

    @property
    def energy(self) -> Any:
        """Energy density; in the mixed form, without its volumetric part."""

    @property
    def size_before(self) -> int:
        """Number of values on this rank that an increment leaves: its unknowns, and what items keep behind them."""

    @property
    def volume(self) -> float:
        """Volume (m³) of the undeformed mesh."""

    def surface(self, boundary: str, degree: int | None = None) -> Any:
        """Measure of a named boundary, with at least a degree of quadrature."""

    def tool(self, label: str) -> tuple[Any, Any]:
        """Return a tool among the loads by its label, and the expressions with which it is written."""

    def pressures_at_vertices(self, label: str) -> Any:
        """Pressures under a tool, averaged by hat functions."""

    def stress_of(self, density: Any) -> Any:
        """P = ∂W/∂F (Pa) of an energy density."""

    def derivative(self, form: Any) -> Any:
        """Gâteaux derivative of a form with respect to all unknowns."""

    def along_parameters(self, integrand: Any) -> Any | None:
        """Σ_i (∂ integrand/∂ω_i) dω_i along the direction that is set; None if it depends on no parameter."""

    def unit_directions(self) -> Iterator[str]:
        """Set the direction to each unit vector of the numbers of the model in turn."""

    def derivative_before(self, form: Any) -> Any | None:
        """Compiled derivative of a functional by the state at the increment before; None if it depends on none."""

    def rubbed(self, w: FloatArray) -> FloatArray:
        """Derivative (U_local,) of wᵀF by the state at the increment before."""

    def scalar(self, form: Any) -> Any:
        """Compile a functional."""

    def vector(self, form: Any) -> Any:
        """Compile a linear form."""

    def by_vertices(self, form: Any) -> Any:
        """Compile a form that is linear in values at the vertices."""

    def on_facets(self, expression: Any, boundary: str, degree: int) -> Any:
        """Compile an expression for evaluation at the quadrature points of a boundary."""

    def at_points(self, expression: Any) -> Any:
        """Compile an expression for evaluation at the quadrature points."""

    def state(self) -> FloatArray:
        """This rank's part (U_local,) of the state."""

    def displacements(self) -> FloatArray:
        """Displacements (nodes_owned, 3)."""

    def with_pressures(self, displacements: FloatArray) -> FloatArray:
        """Extend this rank's part (3 nodes_owned,) of a vector by zeros for the pressures, where they are unknowns."""

    def dot(self, x: FloatArray, y: FloatArray) -> float:
        """Inner product over all ranks."""

    def imbalance(self) -> FloatArray:
        """Imbalance (U_local,); on prescribed unknowns, the reactions."""

    def stiffness_times(self, w: FloatArray, *, transpose: bool = False) -> FloatArray:
        """Product of the stiffness of all unknowns (or its transpose) with w (U_local,)."""

    def parameter_forces(self) -> FloatArray:
        """∂F/∂ω (s, U_local), by the numbers of the model."""

    def field_products(self, w: FloatArray) -> FloatArray:
        """Products wᵀ∂F/∂ω (d,) with w (U_local,); zero for the numbers of the model."""


class Observable(Settings):
    """An output of a body; every kind defines `kind` and `functional`."""

    name: str = Field(min_length=1)
    unit: ClassVar[str] = "m"  # SI unit of the value
    of_held: ClassVar[bool] = False  # whether its boundary has to be clamped or moved
    estimable: ClassVar[bool] = True  # whether an error of the mesh can be estimated: not of stresses at single points

    @property
    def negative(self) -> bool:
        """Whether it can be below 0."""
        return True

    def functional(self, equations: Equations) -> Functional:
        """Prepare the evaluation; collective.

        Raises
        ------
        ModelError
            If it cannot be evaluated on the mesh.
        """
        raise NotImplementedError

    def enriched(self, coarse: Functional, equations: Equations, up: Callable[[FloatArray], FloatArray]) -> Functional:
        """Prepare the evaluation in elements of one degree more, for the error of the mesh; collective.

        Parameters
        ----------
        coarse
            The functional of the body.
        equations
            The same body in elements of one degree more.
        up
            Takes vectors (U_local,) of the body to the same functions there.
        """
        return self.functional(equations)


OUTPUTS = Kinds(
    "output",
    {
        "max-displacement": "forward.observables.largest:MaxDisplacement",
        "displacement": "forward.observables.integrals:PointDisplacement",
        "mean-displacement": "forward.observables.integrals:MeanDisplacement",
        "reaction": "forward.observables.integrals:Reaction",
        "strain-energy": "forward.observables.integrals:StrainEnergy",
        "volume-change": "forward.observables.integrals:VolumeChange",
        "max-von-mises": "forward.observables.largest:MaxVonMises",
        "force": "forward.observables.integrals:Force",
        "contact-area": "forward.observables.integrals:ContactArea",
        "max-pressure": "forward.observables.largest:MaxPressure",
    },
    Observable,
)
Output = Annotated[Observable, OfKind(OUTPUTS)]
