"""What every load is: a block of settings that adds to the potential of a body, or to the virtual work done on it.

A load is a class in its own file, here or beside a study (``kind = "my_tissue.Springs"``):

    class Springs(Term):
        "Springs that hold a boundary: the traction −k u."

        kind: str
        on: str
        k: Annotated[float, Ge(0), Unit("Pa/m")]

        def potential(self, at: Place) -> Any:
            import ufl

            return at.numbers["k"] / 2 * ufl.inner(at.u, at.u) * at.on(self.on)

Fields annotated with a unit are numbers of the model, which can be random; UFL finds derivatives by them and by the
displacement. A field called `on` is the name of a boundary. UFL is imported inside the
methods, so that a study can be checked without it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from forward.registry import Kinds, OfKind
from forward.scalars import numbers
from forward.settings import Named
from forward.words import settings


@dataclass(frozen=True)
class Place:
    """Where a load acts: the UFL expressions with which its potential or virtual work is written.

    Attributes
    ----------
    u
        Displacement (m).
    v
        Virtual displacement (m).
    F, J
        Deformation gradient I + ∇u and its determinant.
    X
        Place in the undeformed body (m).
    normal
        Outer unit normal of the undeformed boundary.
    dx
        Measure of the undeformed body.
    on
        Returns the measure of a named undeformed boundary.
    numbers
        The numbers of this load, by the names of its fields.
    density
        Factor of random fields on the density.
    constant
        Makes a constant (a number or a vector) for which forms need not be compiled again.
    """

    u: Any
    v: Any
    F: Any
    J: Any
    X: Any
    normal: Any
    dx: Any
    on: Callable[[str], Any]
    numbers: Mapping[str, Any]
    density: Any
    constant: Callable[[Any], Any]


class Term(Named):
    """A load: either its `potential` or its `virtual_work` is defined by every kind."""

    of_density: ClassVar[bool] = False  # whether it depends on the density of the body, which may be a random field

    def potential(self, at: Place) -> Any | None:
        """Return its potential energy (J), as a form of UFL; None where it has none.

        That of a dead force f is −∫ f·u.
        """
        return None

    def virtual_work(self, at: Place) -> Any:
        """Return the work (J) that a virtual displacement `at.v` does against it, as a form of UFL.

        That of a force f is −∫ f·v, as of a potential its derivative along v; loads that have one are not asked.
        """
        raise NotImplementedError

    @property
    def symmetric(self) -> bool:
        """Whether it leaves the stiffness symmetric, as a potential does."""
        return type(self).potential is not Term.potential

    def words(self, numbers: Mapping[str, str]) -> str:
        """Say what it is, for reports.

        Parameters
        ----------
        numbers
            Its numbers with their units, by the names of its fields.
        """
        return f"{self.label}: {settings(dict(self) | dict(numbers), 'kind', 'name')}"

    @property
    def values(self) -> dict[str, float]:
        """Its numbers, by the names of its fields."""
        return {name: getattr(self, name) for name in numbers(type(self))}


LOADS = Kinds(
    "load",
    {
        "gravity": "forward.terms.gravity:Gravity",
        "traction": "forward.terms.traction:Traction",
        "pressure": "forward.terms.pressure:Pressure",
    },
    Term,
)
Load = Annotated[Term, OfKind(LOADS)]
