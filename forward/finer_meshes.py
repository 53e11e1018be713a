"""A body on finer meshes, as settings: how many cells there are, and where they are smaller.

Cells are smaller everywhere, and smaller still at the faces that are held, where stresses are singular along the rim: a
mesh that is refined equally shares most of the error there. Finer meshes are quadratic, with as many nodes where the
body is linear, and never coarser than a few cells: the differences of linear or very coarse meshes tell neither how
fast the error falls nor what is left of it (docs/decisions/0017-mesh-error.md). Where a tool touches a body cells are
halved, and graded as those of the body: the edge of the contact may be anywhere. Errors change their sign there as that
edge passes lines of nodes, so that two meshes show no order: nothing is extrapolated. The coarser of them has 1.5 times
the body's cells along edges: what two fine meshes differ by is of the size of their errors, where the body itself may
have one cell in contact, or agree with one of them by chance. A mesh that does not contain the vertices of a random
field has another field: cells of boxes and blocks with fields are divided, and again at the rims of what is held
(`forward.bodies.tetrahedra`).
"""

from __future__ import annotations

from typing import Any

from forward.bodies.random_fields import RandomField
from forward.bodies.tetrahedra import RATIO, layers_of, within
from forward.loaded import LoadedBody
from forward.model import ModelError
from forward.specimen import Specimen

AnyBody = LoadedBody | Specimen
TIMES = 1.5  # cells along an edge, over those of the body
LEAST = {TIMES: 5, 1.0: 3}  # cells along an edge of the finer and of the coarser mesh
OF_EQUAL = 1.6  # order with which errors fall where cells are not graded towards what causes them
OF_LINEAR = 0.1  # what quadratic cells of the same size still miss, over what they add to linear ones
QUADRATIC = {"degree": 2, "quadrature_degree": None}
HELD, BESIDE = 8.0, 4.0  # grading at the faces that are held, and at those that meet them in a rim
FEWEST = 6  # cells along an edge of finer meshes of fields
# Where all cells are halved, errors at held faces fall slowly, whatever the degree: 1/(2^1.6 − 1).
HALVED = 0.5


def finer(spec: AnyBody) -> Any:
    """Return a body on a finer mesh, with fields of values at the vertices in place of its random fields.

    Raises
    ------
    ModelError
        If there is none, with the reason.
    """
    return on_mesh(spec, TIMES)


def graded(spec: AnyBody) -> Any | None:
    """Return a body on a mesh that is graded as the finer one; None where it is graded so, or is not graded."""
    if not spec.body.structured or (spec.fields and _touched(spec)):
        return None
    if spec.fields and _parts(spec.body) == 1 and not _layers(spec):
        return None
    found = on_mesh(spec, 1.0)
    return None if found.body == spec.body else found


def share(spec: AnyBody) -> float:
    """Return what the finer mesh still misses, over its difference from the coarser one; 0 where no order is known."""
    if _touched(spec):
        return 0.0
    if not spec.body.structured:
        return OF_LINEAR if spec.body.degree == 1 else HALVED
    if spec.fields:
        layers = _layers(spec)
        if _parts(spec.body) == 2:
            return 1 / (2**3 - 1)
        return 1 / (RATIO ** (-OF_EQUAL * layers) - 1) if layers else OF_LINEAR
    fine, coarse = finer(spec).body, (graded(spec) or spec).body
    times = (fine.cell_count / coarse.cell_count) ** (1 / 3)
    # Displacements converge like h^(degree + 1) where meshes are graded as singular stresses want it.
    return float(1 / (times ** (fine.degree + 1) - 1))


def held(spec: AnyBody) -> tuple[str, ...]:
    """Return the boundaries where a body is held, in any load case: by planes of symmetry and rollers it is not."""
    moved = [item.on for case in spec.cases for item in case.displacements if len(item.components) > 1]
    return tuple(dict.fromkeys([*(face for case in spec.cases for face in case.clamp), *moved]))


def counted(spec: Any) -> bool:
    """Whether it was counted how often intervals of fields of such a body hold: quadratic hexahedra, no tools."""
    body = spec.body
    return body.structured and (body.cell, body.degree) == ("hexahedron", 2) and not _touched(spec)


def _parts(body: Any) -> int:
    """Into how many parts edges of cells are divided where there are fields; linear cells become quadratic first."""
    return 1 if body.degree == 1 and min(body.cells) >= FEWEST else 2


def _layers(spec: AnyBody) -> int:
    """Return how often cells at rims are divided at least, where they are, on finer meshes of fields."""
    body: Any = spec.body
    return min((n for n in layers_of(body, _parts(body)) if n), default=0) if held(spec) else 0


def _touched(spec: AnyBody) -> bool:
    """Whether a tool is pressed against the body, in any load case."""
    return any(load.contact for case in spec.cases for load in case.loads)


def on_mesh(spec: AnyBody, times: float, *, thin: bool = True) -> Any:
    """Return a body on a mesh of `times` as many cells along its edges, with `thin` ones at the faces that are held."""
    if not hasattr(spec, "body"):
        raise ModelError(f"a model of kind '{spec.kind}' has no body that could be meshed again")
    body: Any = spec.body
    linear = body.degree == 1
    if not body.structured and linear:
        body = body.model_validate(body.model_dump(exclude={"contents"}) | QUADRATIC)
    elif not body.structured:
        body = body.finer(times, held(spec), HELD, BESIDE)
    elif spec.fields and (_touched(spec) or not thin):
        body = body.with_cells(2.0) if times > 1 else body
    elif spec.fields:
        most, here = _parts(body), _parts(body) if times > 1 else 1
        layers = layers_of(body, most) if most > 1 or times > 1 else (0, 0, 0)
        quadratic = body.model_validate(body.model_dump() | QUADRATIC) if linear else body
        body = within(quadratic, here, held(spec), layers)
    else:
        if _touched(spec):  # the edge of the contact decides, wherever that is
            body = body.with_cells((2.0 if times > 1 else TIMES) / (2 if linear else 1))
        elif not thin:
            body = body.with_cells(times / 2 if linear else times)
        else:
            body = body.finer(times / 2 if linear else times, held(spec), HELD, BESIDE)
        cells = {"cells": tuple(max(n, LEAST[times]) for n in body.cells)}
        body = body.model_validate(body.model_dump() | cells | (QUADRATIC if linear else {}))
    of = dict.fromkeys(one.of for one in spec.fields)
    fields = tuple(RandomField(of=what, length=1.0, std=1.0, basis="nodes") for what in of)
    # Linear cells have displacements only, quadratic ones pressures too where they need them.
    found = spec.model_copy(update={"body": body, "fields": fields, **({"formulation": "auto"} if linear else {})})
    return found.model_copy(update={"observed": ()} if hasattr(spec, "observed") else {"adapt": None})
