"""What every load is: a block of settings that adds to the potential of a body, or to the virtual work done on it.

A load is a class, here or in a file beside a study (``kind = "my_tissue.Springs"``):

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

import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from forward.bodies.geometry import Body, Vector
from forward.findings import Finding
from forward.readable import settings
from forward.registry import Kinds, OfKind
from forward.scalars import Scalar, numbers
from forward.settings import Named
from forward.terms.acting import Acting


@dataclass(frozen=True)
class Since:
    """The increment of a load in which a body is, where friction depends on what it did: UFL expressions.

    Attributes
    ----------
    u
        Displacement (m) at the end of the increment before.
    share
        The part of the load by which it has grown since.
    shift
        What a tool has moved since (m) besides: along x, y, z and in depth, where these are numbers with steps.
    count
        How many increments there are.
    """

    u: Any
    share: Any
    shift: Any
    count: int


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
        Returns the measure of a named undeformed boundary, with a degree of quadrature if that of the body is too low.
    numbers
        The numbers of this load, by the names of its fields.
    density
        Factor of random fields on the density.
    constant
        Makes a constant (a number or a vector) for which forms need not be compiled again.
    ops
        Functions of expressions: sqrt, positive, ….
    modulus
        Returns E/(1 − ν²) (Pa) of the stiffest material of the body, with the constants as they are stated.
    bounds
        Smallest and largest coordinates (m) of the undeformed body along each axis.
    stiffer
        Factor on the stiffness of tools, which is raised where the body enters them too far.
    since
        The increment of the load; None where nothing depends on it.
    last
        Displacement (m) before the last step of Newton's method, and the whole of that step; None where no tool acts.
    left
        1 where that step was to press the body on this tool and has taken it off altogether, otherwise 0.
    """

    u: Any
    v: Any
    F: Any
    J: Any
    X: Any
    normal: Any
    dx: Any
    on: Callable[..., Any]
    numbers: Mapping[str, Any]
    density: Any
    constant: Callable[[Any], Any]
    ops: Any
    modulus: Callable[[], float]
    bounds: tuple[tuple[float, float], ...]
    stiffer: Any
    since: Since | None = None
    last: tuple[Any, Any] | None = None
    left: Any = 0.0


class Term(Named):
    """A load: either its `potential` or its `virtual_work` is defined by every kind."""

    of_density: ClassVar[bool] = False  # whether it depends on the density of the body, which may be a random field
    contact: ClassVar[bool] = False  # whether it acts only where the body touches it: load steps scale its `depth`
    written: ClassVar[bool] = True  # whether it is written as forms, so that it can be enriched and reduced

    def potential(self, at: Place) -> Any | None:
        """Return its potential energy (J), as a form of UFL; None where it has none.

        That of a dead force f is −∫ f·u.
        """
        return None

    def expected(self, at: Place, direction: Any) -> tuple[Any, Any]:
        """Return what it is like far from equilibrium, as two forms.

        They are its stiffness along a direction, without the curvature of the surface touched, and the virtual work
        of its linearised law at the gaps here, less its own: 0, unless the body has `left` it, which is then linearised
        at the gaps to which the last step was to lead. Only of loads that act in contact: pressures of states far from
        equilibrium are so large that their curvature makes the stiffness indefinite.
        """
        raise NotImplementedError

    def rubbing(self, at: Place) -> Any | None:
        """Return the virtual work of friction besides its potential, as a form of UFL; None without friction."""
        return None

    def rubbing_stiffness(self, at: Place, direction: Any) -> Any:
        """Return the symmetric stiffness of friction along a direction, at pressures and normals that stay.

        Only of loads with friction; by it stability is judged.
        """
        raise NotImplementedError

    def virtual_work(self, at: Place) -> Any:
        """Return the work (J) that a virtual displacement `at.v` does against it, as a form of UFL.

        That of a force f is −∫ f·v, as of a potential its derivative along v; loads that have one are not asked.
        """
        raise NotImplementedError

    def mistakes(self, body: Body, *, alone: bool) -> Iterator[tuple[str, str, Any]]:
        """Find what cannot be on a body: the field, what is wrong, what was given.

        The body has the boundary `on`; `alone`, nothing else acts on it or moves it.
        """
        return iter(())

    def findings(self, body: Body) -> Iterator[Finding]:
        """Find what may be wrong on a body before anything is solved."""
        return iter(())

    def findings_over(self, body: Body, ranges: Mapping[str, tuple[float, float]]) -> Iterator[Finding]:
        """Find what may be wrong where its numbers are parameters, from their ranges by name."""
        return iter(())

    def at_ends(self, ranges: Mapping[str, tuple[float, float]]) -> Iterator[tuple[dict[str, float], str]]:
        """Go through its numbers at the ends of ranges, in all combinations, with where that is in words."""
        stated = {name: scalar.value for name, scalar in self.scalars.items()}
        own = {name: ends for name, ends in ranges.items() if name in stated}
        for ends in itertools.product(*own.values()):
            moved = dict(zip(own, ends, strict=True))
            yield stated | moved, ", ".join(f"{name} = {value:.3g}" for name, value in moved.items())

    def holds(self, body: Body) -> list[tuple[Vector, Vector]]:
        """Return points (m) of the body and the directions in which it holds them, be it from one side only."""
        return []

    @property
    def symmetric(self) -> bool:
        """Whether it leaves the stiffness symmetric, as a potential does."""
        return type(self).potential is not Term.potential

    @property
    def remembers(self) -> bool:
        """Whether it depends on what earlier steps left, as friction does."""
        return self.contact and not self.symmetric

    @property
    def edged(self) -> bool:
        """Whether what it touches ends where it parts from the body, and not at an edge of the body."""
        return False

    def acting(self, equations: Any) -> Acting:
        """Return what it is on the nodes of a discrete body (`forward.fem.equations`); collective.

        Only of loads that are not `written` as forms.
        """
        raise NotImplementedError

    def words(self, numbers: Mapping[str, str]) -> str:
        """Say what it is, for reports; its numbers are given with their units, by the names of its fields."""
        return f"{self.label}: {settings(dict(self) | dict(numbers), 'kind', 'name')}"

    @property
    def scalars(self) -> dict[str, Scalar]:
        """Its numbers that can be parameters, by their names: those of its fields."""
        return {name: Scalar(getattr(self, name), type(self), name) for name in numbers(type(self))}


class Item(Term):
    """A load that is no form: `acting` is defined by every kind (`forward.terms.acting`).

    Its numbers are what they are at every fraction of the loads, which it is told. It acts on nodes of one mesh, so no
    error of the mesh is estimated with it, and it cannot be reduced.
    """

    written: ClassVar[bool] = False

    @property
    def symmetric(self) -> bool:
        return True


LOADS = Kinds(
    "load",
    {
        "gravity": "forward.terms.loads:Gravity",
        "traction": "forward.terms.loads:Traction",
        "pressure": "forward.terms.loads:Pressure",
        "spot": "forward.terms.loads:Spot",
        "indenter": "forward.terms.indenter:Indenter",
    },
    Term,
)
Load = Annotated[Term, OfKind(LOADS)]
