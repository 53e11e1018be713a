"""Studies that infer what is unknown of a model from data: displacements of a specimen, or outputs of any model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from pydantic import ValidationError

from forward.fem.cost import REPORT, START
from forward.findings import Finding
from forward.model import ModelError
from forward.readable import told
from forward.scalars import Mistake
from forward.settings import nearest
from forward.solid import Solid
from inverse.criticism.assessment import NEEDED, only_needed, own_seconds
from inverse.methods.invert import ByReduced, derivable
from workflows.config.mistakes import not_installed
from workflows.config.priors import findings_of_materials, mistakes_of_factor, ranges
from workflows.run.from_python import FromPython
from workflows.studies.assumptions import of_none
from workflows.studies.candidates import mistakes_of_truth
from workflows.studies.inversion_blocks import PREDICTED, SOLVES_OF_FIELD, InversionBlocks
from workflows.studies.study import NOT_ASKED, PRODUCT, Sampled, StudyKind, duration, mesh_check, meshes_of, times_of

if TYPE_CHECKING:
    import xarray as xr

    from forward.spec import ModelSpec
    from inverse.data.measurements import Measurements
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from workflows.studies.job import Job

PRODUCTS_OF_FIELD = 500  # for a mode and its pairs
LISTED = 8  # outputs that are named
OF_GEOMETRY = frozenset({"m", "m²", "m³", "1"})  # units of outputs that are no forces


class Inversion(InversionBlocks, FromPython, StudyKind):
    """What to invert: displacements of a specimen, or outputs of any other model.

    Parameters
    ----------
    model
        The specimen (body, material, inclusions or a field, load cases), or a model with outputs, of which some were
        measured.
    parameters
        Priors by the paths of the unknown numbers of the model; none for a field of nodal values.
    correlations
        Correlations between them.
    data
        What was measured.
    method
        How it is inverted.
    predict
        What else is to be known by the posterior; by default nothing.
    uncertain
        Standard deviations of what is taken for granted, by its name, as the table of it in a report has it: of numbers
        of the model, ``data.scale`` and ``data.shift``. Their errors are among those of the data, to first order.
    model_error
        Another model against which the errors of the model are learnt, which are then among those of the data; what is
        predicted is predicted by it.
    """

    stopped: ClassVar[str] = "all data sets inverted"

    @property
    def sampled(self) -> Sampled | None:
        return None if self.specimen is not None else Sampled(self.inputs, self.spec)

    @property
    def specs(self) -> tuple[ModelSpec, ...]:
        """The model, what is predicted, and the model on the finer meshes that it is looked at on."""
        spec, truth = self.spec, () if self.model_error is None else (self.truth,)
        beside = truth if self.predict is None else (self.predicted, *truth)
        try:
            return spec, *beside, *(meshes_of(spec) if self.looked else ())
        except ValueError:  # there are none, which is said elsewhere
            return spec, *beside

    @property
    def recorded(self) -> bool:
        """As in every study: its data sets are named, and not read."""
        return bool(self.data.sets) and not self.measurements

    def with_data(self, folder: Path) -> Self:
        """Return the same with its data read; a StudyError if no file can be used."""
        if self.data.sets:
            return self
        sets, found = self.data.read(folder, self.model)
        return self.model_copy(update={"data": self.data.model_copy(update={"sets": sets}), "measurements": found})

    @classmethod
    def made(cls, blocks: Mapping[str, Any], folder: Path) -> Inversion:
        return cls.model_validate(blocks).with_data(folder)

    @property
    def planned(self) -> int:
        """Number of evaluations: data sets, or solves if all groups work on one."""
        return self.solves if self.together else len(self.data.sets) + 1

    def plan(self, rank_groups: int) -> list[str]:
        method, of_outputs, size, field = self.method, self.specimen is None, len(self.names), self.field
        usable = [one for one in self.measurements if one is not None]
        counts = [len(one) for one in usable]
        unknown = f"{size}: {', '.join(self.names)}"
        if field:
            unknown = f"{self.specimen.body.vertex_count:,} values of ln stiffness"
        own = 0.0 if field else own_seconds(size, max(counts), method.solves(size, field=False), method.chains)
        lines = [
            f"method      {method.kind}",
            *(f"{what:10}  {words}" for what, words in self.model.described(ranges(self.parameters))),
            *(f"by          {one.description}" for one in self.reduced.values() if of_outputs),
            f"unknown     {unknown}",
            *([f"outputs     {', '.join(self.parts)}"] if of_outputs else []),
            f"data sets   {len(usable)}, of {', '.join(f'{n:,}' for n in counts)} "
            f"{'values' if of_outputs else 'components'}",
            *_moved(usable),
            *(f"registered  {one.registered.described}" for one in usable if one.registered is not None),
            *(f"warning     {found.clause}" for one in usable for found in one.findings),
            *([f"solves      about {self.solves // len(counts):,} for each"] if of_outputs else []),
        ]
        if self.spec.cost() is None:
            derivable(self.spec.build(None, self.inputs.names), self.spec.kind)
            each = f"up to about {duration(own)} for each, " if own else ""
            time = f"{each}{duration(START + REPORT)} for start and report, and what the solves take"
        else:
            unlooked = NOT_ASKED if self.model_error is None else self.unlooked
            once, checked = mesh_check(self.spec) if self.looked else (0.0, unlooked)
            lines.append(f"mesh check  {checked}")
            seconds = own + once + self._seconds_of_predictions + self._seconds_of_solves(len(counts))
            time = f"about {duration(seconds)} for each on 1 core (rough)"
        if self.predict is not None:
            names = [output.name for output in self.predicted.returned]
            more = f" and {len(names) - LISTED} others" if len(names) > LISTED else ""
            by = f"by {1 + self.predicted_by} solves, and as many of the prior"
            lines.append(f"predicts    {', '.join(names[:LISTED])}{more}, {by}")
        lines.append(f"time        {time}")
        lines += only_needed(method.chains, method.chains_when, method.chain_solves(size, field=field))
        if self.model_error is not None:
            pairs = f"{self.model_error.solves} solves of another one over the prior, {self.model_error.solves}"
            lines.append(f"learns      errors of the model by {pairs} over the posterior")
        if self.taken is not None:
            lines.append(f"assumed     {self.taken.described(field=field)}")
        if self.asked:
            lines.append(f"asked       {', '.join(self.asked)}: whether the data call for them, by 1 solve")
        return [*lines, *(f"warning     {one.refused}" for one in self.data.sets if one.refused)]

    def _seconds_of_solves(self, sets: int) -> float:
        """Predict the processor time (s) of the solves for one of some data sets."""
        method, size, field = self.method, len(self.names), self.field
        if self.specimen is None:
            cost = times_of(self.spec)
            return self.solves / sets * (cost.sample + cost.tangents(len(self.inputs.names)) / 4)
        cases = [times_of(self.specimen.loaded(case)) for case in self.specimen.cases]
        modes = SOLVES_OF_FIELD + PRODUCT * PRODUCTS_OF_FIELD if field else 15 * method.starts
        draws = 2 * method.solves(0, field=True) if field else method.solves(size, field=False)
        solves = draws + method.chain_solves(size, field=field)
        return sum(one.textbook for one in cases) * modes + sum(one.corrected for one in cases) * solves

    @property
    def _seconds_of_predictions(self) -> float:
        """Predicted processor time (s) of what is predicted."""
        cost = None if self.predict is None else self.predicted.cost()
        if cost is None:
            return 0.0
        own = 0.0 if self.field else cost.tangents_of_sample(len(self.inputs.names))
        return 2 * (cost.textbook + self.predicted_by * (cost.sample + own))

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> Job:
        from workflows.studies.inversion_job import job

        return job(self, ensemble, directory, checkpoint)

    def arviz_groups(self, found: xr.Dataset) -> Mapping[str, xr.Dataset]:
        from workflows.studies.inversion_results import arviz_groups

        return arviz_groups(self, found)

    def parameters_of(self, label: str) -> tuple[str, ...]:
        """Names of the unknown parameters, of those that act in what is predicted with what is uncertain there."""
        return (*self.acting, *self.predicts.groups) if label == PREDICTED else self.inputs.names

    def identity(self) -> dict[str, Any]:
        """Return everything that evaluations depend on; files count by their contents, not their path."""
        found = super().identity() | {"model": self.model.identity()}
        if self.method.reduced is not None:
            found["method"] = found["method"] | {"reduced": {**found["method"]["reduced"], "file": ""}}
        return found

    @property
    def findings(self) -> tuple[Finding, ...]:
        reach = ranges(self.parameters)
        found = (*self.model.findings_over(reach), *findings_of_materials(self.inputs))
        if self.specimen is not None:
            return *found, *self._ratios_alone()
        return *found, *(said for one in self.reduced.values() for said in one.outside(reach))

    def _ratios_alone(self) -> Iterator[Finding]:
        """Find that no force acts or is measured: then displacements do not change if all stiffnesses are doubled."""
        pressed = any(not load.contact for case in self.model.cases for load in case.loads)
        units = self.model.measurable
        seen = [found.subset(found.points < 0) for found in self.measurements if found is not None]
        names = {(self.parts[case], name) for one in seen for case, name in zip(one.cases, one.names, strict=True)}
        if pressed or any(units[case][name] not in OF_GEOMETRY for case, name in names):
            return
        moduli = [
            path
            for path, number in self.model.scalars.items()
            if number.unit == "Pa" and path.startswith(("material.", "regions."))
        ]
        unknown = [path for path in moduli if path in self.parameters]
        fields = [field.label for field in self.model.fields if field.of == "stiffness"]
        known = [path for path in moduli if path not in self.parameters]
        if not unknown and not fields:
            return
        sought = ", ".join([*unknown, *(f"the mean of the field '{label}'" for label in fields)])
        source = f"{', '.join(known)} as stated" if known and not fields else "the prior alone"
        yield Finding("ratios-only", "warning", {"sought": sought, "source": source})

    def mistakes(self) -> Iterator[Mistake]:
        if self.specimen is not None:
            yield from self._of_specimen()
        else:
            yield from self._of_outputs()
        if self.method.reduced is not None:
            yield from self._of_reduced(self.method.reduced)
        if self.method.chains is not None:
            yield from not_installed("chains", self.method.chains, NEEDED[self.method.chains])
        if self.method.chains == "hmc" and self.method.reduced is not None:
            message = "follows the gradients of the body itself, expected 'pcn' or 'emcee' with a reduced model"
            yield ("method", "chains"), message, self.method.chains
        yield from self.mistakes_of_parameters()
        yield from mistakes_of_factor(self.method.noise, "method", "noise")
        for name, value in self.data.truth.items():
            if name not in self.model.scalars:
                message = f"not a number of the model; {nearest(name, tuple(self.model.scalars))}"
                yield ("data", "truth", name), message, value
        if self.data.errors.process and (self.specimen is None or self.field or self.method.reduced is not None):
            message = "varies along a body of few parameters, expected false with outputs, nodal fields, reduced models"
            yield ("data", "errors", "process"), message, True
        itself = self.method.expansion is None and self.method.reduced is None and not self.field
        if self.method.question and not (itself and isinstance(self.spec, Solid)):
            message = "is asked of one body that is solved itself for few parameters, with no expansion, reduced model "
            yield ("method", "question"), f"{message}or field of nodal values; expected false", True
        wrong = [] if self.model_error is None else list(self._of_model_error())
        if self.predict is not None and not wrong:
            from workflows.studies.predicted import mistakes

            wrong += mistakes(self)
        yield from wrong or self._of_uncertain()

    def _of_model_error(self) -> Iterator[Mistake]:
        """Find what of the other model is wrong, and with what errors of the model are not learnt."""
        asked = {"a field of nodal values": self.field, "method.expansion": self.method.expansion is not None}
        asked["method.reduced"] = self.method.reduced is not None
        for what in (what for what, there in asked.items() if there):
            yield ("model_error",), f"errors of a model are not learnt with {what}, expected one of both", what
        for place, message, given in mistakes_of_truth(lambda: self.truth, self.spec, self.unknown):
            yield ("model_error", *place), message, given

    def _of_uncertain(self) -> Iterator[Mistake]:
        """Find what cannot be uncertain, neither in what was measured nor in what is predicted."""
        if self.uncertain and (self.method.expansion is not None or self.method.reduced is not None):
            message = "what is uncertain beside the parameters needs solves of the model itself, expected neither "
            yield ("uncertain",), f"{message}method.expansion nor method.reduced", list(self.uncertain)
        elif self.uncertain and self.taken is not None:
            predicted = [] if self.predict is None else [replace(self.taken, spec=self.predicted)]
            kind, wrong = self.data.errors.kind, list(of_none([self.taken, *predicted]))
            yield from wrong or (() if kind == "normal" else self.taken.of_heavy_tails(kind, field=self.field))

    def _of_specimen(self) -> Iterator[Mistake]:
        """Find mistakes of the inversion of displacements."""
        nodal = self.nodal
        if nodal and (len(self.model.fields) > 1 or self.parameters):
            message = "a field of nodal values is inverted alone, expected no other fields and no parameters"
            yield ("model", "fields", nodal[0], "basis"), message, "nodes"
        if nodal and self.model.fields[nodal[0]].of != "stiffness":
            yield ("model", "fields", nodal[0], "of"), "expected stiffness", self.model.fields[nodal[0]].of
        if nodal and self.method.chains in {"emcee", "hmc"}:
            yield ("method", "chains"), "expected 'pcn', the chains for fields", self.method.chains
        if nodal and self.method.noise is not None and self.data.errors.kind != "normal":
            message = "the size of such errors is not inferred with a field, expected { kind = 'normal' } or no noise"
            yield ("data", "errors"), message, self.data.errors.kind
        if not self.parameters and not self.model.fields:
            yield ("parameters",), "nothing is unknown, expected at least one prior, or one of model.fields", {}
        if self.method.expansion is not None:
            message = "data sets of a specimen are observed at places of their own, expected outputs of another model"
            yield ("method", "expansion"), message, self.method.expansion

    def _of_outputs(self) -> Iterator[Mistake]:
        """Find mistakes of the inversion of outputs."""
        yield from self.model.mistakes_of_mesh()
        for i in self.nodal:
            message = "values at the vertices are inverted with the displacements of a specimen, expected 'modes'"
            yield ("model", "fields", i, "basis"), message, "nodes"
        yield from self.mistakes_of_ranks(self.spec)
        if not self.parameters and not self.model.coefficients:
            yield ("parameters",), "nothing is unknown, expected at least one prior", {}
        data: Any = self.data
        yield from data.mistakes(self.model)

    def _of_reduced(self, given: ByReduced) -> Iterator[Mistake]:
        """Find mistakes about reduced models: one of a body, one for each load case of a specimen."""
        place = ("method", "reduced")
        if self.field:
            message = "a field of nodal values has no reduced model, expected few parameters, or the modes of a field"
            yield place, message, given.files
            return
        if self.specimen is not None:
            if set(given.by_case) != set(self.parts):
                example = ", ".join(f'{name} = "FILE"' for name in self.parts)
                message = f"a specimen has a reduced model for each load case, expected file = {{ {example} }}"
                yield (*place, "file"), message, given.file
                return
            bodies: dict[str, Any] = {case.name: self.specimen.loaded(case) for case in self.specimen.cases}
        else:
            if self.method.expansion is not None:
                message = "stands for the body in place of a reduced model, expected one of both"
                yield ("method", "expansion"), message, self.method.expansion
            if set(given.by_case) != {""}:
                yield (*place, "file"), "a body has one reduced model, expected a file", given.files
                return
            if self.model.kind != "hyperelastic":
                message = f"a reduced model stands for a body, expected kind 'hyperelastic', not '{self.model.kind}'"
                yield place, message, given.file
                return
            bodies = {"": self.spec}
        try:
            found = self.reduced
        except (ValidationError, ModelError) as error:
            said = error.errors()[0]["msg"] if isinstance(error, ValidationError) else str(error)
            yield place, said, given.files
            return
        for name, body in bodies.items():
            known = {*body.scalars, *body.coefficients}
            acting = [path for path in (*self.parameters, *self.model.coefficients) if path in known]
            for said in found[name].differences(body, acting):
                yield (*place, *(("file", name) if name else ())), said, given.by_case[name]


def _moved(usable: list[Measurements]) -> list[str]:
    """Say how many points are moved onto the body, and how far."""
    moves = np.concatenate([one.moves for one in usable])
    count = int((moves > 0).sum())
    if not count:
        return []
    where = "" if all(one.on_surface for one in usable) else " outside the body"
    are = f"point{where} is" if count == 1 else f"points{where} are"
    farthest, rms = (told(float(x), "m") for x in (moves.max(), np.sqrt(np.mean(moves**2))))
    return [f"            {count} {are} moved to its surface, by up to {farthest} (root mean square {rms})"]
