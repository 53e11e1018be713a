"""An energy, a load, an output, a method and a section of the report beside a study."""

from collections.abc import Iterator
from itertools import product
from typing import Annotated, Any, ClassVar

import numpy as np
import xarray as xr
from annotated_types import Ge, Gt, Unit

from forward.observables.functionals import Integral
from forward.observables.observable import Observable
from forward.terms.term import Term
from uq.evaluation.request import Evaluate, Request
from uq.inputs.random_parameters import Inputs
from uq.methods.method import Method
from workflows.report.blocks import Block, Heading, Table
from workflows.report.section import Results, Section


def fung(
    ops: Any,
    i1: Any,
    j: Any,
    *,
    c: Annotated[float, Gt(0), Unit("Pa")],
    b: Annotated[float, Gt(0), Unit("1")],
    D1: Annotated[float, Unit("Pa")],
) -> Any:
    """Isotropic Fung: W = c/(2b) (exp(b(Ī1−3)) − 1) + D1(J−1)²."""
    return c / (2 * b) * ops.expm1(b * i1) + D1 * j**2


class Springs(Term):
    """Springs that hold a boundary: the traction −k u."""

    kind: str
    on: str
    k: Annotated[float, Ge(0), Unit("Pa/m")]

    def potential(self, at: Any) -> Any:
        """Return the energy of the springs."""
        import ufl

        return at.numbers["k"] / 2 * ufl.inner(at.u, at.u) * at.on(self.on)


class Swept(Observable):
    """Volume that a boundary sweeps as it moves."""

    kind: str
    on: str
    unit: ClassVar[str] = "m³"

    def functional(self, equations: Any) -> Any:
        """Return the integral of the normal displacement."""
        import ufl

        normal = ufl.FacetNormal(equations.mesh)
        return Integral(equations, ufl.dot(equations.u, normal), measure=equations.surface(self.on))


class Corners(Method):
    """Smallest and largest outputs over the corners of a box of quantiles."""

    kind: str
    probability: float = 0.05

    def planned(self, dimension: int) -> int:
        """Return the number of solves."""
        return 1 + 2**dimension

    def run(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        """Return the ends of the outputs."""
        ends = np.array(list(product((self.probability, 1 - self.probability), repeat=len(inputs.names))))
        found = evaluate(Request(inputs.points(ends)))
        return xr.Dataset(
            {
                "smallest": ("output", np.nanmin(found.outputs, axis=0)),
                "largest": ("output", np.nanmax(found.outputs, axis=0)),
            },
            coords={"output": list(evaluate.outputs), "parameter": list(inputs.names)},
        )


class Ends(Section):
    """The smallest and largest outputs of `Corners`."""

    def applies(self, results: Results) -> bool:
        """Whether the method was `Corners`."""
        return "smallest" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """Yield a table."""
        rows = [
            [name, *(f"{float(results.dataset[end].sel(output=name)):.4g}" for end in ("smallest", "largest"))]
            for name in results.outputs
        ]
        yield Heading("The ends of what is likely")
        yield Table(["output", "smallest", "largest"], rows)
