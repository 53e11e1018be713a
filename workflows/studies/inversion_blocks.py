"""What stands in a study that infers what is unknown of a model, and what follows from it before anything is solved."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import Field, field_validator, model_validator
from pydantic.json_schema import SkipJsonSchema

from forward.bodies.inclusions import log_factor
from forward.model import FloatArray, ModelError
from forward.settings import Settings
from forward.spec import MEASURED, SPECIMEN, ModelSpec, usual_kind
from forward.specimen import SHARED, LoadCase, Observed, Specimen
from inverse.methods.invert import Invert, names_of
from inverse.methods.model_error import LearntError
from uq.inputs.distributions import Normal
from uq.inputs.random_parameters import Inputs
from workflows.config.blocks import AS_DECIDED, decided
from workflows.config.one_model import OneModel
from workflows.config.priors import ranges
from workflows.config.tables import at
from workflows.data.measured import DataFiles
from workflows.data.measured_outputs import MeasuredOutputs
from workflows.studies.assumptions import TakenForGranted, Uncertain
from workflows.studies.candidates import UNSEEN, truth_of
from workflows.studies.study import never_estimable

if TYPE_CHECKING:
    from forward.reduced.spec import Reduced

SOLVES_OF_FIELD = 12  # for a mode
PREDICTED = "predicted"  # name of the solves for what is predicted
LEAST = 8  # solves of an expansion of what is predicted
ACTING = ("clamp", "displacements", "loads")


class Predict(Settings):
    """Outputs that the posterior predicts: under other loads, at other places, of another kind.

    Parameters
    ----------
    cases
        Of a specimen: load cases in which something is predicted, with what acts in them and `outputs`. One that has
        the name of a measured load case and nothing that acts is that load case. By default the measured ones.
    observed
        Of a specimen: places at which displacements are predicted, as `model.observed` has them.
    model
        Of other models: settings that replace those of the model, such as { loads = [...], outputs = [...] }; all of
        the outputs are predicted. By default the model as it is.
    samples
        Solves for the posterior, and as many for the prior: those of an expansion over draws of few parameters (by
        default 32); of a field, pairs of draws (8 pairs), without which it is not seen what derivatives leave out.
    """

    cases: tuple[LoadCase, ...] = ()
    observed: tuple[Observed, ...] = ()
    model: dict[str, Any] = Field(default={})
    samples: Annotated[int, Field(ge=0)] | None = None

    def solves(self, *, field: bool) -> int:
        """Number of solves beside the first, for the posterior as for the prior."""
        if self.samples is None:
            return 16 if field else 32
        return self.samples


class InversionBlocks(OneModel):
    """The blocks of an inversion, as `workflows.studies.inversion.Inversion` explains them."""

    restricted: ClassVar[bool] = True

    model: Annotated[Any, MEASURED]
    data: Annotated[DataFiles | MeasuredOutputs, AS_DECIDED]
    method: Invert = Invert()
    predict: Predict | None = None
    uncertain: dict[str, Uncertain] = Field(default={})
    model_error: LearntError | None = None
    measurements: SkipJsonSchema[tuple[Any, ...]] = Field(default=(), exclude=True, repr=False)

    # --- the model ---------------------------------------------------------------------------------------------------

    @property
    def specimen(self) -> Any:
        """The model, if it is a specimen, of which displacements were measured; else None."""
        return self.spec if self.spec.placed else None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in results; for a field, its mean."""
        if self.field:
            label = f"fields.{self.model.fields[0].label}.mean"
            return names_of(Inputs({label: Normal(mean=0.0, std=1.0)}), self.method)
        return names_of(self.inputs, self.method)

    @cached_property
    def predicted(self) -> ModelSpec:
        """The model whose outputs are predicted, in the form of the measured one; a ValidationError says no."""
        asked, model = self.predict, self.model if self.model_error is None else self.truth
        assert asked is not None
        if model.placed:
            own = model.over(ranges(self.parameters))
            known = {case.name: case for case in own.cases}
            cases = tuple(_acting(case, known) for case in asked.cases) or own.cases
            shared = {name: getattr(own, name) for name in SHARED}
            return Specimen(formulation=own.formulation, cases=cases, observed=asked.observed, **shared)
        kept = {name: getattr(model, name) for name in type(model).model_fields}
        made: ModelSpec = type(model).model_validate(kept | asked.model)
        return made.over(ranges({name: one for name, one in self.parameters.items() if name in made.scalars}))

    @cached_property
    def truth(self) -> Any:
        """The model against which the errors of the model are learnt; a ValidationError says no."""
        assert self.model_error is not None
        return truth_of(self.model, self.model_error, self.parameters)

    @property
    def looked(self) -> bool:
        """Whether the model is looked at on finer meshes, where it has a mesh."""
        return self.method.treatment is not None and self.model_error is None

    @property
    def unlooked(self) -> str:
        """Why it is not."""
        return UNSEEN if self.model_error is not None else self.method.unchecked

    @property
    def unknown(self) -> tuple[str, ...]:
        """Paths of the unknown numbers, and of coefficients."""
        return tuple(self.model.coefficients) if self.field else self.inputs.names

    @property
    def acting(self) -> tuple[str, ...]:
        """Those that act in what is predicted."""
        known = {*self.predicted.scalars, *self.predicted.coefficients}
        return tuple(name for name in self.unknown if name in known)

    @cached_property
    def predicts(self) -> TakenForGranted:
        """What is uncertain in what is predicted: numbers of its model."""
        return TakenForGranted(self.predicted, self.acting, (), self.uncertain, alone=True)

    @property
    def predicted_by(self) -> int:
        """Number of solves for what is predicted, beside the first, for the posterior as for the prior."""
        return 0 if self.predict is None else self.predict.solves(field=self.field)

    @cached_property
    def reduced(self) -> dict[str, Reduced]:
        """The reduced models that stand for the load cases of a specimen, by name, or for the model, as "".

        There are none where the model is asked itself; a ValueError says that a file cannot be used.
        """
        asked = self.method.reduced
        if asked is None:
            return {}
        from forward.reduced.spec import Reduced

        files, digests = asked.by_case, asked.digests
        names = files if "" in files else self.parts
        hashes = {name: {"digest": digests[name]} if name in digests else {} for name in names}
        return {name: Reduced.model_validate({"file": files[name], **hashes[name]}) for name in names}

    def stiffness(self, places: FloatArray, points: FloatArray) -> FloatArray:
        """Return ln of the factor (n, k) of the inclusions on the stiffness at places (k, 3) and parameters (n, d)."""
        return log_factor(self.model.inclusions, self.inputs.names, points, places)

    @property
    def taken(self) -> TakenForGranted | None:
        """What is taken for granted; None where it is not looked at."""
        if self.method.expansion is not None or not (self.method.assumptions or self.uncertain):
            return None
        return TakenForGranted(self.spec, self.unknown, self.measurements, self.uncertain)

    @property
    def asked(self) -> tuple[str, ...]:
        """Names of the questions to the shape; none where nothing is asked."""
        if not self.method.question:
            return ()
        from forward.enlargements import asked_of

        return asked_of(self.spec)

    # --- the data ----------------------------------------------------------------------------------------------------

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the parts of the data (load cases, outputs) for which results of each alone are given."""
        if self.specimen is not None:
            return tuple(case.name for case in self.model.cases)
        return next((found.parts for found in self.measurements if found is not None), ())

    def not_estimable(self, number: int) -> tuple[str, ...]:
        """Names of what was measured in a data set whose error of the mesh nothing tells: of displacements none."""
        if self.specimen is not None:
            return ()
        return never_estimable(self.model, tuple(self.measurements[number].names.tolist()))

    @property
    def together(self) -> bool:
        """Whether all groups of ranks work on one data set, point by point."""
        alone = self.specimen is None or not self.model.fields
        return alone and len(self.data.sets) == 1 == self.parallel.ranks_per_model and self.method.expansion is None

    @property
    def solves(self) -> int:
        """Approximate number of solves for all data sets: the searches for the modes are not predictable."""
        method, field = self.method, self.field
        if method.expansion is not None:
            return method.expansion
        if method.reduced is not None:  # at the mode, and draws
            return (1 + method.reduced.solves) * sum(measurement is not None for measurement in self.measurements)
        each = method.solves(len(self.names), field=field) + method.chain_solves(len(self.names), field=field)
        each += SOLVES_OF_FIELD + each if field else 12 * method.starts + 2 * len(self.parameters)
        more = 0 if self.predict is None else 1 + self.predicted_by
        each += 0 if self.model_error is None else 2 * self.model_error.solves
        count = sum(measurement is not None for measurement in self.measurements)
        return (each + more) * count + more

    @field_validator("method")
    @classmethod
    def _hashed(cls, method: Invert) -> Invert:
        """Add the hash of each reduced model as it is; whoever uses a file says what is wrong with it."""
        given = method.reduced
        if given is None or given.digest is not None:
            return method
        from forward.reduced.spec import digest_of

        try:
            digests = {name: digest_of(file) for name, file in given.by_case.items()}
        except ModelError:
            return method
        digest = digests.get("", digests)
        return method.model_copy(update={"reduced": given.model_copy(update={"digest": digest})})

    @model_validator(mode="before")
    @classmethod
    def _data_of_model(cls, blocks: Any) -> Any:
        """Choose the block of the data by the model."""
        return decided(blocks, data=DataFiles if usual_kind(at(blocks, "model")) == SPECIMEN else MeasuredOutputs)


def _acting(case: LoadCase, known: dict[str, LoadCase]) -> LoadCase:
    """Return a load case with what acts in the measured one of that name, where it says nothing itself."""
    if case.name not in known or any(getattr(case, name) for name in ACTING):
        return case
    return known[case.name].model_copy(update={"outputs": case.outputs})
