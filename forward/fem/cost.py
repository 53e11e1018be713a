"""What a body costs: memory and processor time of its factorisations, solves and derivatives, before it is built.

Entries and operations of a factor follow from nested dissection of the lattice of nodes: A. George, SIAM J. Numer.
Anal. 10 (1973) 345–363. A box is cut across its longest direction by a layer of nodes, and so on; a layer of s unknowns
that borders on r others (of the layers before it) takes s³/3 + s²r + sr² operations and s²/2 + sr entries. The
constants turn them into those of MUMPS with an ordering of its choice. Times are of one core of a 2.8 GHz processor,
with the counts of iterations of a block and of a beam that bends far (`python -m benchmarks predictions`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from functools import cache
from typing import TYPE_CHECKING, TypeVar

from forward.machine import MIB

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    from forward.bodies.geometry import Body

ENTRIES = 1.4  # of MUMPS over those of the model
OPERATIONS = 1.6
# Displacements coupled with each one, on average, inside a large body; here and below by the degree, from 1.
ROW = {"hexahedron": (81.0, 192.0, 380.0, 700.0), "tetrahedron": (45.0, 84.0, 140.0, 220.0)}
SMALLEST = 3.0  # nodes across a part of the lattice that is not cut further
BYTES_PER_ENTRY = 18.0  # of the working memory of a factorisation, including room for pivoting
BYTES_PER_NONZERO = 16.0  # of the matrix
BYTES_PER_UNKNOWN = 3e3  # mesh, spaces, vectors
SPARE = 64 * MIB  # for allocations of libraries that do not check
BYTES_OF_PROGRAM = 2.5e8  # Python with all libraries
ADDRESSES_OF_PROGRAM = 8e8  # the same in addresses, most of which are never touched
# Processor times (s).
ASSEMBLY = {"hexahedron": (1.4e-5, 2.4e-4, 1.7e-3, 1.1e-2), "tetrahedron": (2.9e-6, 2.3e-5, 1.1e-4, 5e-4)}
RESIDUAL = {"hexahedron": (1.2e-6, 5e-6, 1.3e-5, 3.5e-5), "tetrahedron": (2e-7, 8e-7, 2e-6, 5e-6)}
HIGHEST = 4  # degree of these; of higher ones they are taken
OF_PRESSURES = 1.25  # of an assembly with pressures over one without
PER_ENTRY, PER_OPERATION = 1.6e-8, 4.4e-11  # of a factorisation
PER_NONZERO = 6e-8  # of the matrix and the analysis before the first factorisation
PER_ENTRY_SOLVED = 2e-9  # of a back-substitution
TOGETHER = 0.65  # of a back-substitution for one of many right-hand sides over one alone
IN_LOCKSTEP = 0.25  # the same where samples are corrected together, with sides that are all there at once
START = 1.4  # of the program, with all that it imports
COMPILATION = 6.0  # of the forms of a body that are not compiled yet, one second each
REPORT = 2.3  # of results and their report
CALL = 2e-4  # of any of these on a vanishingly small body
# Counts, in bodies that are slender (and turn as they bend) and in others.
SLENDER = 3.0  # longest extent over the shortest
NEWTON = {True: 5.5, False: 4.0}  # factorisations from zero
CORRECTIONS = {True: 10, False: 7}  # with a reference factor
# The same where tools touch the body: the depth is reached in steps, and the area in contact changes meanwhile.
NEWTON_IN_CONTACT, CORRECTIONS_IN_CONTACT = 22, 35
ACTIONS = 7  # products with the stiffness for the screen of a sample, each like a residual
DIRECTIONS = 6  # of parameters, at most, for the vectors of the screen
CHANGES = 40  # products with the stiffness for each of these, each like a residual
SUBSTITUTIONS = 12  # for the natural modes, and as many for each direction
MOST_BYTES = 4e9  # of factors for estimates, where there is another way
FEW, NEAR = 4, 8  # derivatives of a sample up to which no factor is made, and the corrections needed then


# Points that are corrected together (docs/decisions/0028-lockstep.md).
MOST_TOGETHER, BYTES_TOGETHER = 32, 2**29  # points, and what they hold: vectors of unknowns
HELD = 28  # by each: what Anderson mixing remembers, guess, state, residuals, rotations


# Linear systems by conjugate gradients with two levels (`forward.solvers.multigrid`).
PER_PRODUCT = 1.5e-9  # of the matrix times a vector, for each non-zero
BYTES_PER_ENTRY_IN_BLOCKS = 9.0  # of the matrix
PRODUCTS = 5.5  # an iteration, without the coarse level
BOUNDING = 13  # products for the bound of the eigenvalues
ROUGHLY_SOLVED = {True: 9, False: 6}  # iterations of a step of Newton's method, in bodies that are slender and others
SOLVED = {True: 24, False: 16}  # of a derivative
LANCZOS = 16  # to know that a state is stable
COARSE = 0.5  # of an assembly, for the coarse level
NEWTON_FROM_PREDICTION = 3
SINGLE_FROM = 5e7  # bytes of a reference's factor, from which on one in single precision takes less time too
WORTH, DERIVATIVES = 0.7, 4  # times a first solve and so many derivatives with factors, below which none are made


class Linear(StrEnum):
    """What linear systems are solved with."""

    FACTOR = "factor"
    BOTH = "both"
    MULTIGRID = "multigrid"


@dataclass(frozen=True)
class Factor:
    """The factor of a stiffness: its entries, its operations, and the non-zeros of the matrix."""

    entries: float
    operations: float
    nonzeros: float

    @property
    def bytes(self) -> float:
        """Memory during and after factorisation, with that of the matrix."""
        return BYTES_PER_ENTRY * self.entries + BYTES_PER_NONZERO * self.nonzeros


@dataclass(frozen=True)
class Times:
    """Predicted processor times (s) of solves of a body, on one core.

    Attributes
    ----------
    assembly, residual
        Of the stiffness and of the forces out of balance.
    setup
        Of the matrix and its analysis, which one solver needs once.
    factorisation, substitution
        Of one factor, and of one right-hand side with it.
    slender
        Whether the body is.
    predicted
        Whether samples are solved from predictions rather than by the textbook solver.
    contact
        Whether tools touch it: what they touch changes at every step.
    bytes
        Memory of mesh, matrices and factors.
    linear
        What linear systems are solved with.
    stepping
        A step of Newton's method, without assembly: a factor and a back-substitution, or what takes their place.
    counting
        Finding out whether a state is stable, once its stiffness is prepared.
    deriving
        One derivative of a solution whose stiffness is prepared.
    """

    assembly: float
    residual: float
    setup: float
    factorisation: float
    substitution: float
    slender: bool
    predicted: bool = True
    bytes: float = 0.0
    contact: bool = False
    linear: Linear = Linear.FACTOR
    stepping: float = 0.0
    counting: float = 0.0
    deriving: float = 0.0

    @property
    def sample(self) -> float:
        """A sample without derivatives."""
        return self.corrected if self.predicted else self.textbook

    @property
    def textbook(self) -> float:
        """A solve by Newton's method from zero."""
        count = NEWTON_IN_CONTACT if self.contact else NEWTON[self.slender]
        return count * self._newton_step + self.counting

    @property
    def _newton_step(self) -> float:
        return self.assembly + self.stepping + 2 * self.residual

    @property
    def first(self) -> float:
        """The first solve."""
        return self.setup + self.textbook

    @property
    def corrected(self) -> float:
        """A solve from a prediction with the factor of a reference, and the screen of its stability."""
        if self.linear == Linear.MULTIGRID:  # Newton's method; the last step is for the test
            return NEWTON_FROM_PREDICTION * self._newton_step + self.counting
        if self.contact:  # every other sample takes a factor of its own
            more = (self.assembly + self.factorisation) / 2 + CORRECTIONS_IN_CONTACT * self.residual
            return more + CORRECTIONS_IN_CONTACT * (self.substitution + self.residual)
        corrections = CORRECTIONS[self.slender]
        return (corrections + 2) * self.substitution + (corrections + ACTIONS) * self.residual

    def in_company(self, count: int) -> float:
        """A sample of `count` that are corrected together, with one pass through the factor for all of them."""
        if not self.predicted or self.contact or self.linear == Linear.MULTIGRID:
            return self.sample
        saved = (1 - 1 / max(count, 1)) * (1 - IN_LOCKSTEP) * self.substitution
        return self.sample - (CORRECTIONS[self.slender] + 2) * saved

    def reference_factor(self, parameters: int) -> float:
        """The factor of a reference, and the vectors for the screen of stability."""
        if self.linear == Linear.MULTIGRID:
            return 0.0
        directions = min(parameters, DIRECTIONS)
        vectors = CHANGES * directions * self.residual + SUBSTITUTIONS * (1 + directions) * self.substitution
        return self.setup + self.assembly + self.factorisation + vectors

    def tangents(self, parameters: int) -> float:
        """All derivatives of outputs and state of a solution whose factor is available."""
        return 15 * CALL + parameters * (self.deriving + self.residual)

    def tangents_of_sample(self, parameters: int) -> float:
        """All derivatives of the outputs of a solution that was found with the factor of a reference."""
        if self.linear == Linear.MULTIGRID:
            return self.tangents(parameters)
        if parameters > FEW:
            return self.assembly + self.stepping + self.tangents(parameters)
        return NEAR * parameters * (self.substitution + self.residual)


