"""Which unknowns a body needs: displacements alone lock where a change of volume costs much more than one of shape.

What decides is κ/μ at rest over the whole range of the inputs, of the body and of each of its regions. Inclusions,
contrasts and random fields multiply both moduli, and do not matter. One formulation serves a whole study: switching
between samples would be a jump of their outputs.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np

from forward.findings import Finding
from forward.materials.admissible import Materials, admissible, moduli
from forward.materials.material import splits
from forward.scalars import Ranges

Formulation = Literal["displacement", "mixed", "auto"]

# κ/μ above which "auto" takes the mixed form (ν = 0.35). There the two forms differ by 0.5 to 1 % on the meshes of
# `python -m benchmarks locking`; at 5 by up to 2 %, at 10 by 6 %, at 50 by 20 %.
SWITCH = 3.0
WORTH_A_WARNING = 1.05  # times too stiff

# How many times too stiff the displacement form is on the meshes of that benchmark, against the mixed form on the same
# mesh (degree 2), or against itself at κ/μ = 1, where nothing locks (degree 1). The force on the pressed block of
# linear hexahedra at 10⁴ is extrapolated: Newton's method finds no equilibrium there.
_RATIOS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 1e2, 1e3, 1e4)
_CANTILEVER = {
    ("tetrahedron", 1): (1.0, 1.07, 1.35, 1.79, 2.56, 4.33, 6.34, 12.4, 14.0),
    ("hexahedron", 1): (1.0, 1.02, 1.10, 1.21, 1.35, 1.59, 1.84, 3.74, 11.7),
    ("tetrahedron", 2): (1.001, 1.002, 1.008, 1.017, 1.024, 1.036, 1.043, 1.054, 1.055),
    ("hexahedron", 2): (1.001, 1.004, 1.014, 1.026, 1.037, 1.051, 1.059, 1.067, 1.068),
}
_COOK = {
    ("tetrahedron", 1): (1.0, 1.02, 1.13, 1.28, 1.47, 1.74, 1.91, 2.20, 2.26),
    ("hexahedron", 1): (1.0, 1.01, 1.08, 1.18, 1.35, 1.70, 2.02, 2.87, 3.07),
    ("tetrahedron", 2): (1.001, 1.003, 1.008, 1.015, 1.024, 1.039, 1.051, 1.081, 1.094),
    ("hexahedron", 2): (1.001, 1.002, 1.007, 1.014, 1.023, 1.034, 1.042, 1.064, 1.076),
}
_BLOCK = {
    ("tetrahedron", 1): (1.0, 1.05, 1.22, 1.49, 2.00, 3.46, 5.86, 47.4, 447.0),
    ("hexahedron", 1): (1.0, 1.03, 1.16, 1.38, 1.82, 3.17, 5.42, 45.9, 450.0),
    ("tetrahedron", 2): (1.0, 1.002, 1.015, 1.036, 1.069, 1.126, 1.170, 1.233, 1.24),
    ("hexahedron", 2): (1.0, 1.002, 1.021, 1.055, 1.111, 1.208, 1.291, 1.488, 1.528),
}


class Decision(NamedTuple):
    """The formulation of a body over a range of inputs, and why.

    Attributes
    ----------
    mixed
        Whether pressures are unknowns.
    lowest, highest
        κ/μ over the range; infinite where μ may be as small as one likes.
    why
        In words.
    """

    mixed: bool
    lowest: float
    highest: float
    why: str


def ratios(materials: Materials, ranges: Ranges) -> tuple[float, float]:
    """Return the smallest and the largest κ/μ over ranges.

    Both moduli are linear in each constant, so that their ratio is largest at a corner of the box of the constants.
    Corners that are of no material are left out; where μ vanishes between them the ratio has no bound.
    """
    found, unbounded = [], False
    for place, own in materials.constants.items():
        varied = materials.varied[place]
        ends = [ranges[path] for path in varied.values()]
        for corner in itertools.product(*ends):
            values = {**own, **dict(zip(varied, corner, strict=True))}
            mu, kappa = moduli(materials.energy, values)
            unbounded = unbounded or mu <= 0
            if admissible(materials.energy, values):
                found.append(float(kappa / mu))
    if not found:
        return np.nan, np.inf
    return min(found), np.inf if unbounded else max(found)


def decide(formulation: Formulation, degree: int, materials: Materials, ranges: Ranges) -> Decision:
    """Return the formulation that is taken, of cells of a degree."""
    low, high = ratios(materials, ranges)
    seen = f"κ/μ = {_number(high)}" if low == high else f"κ/μ from {_number(low)} to {_number(high)} over the inputs"
    if formulation != "auto":
        return Decision(formulation == "mixed", low, high, f"as the study says; {seen}")
    if not high > SWITCH:
        return Decision(False, low, high, f"{seen}, nowhere above {SWITCH:g}")
    if degree < 2:
        return Decision(False, low, high, f"{seen}, but cells of degree 1 have no stable mixed form")
    if not splits(materials.energy):
        return Decision(False, low, high, f"{seen}, but '{materials.energy}' has no part of the volume alone")
    return Decision(True, low, high, f"{seen}, above {SWITCH:g}")


def of_locking(decision: Decision, cell: str, degree: int, materials: Materials) -> Iterator[Finding]:
    """Say what locking does to a body of displacements alone, by the table; a warning from 5 % on."""
    if decision.mixed or not decision.highest > SWITCH:
        return
    high = decision.highest
    sizes = [
        float(np.exp(np.interp(np.log(high), np.log(_RATIOS), np.log(table[cell, degree]))))
        for table in (_CANTILEVER, _COOK, _BLOCK)
    ]
    cells = f"{'linear' if degree == 1 else 'quadratic'} {'tetrahedra' if cell == 'tetrahedron' else 'hexahedra'}"
    where = f"κ/μ up to {_number(high)}" if decision.lowest != high else f"κ/μ = {_number(high)}"
    if degree < 2 and not splits(materials.energy):
        cure = "body.degree = 2, and an energy with a constant D1"
    elif degree < 2:
        cure = "body.degree = 2"
    elif splits(materials.energy):
        cure = 'formulation = "mixed" or "auto"'
    else:
        cure = "an energy with a constant D1, which has a mixed form"
    times = " and ".join([", ".join(f"{size:.3g}" for size in sizes[:2]), f"{sizes[2]:.3g}"])
    values = {"cells": cells, "where": where, "times": times, "cure": cure}
    yield Finding("locking", "warning" if max(sizes) >= WORTH_A_WARNING else "note", values)


def _number(ratio: float) -> str:
    return "infinity" if np.isinf(ratio) else f"{ratio:.3g}"
