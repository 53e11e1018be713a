"""The method `invert` of a study: inference of unknowns from displacements or outputs."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from forward.model import ForwardModel, ModelError
from forward.settings import Settings
from inverse.criticism.assessment import Kind, When, solves_of
from inverse.criticism.chains import FIELD
from inverse.criticism.weights import usual
from inverse.fields.low_rank import CUTOFF
from inverse.low_dimensional.evidence import LEAST
from inverse.low_dimensional.posterior import NOISE
from inverse.methods.mesh_correction import Treatment
from uq.inputs.distributions import Distribution
from uq.inputs.random_parameters import Inputs

LEAST_SHARED = 8  # solves of an expansion


class ByReduced(Settings):
    """A reduced model in place of the body, and full solves that correct and check what it says.

    Parameters
    ----------
    file
        What `tissuq reduce` has made of the body, over the priors; of a specimen, a file for each of its load cases.
    solves
        Draws of each posterior that are solved in full.
    digest
        Hash of the file, kept with results: another file of the same name is refused.
    """

    file: str | dict[str, str]
    solves: Annotated[int, Field(ge=8)] = 24
    digest: str | dict[str, str] | None = None

    @property
    def by_case(self) -> dict[str, str]:
        """The files by load case; of a body alone, as ""."""
        return self.file if isinstance(self.file, dict) else {"": self.file}

    @property
    def digests(self) -> dict[str, str]:
        """The hashes by load case, as far as they are known."""
        return self.digest if isinstance(self.digest, dict) else {} if self.digest is None else {"": self.digest}

    @property
    def files(self) -> str:
        """The file, or all of them."""
        return ", ".join(self.by_case.values())


class Inference(Settings):
    """What methods that infer have in common; each says what it is there."""

    starts: Annotated[int, Field(ge=1)] = 4
    seed: Annotated[int, Field(ge=0)] = 0
    chains: Kind | None = None
    chains_when: When = "always"
    mesh_error: Treatment | Literal[False] = "correct"
    mesh_check: bool = True
    assumptions: bool = True

    def solves(self, size: int, *, field: bool) -> int:
        """Number of solves for a data set with `size` unknown parameters that correct the Gaussian."""
        raise NotImplementedError

    @property
    def treatment(self) -> Treatment | None:
        """What is done about the error of the mesh; None where it is not asked for."""
        return (self.mesh_error or None) if self.mesh_check else None

    @property
    def unchecked(self) -> str:
        """Why the mesh is not looked at, where it is not."""
        return "method.mesh_error = false" if self.mesh_error is False else "method.mesh_check = false"


class Invert(Inference):
    """Inversion of measurements: the most probable parameters or interior, their uncertainty, and what stays open.

    Parameters
    ----------
    samples
        Solves that correct Laplace's Gaussian: by default 256 for few parameters, or eight for each if these are more,
        none for a field. With 64, 90 %
        intervals contained the truth in 82 % of specimens with thin and curved posteriors (docs/measurements.md).
    noise
        Prior of the factor on all standard deviations of the errors; by default these are as stated.
    chains
        Run Markov chains too: "pcn", with proposals from a Gaussian of the posterior (5 204 solves; for a field 4 804),
        or, for few parameters, "emcee" (35 208 solves, or more) or "hmc", which follows gradients and mixes in tens of
        unknowns too (60 000 solves with an adjoint at most, one after another; by mici). If they have mixed, moments
        and draws of few parameters are theirs; for a field, only if Laplace's cannot be trusted.
    chains_when
        "needed": only for those data sets whose weighted points, or samples of a field, cannot be trusted.
    starts
        Starts of the search for the mode of few parameters.
    cutoff, rank
        Directions of a field with λ below `cutoff` are neglected; and largest number of directions.
    draws
        Draws of the posterior that are stored for few parameters; for a field, a tenth of it.
    seed
        Of all draws.
    mesh_error
        What the error of the mesh does to the data, in deviations of their noise, and to the unknowns, in deviations of
        the posterior, by solves on finer meshes with thinner cells at the faces that are held: "correct" the model by
        it where it exceeds a fifth of either, with what is uncertain of it among the errors of the data; "report" it
        only; false: not at all, and no posterior is said to be trusted.
    assumptions
        Tell how far what is taken for granted moves the answers: numbers of the model that are not unknown, scales of
        the data and places of its points (one solve, with derivatives by these numbers).
    question
        Ask whether data of few parameters call for what the body does not have: another edge or shape of its
        inclusions, another lump, a layer, a field, fibres (one solve).
    expansion
        Solves of an expansion of the outputs over the prior that all data sets share: they are then inverted with it,
        in about a second each, whatever a solve takes. By default every data set has solves of its own.
    reduced
        A reduced model that searches and samples in place of the body: "FILE", or { file = "FILE", solves = 24 }; of a
        specimen one for each load case: { file = { shear = "FILE", compression = "FILE" } }. One
        full solve corrects it at the mode, others check the posterior at its draws and correct it further.
    mesh_check
        An older name: false is mesh_error = false.
    """

    kind: Literal["invert"] = "invert"
    samples: Annotated[int, Field(ge=0)] | None = None
    noise: Distribution | None = None
    cutoff: Annotated[float, Field(gt=0)] = CUTOFF
    rank: Annotated[int, Field(ge=1)] = 256
    draws: Annotated[int, Field(ge=10)] = 400
    expansion: Annotated[int, Field(ge=LEAST_SHARED)] | None = None
    reduced: ByReduced | None = None
    question: bool = False

    @field_validator("reduced", mode="before", json_schema_input_type=ByReduced | str)
    @classmethod
    def _file_alone(cls, given: Any) -> Any:
        return {"file": given} if isinstance(given, str) else given

    @model_validator(mode="after")
    def _check(self) -> Invert:
        if self.samples is not None and 0 < self.samples < LEAST:
            raise ValueError(f"samples = {self.samples}, expected at least {LEAST}")
        return self

    def solves(self, size: int, *, field: bool) -> int:
        if self.samples is not None:
            return self.samples
        return 0 if field else usual(size)

    def chain_solves(self, size: int, *, field: bool) -> int:
        """Number of solves of the chains for a data set with `size` unknown parameters."""
        if field and self.chains is not None:
            return 2 * FIELD.evaluations  # the map of fields takes two
        return solves_of(self.chains, size)


def names_of(inputs: Inputs, method: Invert) -> tuple[str, ...]:
    """Return the names of the parameters, and of the noise if it is inferred."""
    return (*inputs.names, *((NOISE,) if method.noise is not None else ()))


def derivable(model: ForwardModel, kind: str) -> None:
    """Refuse a model without derivatives; raises `ModelError` if it has none."""
    if not model.differentiable:
        raise ModelError(
            f"this model of kind '{kind}' has no derivatives, without which the most probable parameters are not "
            "found: expected a jacobian of the Python function, or a server that has ApplyJacobian or Gradient"
        )
