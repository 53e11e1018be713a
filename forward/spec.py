"""What a study asks of a model before it is built: the base of every block `[model]`, and the kinds of models.

A specification needs no FEniCSx. Your own kind is a subclass in a module beside the study or in an installed package
(`forward.registry`): it states its numbers and outputs, and `build` makes the model.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, Protocol, Self

from pydantic import model_validator

from forward.model import FloatArray, ForwardModel, ModelError
from forward.readable import named
from forward.registry import Kinds, OfKind
from forward.scalars import Mistake, Ranges, Scalar, refuse
from forward.settings import Settings

if TYPE_CHECKING:
    from forward.bodies.mesh import Contents
    from forward.fem.cost import Times as Times  # noqa: PLC0414 - methods know it from here
    from forward.fem.mesh_error_cost import Estimate
    from forward.findings import Finding
    from forward.materials.admissible import Materials

UNREFINED = (
    "meshes are refined by studies that sample a model; run one, and name the mesh that it leaves: "
    "body = { kind = 'mesh', file = 'DIR/mesh.npz' }"
)


class NamedOutput(Protocol):
    """What a specification says about an output."""

    @property
    def name(self) -> str:
        """Its name."""

    @property
    def unit(self) -> str:
        """SI unit of its value; "1" for ratios."""


class PlainOutput(NamedTuple):
    """An output of which no more is known than this; the last two as of `forward.observables.observable`."""

    name: str
    unit: str
    estimable: bool = True
    negative: bool = True


class ModelSpec(Settings):
    """A model as a study describes it. Whatever is not abstract is right for a map from numbers to numbers.

    Attributes
    ----------
    meshed
        Whether its state lives on a mesh that `refined` can refine.
    iterative
        Whether a solve can be stopped after some iterations.
    shareable
        Whether several ranks can work on one solve.
    placed
        Whether data tell where it is observed: displacements at places, in load cases. Of others outputs are measured.
    """

    meshed: ClassVar[bool] = False
    iterative: ClassVar[bool] = False
    shareable: ClassVar[bool] = False
    placed: ClassVar[bool] = False

    if TYPE_CHECKING:  # fields or properties, as the kind has them

        @property
        def kind(self) -> str:
            """Its kind, as in the study."""

        @property
        def outputs(self) -> Sequence[NamedOutput]:
            """What is computed: names and units."""

    @property
    def returned(self) -> Sequence[NamedOutput]:
        """What the model returns: its outputs, unless there are several of each."""
        return self.outputs

    @property
    def axes_of_outputs(self) -> Mapping[str, tuple[str, Sequence[Any]]]:
        """What else is known of what the model returns: units and values by the names of coordinates of results."""
        return {}

    @property
    @abstractmethod
    def scalars(self) -> Mapping[str, Scalar]:
        """Every number that can be made a parameter, by its path."""

    @property
    def every_scalar(self) -> Mapping[str, Scalar]:
        """Every number that `build` takes by its path alone: what acts in one load case only is apart there."""
        without = self.unavailable
        return {path: number for path, number in self.scalars.items() if path not in without}

    @abstractmethod
    def build(self, comm: Any, parameters: tuple[str, ...]) -> ForwardModel:
        """Make the model on a communicator; collective.

        Parameters
        ----------
        comm
            mpi4py communicator of the ranks that share the model.
        parameters
            Paths of the numbers that the model's parameter vector holds; the others keep their values.

        Raises
        ------
        ModelError
            If it cannot be made.
        """

    @abstractmethod
    def described(self, ranges: Ranges) -> Iterator[tuple[str, str]]:
        """Describe the model for values of parameters within ranges, by their paths: yield labels and texts."""

    def words(self, said: Callable[[str], str], where: str = "") -> Iterator[tuple[str, list[str]]]:
        """Say for a report what was solved: headings, each with its lines.

        Parameters
        ----------
        said
            Describes a number of the model, by its path.
        where
            Added to statements that hold for one mesh only.
        """
        yield "model", [self.description]
        yield "parameters", [f"{name} = {said(name)}" for name in self.scalars]
        yield "outputs", [named(output.name, output.unit) for output in self.outputs]

    @property
    def description(self) -> str:
        """The model in words."""
        return f"model of kind '{self.kind}'"

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Paths of the coefficients of random fields, which can be parameters too."""
        return ()

    @property
    def modules(self) -> tuple[str, ...]:
        """Modules that the user has written for it: results are not continued once their source has changed."""
        return tuple(dict.fromkeys(module for part in self.parts.values() for module in part.modules))

    @property
    def unknowns(self) -> int:
        """Number of unknowns of its equations; 0 if there are none."""
        return sum(part.unknowns for part in self.parts.values())

    def materials(self, parameters: Collection[str] = ()) -> Materials | None:
        """Return its materials as functions of some of its numbers, by their paths, if it has any."""
        return None

    def over(self, ranges: Ranges) -> Self:
        """Return the same model in the form that suits all values of parameters within ranges, by their paths."""
        return self

    def mistakes_of_samples(self) -> Iterator[Mistake]:
        """Find what is impossible with random parameters; the places of these mistakes begin with "model"."""
        yield from ()

    def findings_over(self, ranges: Ranges) -> tuple[Finding, ...]:
        """Findings before anything is solved, for values of parameters within ranges, by their paths."""
        return ()

    @property
    def unavailable(self) -> Mapping[str, str]:
        """Why some of its numbers cannot be parameters, by their paths."""
        return {}

    @property
    def unenriched_with(self) -> str:
        """What it has no place for on other meshes: what remembers, or is no form; empty if none."""
        return ""

    @property
    def unestimated_with(self) -> str:
        """With what errors of its mesh are not estimated; empty if none."""
        return self.unenriched_with

    @property
    def hidden(self) -> str:
        """Which error of a mesh is in its outputs and cannot be looked at, as a sentence; empty if there is none."""
        return ""

    @property
    def parts(self) -> Mapping[str, ModelSpec]:
        """The models that it joins, by name, whose bodies, tools and modules are its own; none by default."""
        return {}

    def path_of(self, name: str, path: str) -> str:
        """Return the path of a number of one of these, by its name, among those of all."""
        return path

    @property
    def bodies(self) -> tuple[Any, ...]:
        """The bodies with meshes that it consists of."""
        return tuple(body for part in self.parts.values() for body in part.bodies)

    @property
    def touched(self) -> bool:
        """Whether tools touch it: richer elements seldom follow the edge of the area in contact."""
        return any(part.touched for part in self.parts.values())

    @property
    def adaptive(self) -> bool:
        """Whether it has a mesh that is refined before anything else is solved."""
        return False

    @property
    def unrefined(self) -> bool:
        """Whether that is still to be done."""
        return any(part.unrefined for part in self.parts.values())

    @property
    def largest_bytes(self) -> float:
        """Predicted memory (bytes) of the largest mesh that it may be refined to; 0 where it is not."""
        return 0.0

    def mistakes_of_mesh(self) -> Iterator[Mistake]:
        """Find, for a study that does not refine meshes, that this is asked for."""
        if self.unrefined:
            yield ("model", "adapt"), UNREFINED, True

    def adapted(self, comm: Any, parameters: tuple[str, ...], point: FloatArray, say: Callable[[str], None]) -> Any:
        """Refine its mesh at a point (d,) of parameters by their paths (`forward.fem.adapt.Adapted`); collective."""
        raise ModelError(f"a model of kind '{self.kind}' has no mesh that is refined")

    def on_mesh(self, file: str, contents: Contents | None = None) -> Self:
        """Return the same model on the mesh of a file, of which it may be known what it holds."""
        raise ModelError(f"a model of kind '{self.kind}' has no meshes")

    def refined(self, level: int) -> Self:
        """Return the same model on a mesh whose cells are divided by 2^level along each edge."""
        raise ModelError(f"a model of kind '{self.kind}' has no meshes")

    def finer(self, times: float) -> Self:
        """Return the same model with so many times the cells along each edge of its body, or a few more.

        Raises
        ------
        ModelError
            If there is no such mesh, with the reason.
        """
        raise ModelError(f"a model of kind '{self.kind}' has no meshes")

    def coarser(self, times: float, degree: Literal[1, 2] | None = None) -> Self:
        """Return the same model with cells that are so many times as long, perhaps with elements of another degree.

        Raises
        ------
        ModelError
            If there is no such mesh, with the reason.
        """
        raise ModelError(f"a model of kind '{self.kind}' has no meshes")

    def linearised(self) -> Self:
        """Return the same model with small strains.

        Raises
        ------
        ModelError
            If it has no strains.
        """
        raise ModelError(f"a model of kind '{self.kind}' has no strains")

    @property
    def solver_tolerance(self) -> float | None:
        """What its solver leaves of the equations, relative to their terms; None where there is no such number."""
        return None

    def mesh_error_cost(self, spare: float = math.inf) -> Estimate | None:
        """Predict what an estimate of the error of its mesh takes (`Solution.mesh_error`); None without a mesh.

        With what calibrates it if that may cost so many solves.
        """
        return None

    def textbook(self) -> Self:
        """Return the same model with the textbook solver, against which the gain of a better solver is measured."""
        return self

    def tighter(self, factor: float) -> Self:
        """Return the same model with the solver's tolerances multiplied by a factor."""
        return self

    def solved_to(self, tolerance: Any) -> Self:
        """Return the same model with another tolerance of its solver.

        Raises
        ------
        pydantic.ValidationError
            If it cannot be that.
        """
        return self

    def cost(self) -> Times | None:
        """Predict the cost of a solve; None if it is unknown."""
        return None

    def identity(self) -> dict[str, Any]:
        """Return everything that results depend on, as a table."""
        return self.model_dump(mode="json", exclude_none=True)

    @model_validator(mode="after")
    def _check(self) -> Self:
        refuse(type(self).__name__, self._mistakes())
        return self

    def _mistakes(self) -> Iterator[Mistake]:
        """Find mistakes that no single block can see."""
        yield from ()


MODELS = Kinds(
    "model",
    {
        "hyperelastic": "forward.hyperelastic:Hyperelastic",
        "path": "forward.hyperelastic:Path",
        "specimen": "forward.specimen:Specimen",
        "material-tests": "forward.material_tests:MaterialTests",
        "joined": "forward.joined_models:JoinedModels",
        "reduced": "forward.reduced.spec:Reduced",
        "python": "forward.external.models:PythonModel",
        "um-bridge": "forward.external.models:UmBridgeModel",
    },
    ModelSpec,
)


SPECIMEN = "specimen"  # the kind of model whose displacements are measured; of others outputs are


def usual_kind(model: Any) -> str:
    """Return the kind of a measured model, of which a block may say nothing.

    One that has outputs of its own, and no load cases, is a body; others are specimens.
    """
    if not isinstance(model, Mapping):
        return str(getattr(model, "kind", SPECIMEN))
    return str(model.get("kind", "hyperelastic" if "outputs" in model and "cases" not in model else SPECIMEN))


MEASURED = OfKind(MODELS, usual_kind)
"""Of a field that holds a model that data are of: displacements of a specimen, or outputs of any other."""