def times(
    body: Body,
    *,
    mixed: bool,
    symmetric: bool = True,
    predicted: bool = True,
    factors: int = 1,
    contact: bool = False,
    linear: Linear = Linear.FACTOR,
) -> Times:
    """Predict the cost of solves of a body, with a given number of factors; `contact` as of `Times`.

    If the stiffness is not symmetric, each comes with a factor of the symmetric part, for the stability test.
    """
    extents = [high - low for low, high in body.bounds]
    more, degree = OF_PRESSURES if mixed else 1.0, min(body.degree, HIGHEST) - 1
    slender = max(extents) > SLENDER * min(extents)
    found = factor(body, mixed=mixed, symmetric=symmetric)
    size = found.bytes if symmetric else found.bytes + factor(body, mixed=mixed).bytes
    assembly = CALL + more * ASSEMBLY[body.cell][degree] * body.cell_count
    setup = CALL + PER_NONZERO * found.nonzeros
    factorisation = CALL + PER_ENTRY * found.entries + PER_OPERATION * found.operations
    substitution = CALL + PER_ENTRY_SOLVED * found.entries
    stepping, counting, deriving = factorisation + substitution, 0.0, 2 * TOGETHER * substitution
    if linear != Linear.FACTOR:
        below = factor(body.model_copy(update={"degree": 1}), mixed=False, symmetric=symmetric)
        of_coarse = CALL + PER_NONZERO * below.nonzeros + PER_ENTRY * below.entries + PER_OPERATION * below.operations
        product = CALL + PER_PRODUCT * found.nonzeros
        iteration = PRODUCTS * product + CALL + PER_ENTRY_SOLVED * below.entries
        preparing = COARSE * assembly + of_coarse + BOUNDING * product
        stepping, counting = preparing + ROUGHLY_SOLVED[slender] * iteration, LANCZOS * iteration
        deriving = SOLVED[slender] * iteration
        own = BYTES_PER_ENTRY_IN_BLOCKS * found.nonzeros + below.bytes
        size = own + (factors - 1) * size if linear == Linear.BOTH else own
        factors = 1
        if linear == Linear.MULTIGRID:
            setup, factorisation, substitution = CALL, stepping, iteration
    return Times(
        assembly,
        CALL + RESIDUAL[body.cell][degree] * body.cell_count,
        setup,
        factorisation,
        substitution,
        slender,
        predicted,
        BYTES_PER_UNKNOWN * (3 * body.nodes + (body.vertex_count if mixed else 0)) + factors * size,
        contact,
        linear,
        stepping,
        counting,
        deriving,
    )


