"""What every output is: a block of settings with a unit that knows its value and its derivatives.

An output is a class, here or in a file beside a study (``kind = "my_tissue.Lengthening"``):

    class Lengthening(Observable):
        "Mean of λ² − 1 along x."

        kind: str
        unit: ClassVar[str] = "1"

        def functional(self, equations: Equations) -> Functional:
            return Integral(equations, (equations.F.T * equations.F)[0, 0] - 1, equations.volume)

It is written with the discrete equations of the body (`forward.fem.equations.Discretisation`), which hold UFL and
DOLFINx's objects. A field called `on` is the name of a boundary, a field called `at` is a point (m) of the undeformed
body. UFL and FEniCSx are imported inside the methods, so that a study can be checked without them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, ClassVar, Protocol, Self

import numpy as np
from pydantic import Field

from forward.bodies.geometry import Body
from forward.model import FloatArray
from forward.registry import Kinds, OfKind
from forward.settings import Settings

Equations = Any  # those of a body


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


class Observable(Settings):
    """An output of a body; every kind defines `kind` and `functional`."""

    name: str = Field(min_length=1)
    unit: ClassVar[str] = "m"  # SI unit of the value
    of_held: ClassVar[bool] = False  # whether its boundary has to be clamped or moved
    estimable: ClassVar[bool] = True  # whether an error of the mesh can be estimated: not of stresses at single points
    negative: ClassVar[bool] = True  # whether it can be below 0

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

        `coarse` is the functional of the body, and `up` takes vectors (U_local,) of the body to the same functions
        there.
        """
        return self.functional(equations)

    def within(self, body: Body) -> Self:
        """Return the same output in a body whose surface lies a little elsewhere: at a point, at the nearest place."""
        at = vars(self).get("at")
        return self if at is None else self.model_copy(update={"at": tuple(body.nearest(np.array([at]))[0].tolist())})


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
        "contact-area": "forward.observables.contact:ContactArea",
        "max-pressure": "forward.observables.largest:MaxPressure",
    },
    Observable,
)
Output = Annotated[Observable, OfKind(OUTPUTS)]
