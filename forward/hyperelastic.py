"""The specification of a hyperelastic body under loads; no FEniCSx until built."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Literal

from forward.bodies.in_words import in_words
from forward.loaded import LoadedBody
from forward.model import FloatArray, ModelError
from forward.registry import named
from forward.spec import UNREFINED


class Hyperelastic(LoadedBody):
    """A hyperelastic body under loads, solved by finite elements.

    Parameters
    ----------
    body
        Geometry and mesh.
    material
        Strain energy and its constants.
    regions
        Numbers of named regions of the mesh: constants of the material, which replace those of `material`,
        and `contrast`, by which the energy density is multiplied: ``{ tumour = { contrast = 9 } }``.
    inclusions
        Balls that are stiffer or softer: their factors multiply the energy density.
    fields
        Random fields that multiply the stiffness or the density.
    solver
        Path, tolerance and limits of the solver; a word stands for its kind, `solver = "newton"`.
    formulation
        Unknowns: "displacement", or "mixed" with pressures, which nearly incompressible bodies need (quadratic cells,
        and a material with a constant D1 or a stated volumetric part). "auto" is mixed where that is possible and κ/μ
        may be above 3: for some values of the inputs in a study, otherwise for the constants as given.
    clamp
        Boundaries that do not move.
    displacements
        Boundaries with components that are moved by a given amount. Where boundaries share an edge, clamps take
        precedence, then later entries over earlier ones.
    loads
        Gravity, tractions and pressures.
    outputs
        What is computed from the deformed body.
    adapt
        Whether the mesh is refined first, and until when; tetrahedra only, in studies that sample.
    stresses
        Whether results hold stresses and strains too, at the mean of the inputs.
    """

    kind: Literal["hyperelastic"] = "hyperelastic"

    def adapted(self, comm: Any, parameters: tuple[str, ...], point: FloatArray, say: Callable[[str], None]) -> Any:
        """Refine the mesh at a point (d,) of parameters by their paths, as `forward.fem.adapt` does; collective."""
        return named("forward.fem.adapt:adapt")(self, comm, parameters, point, say)

    def words(self, said: Callable[[str], str], where: str = "") -> Iterator[tuple[str, list[str]]]:
        """Say for a report what was solved."""
        yield from in_words(self, said, where)

    def build(self, comm: Any, parameters: tuple[str, ...]) -> Any:
        """Mesh the body and compile the forms on a communicator; collective.

        Parameters
        ----------
        comm
            mpi4py communicator of the ranks that share the model.
        parameters
            Paths of the numbers that the model's parameter vector holds; the others keep their values. Coefficients of
            random fields that it does not hold are zero.

        Raises
        ------
        ModelError
            If its mesh is to be refined first.
        """
        if self.unrefined:
            message = f"model.adapt: {UNREFINED}"
            raise ModelError(message)
        alone = "path:built" if self.stepped else "model:HyperelasticModel"
        model = "history:HistoryModel" if self.frictional else alone
        return named(f"forward.fem.{model}")(self, comm, parameters)
