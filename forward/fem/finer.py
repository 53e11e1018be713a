"""A specimen on a finer mesh: the error of its own mesh in the observations.

Cells are smaller everywhere, and smaller still at the held faces, where stresses are singular along the rim: a
uniformly refined mesh has most of the same error there. Random fields are those of the mesh itself, interpolated. One
solve gives the difference; it underestimates the error, since the finer mesh has an error too.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from forward.bodies.location import locate, shapes
from forward.bodies.random_fields import RandomField
from forward.model import FloatArray, ModelError

if TYPE_CHECKING:
    from forward.fem.specimen import SpecimenModel
    from forward.specimen import Specimen

TIMES = 1.5  # cells along an edge, over those of the specimen
# Of the error of configs/inclusion.toml at 120 points, relative to 14³ graded cells, this mesh shows 83 %; without the
# grading of the adjacent faces 66 %, and 10³ equal cells 53 %.
HELD, BESIDE = 8.0, 4.0  # grading at the held faces, and at those that meet them in a rim
VTK_TO_TENSOR = [0, 1, 3, 2, 4, 5, 7, 6]  # corners of a hexahedron, x first


def finer(spec: Specimen) -> Specimen:
    """Return a specimen on a finer mesh, with one field of values at the vertices in place of those on its stiffness.

    Raises
    ------
    ModelError
        If it has none, with the reason.
    """
    if any(field.of != "stiffness" for field in spec.fields):
        raise ModelError("its density is a random field")
    held = [face for case in spec.cases for face in (*case.clamp, *(item.on for item in case.displacements))]
    body = spec.body.finer(TIMES, tuple(dict.fromkeys(held)), HELD, BESIDE)
    fields = (RandomField(of="stiffness", length=1.0, std=1.0, basis="nodes"),) if spec.fields else ()
    return spec.model_copy(update={"body": body, "fields": fields, "observed": ()})


class FinerMesh:
    """Outputs of a specimen on a finer mesh.

    Parameters
    ----------
    model
        The specimen.

    Raises
    ------
    ModelError
        If there is no finer mesh of it.
    """

    def __init__(self, model: SpecimenModel) -> None:
        self.spec = finer(model.spec)
        self._coarse = model

    @cached_property
    def _model(self) -> SpecimenModel:
        numbers = tuple(self._coarse.parameters[i] for i in self._scalars)
        comm = self._coarse.models[0].equations.comm
        model: SpecimenModel = self.spec.build(comm, (*numbers, *self.spec.coefficients))
        return model

    @cached_property
    def _scalars(self) -> list[int]:
        """Positions of the parameters that are not coefficients of fields."""
        return [i for i, path in enumerate(self._coarse.parameters) if path in self.spec.scalars]

    @cached_property
    def _interpolation(self) -> tuple[NDArray[np.int64], FloatArray]:
        """Vertices (n, k) of the specimen's mesh around each vertex of the finer one, and weights (n, k)."""
        vertices = self._coarse.vertices
        cells, _ = vertices.cells()
        if cells.shape[1] == 8:
            cells = cells[:, VTK_TO_TENSOR]
        found = locate(vertices.coordinates[cells], self._model.vertices.coordinates)
        return cells[found.cells], shapes(found.local, cells.shape[1])

    def outputs(self, observed: SpecimenModel, point: FloatArray) -> FloatArray:
        """Solve at parameters (d,) of the specimen, and return the observations; collective.

        Raises
        ------
        SolveError
            If there is no answer.
        ValueError
            If a place is far from the mesh.
        """
        values = point[self._scalars]
        if self.spec.fields:
            log = self._coarse.log_fields(point[None])[0]
            around, weights = self._interpolation
            (field,) = self.spec.fields
            values = np.concatenate([values, (weights * log[around]).sum(axis=1) - field.on(self.spec.body).offset])
        model = self._model.observing(observed.places, observed.axes.tolist(), observed.cases.tolist())
        return np.array(model.solve(values).outputs)