def linear_solver(body: Body, *, symmetric: bool) -> Linear:
    """Choose what linear systems of displacements are solved with, by sizes only.

    Both, where a first solve and a few derivatives take much less time than with factors; no factor of the whole
    stiffness at all, where one takes more than `MOST_BYTES`.
    """
    if body.degree < 2:
        return Linear.FACTOR  # there is no coarser space
    if factor(body, mixed=False, symmetric=symmetric).bytes > MOST_BYTES:
        return Linear.MULTIGRID
    seconds = {}
    for linear in (Linear.FACTOR, Linear.BOTH):
        cost = times(body, mixed=False, symmetric=symmetric, linear=linear)
        seconds[linear] = cost.textbook + DERIVATIVES * cost.deriving
    return Linear.BOTH if seconds[Linear.BOTH] < WORTH * seconds[Linear.FACTOR] else Linear.FACTOR


def together(unknowns: int) -> int:
    """How many points of a body are corrected together: no more than there is memory for."""
    return min(max(BYTES_TOGETHER // (8 * HELD * unknowns), 1), MOST_TOGETHER)


Summed = TypeVar("Summed", bound="DataclassInstance")


def sum_of(parts: Sequence[Summed]) -> Summed:
    """Predict the cost of several bodies that are solved one after the other."""
    totals = {f.name: sum(getattr(part, f.name) for part in parts) for f in fields(parts[0]) if f.type == "float"}
    return replace(parts[0], **totals)


def factor(body: Body, *, mixed: bool, symmetric: bool = True) -> Factor:
    """Predict the factor of a body's stiffness: LDLᵀ or, without symmetry, LU, which is two triangles."""
    triangles = 1 if symmetric else 2
    cells = getattr(body, "cells", None)
    if cells is not None:
        lattice = [body.degree * n + 1.0 for n in cells]
    else:  # as many nodes, spread evenly over a box around them
        extents = [high - low for low, high in body.bounds]
        spacing = (math.prod(extents) / body.nodes) ** (1 / 3)
        lattice = [max(extent / spacing, 1.0) for extent in extents]
    pressures = body.vertex_count / body.nodes if mixed else 0.0
    operations, entries = _dissected(tuple(sorted(lattice)), (0, 0, 0), 3 + pressures)
    return Factor(
        triangles * ENTRIES * entries,
        triangles * OPERATIONS * operations,
        ROW[body.cell][min(body.degree, HIGHEST) - 1] * 3 * body.nodes * (1 + pressures / 3) ** 2,
    )


@cache
def _dissected(size: tuple[float, ...], borders: tuple[int, ...], dofs: float) -> tuple[float, float]:
    """Operations and entries of a part of the lattice; `borders` says how many of its ends are layers before it."""

    def area(axis: int) -> float:
        return math.prod(size) / size[axis]

    longest = max(range(3), key=lambda axis: size[axis])
    r = dofs * sum(borders[axis] * area(axis) for axis in range(3))
    whole = size[longest] <= SMALLEST
    s = dofs * (math.prod(size) if whole else area(longest))
    operations, entries = s**3 / 3 + s**2 * r + s * r**2, s**2 / 2 + s * r
    if not whole:
        half = tuple((n - 1) / 2 if axis == longest else n for axis, n in enumerate(size))
        for ends in ((borders[longest] + 1) // 2, borders[longest] // 2):  # of the two halves, beside the new layer
            inside = tuple(ends + 1 if axis == longest else n for axis, n in enumerate(borders))
            more = _dissected(half, inside, dofs)
            operations, entries = operations + more[0], entries + more[1]
    return operations, entries
