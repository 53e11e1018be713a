"""Studies that say which observations to make: those that tell most on a model, or tell candidate models apart."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import numpy as np
from pydantic import Field, SerializeAsAny, model_validator

from forward.bodies.geometry import AXES
from forward.findings import Finding
from forward.model import FloatArray, ForwardModel, ModelError, SolveError
from forward.registry import OfKind
from forward.scalars import Mistake
from forward.spec import MODELS, ModelSpec
from inverse.criticism.assumptions import by_evaluation, by_model
from inverse.data.measurements import Measurements
from inverse.designs.criteria import of_field
from inverse.designs.greedy import NEAR
from inverse.methods.design import Design
from inverse.methods.invert import derivable
from uq.evaluation.evaluate import Recorder
from uq.evaluation.kept import Kept, KeptSolves
from workflows.config.blocks import AS_DECIDED, AVERAGED, PartOrKind, decided
from workflows.config.one_model import Sourced
from workflows.config.priors import findings_of_materials, ranges
from workflows.config.tables import at
from workflows.run.from_python import FromPython
from workflows.studies.assumptions import ASSUMED, TakenForGranted, Uncertain, of_none
from workflows.studies.candidates import CandidateModel, OfCandidates
from workflows.studies.job import Job, MethodJob, TasksJob
from workflows.studies.study import PRODUCT, StudyKind, duration

if TYPE_CHECKING:
    import xarray as xr

    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from uq.evaluation.request import Evaluate, Evaluations
    from uq.evaluation.tasks import Outcome


ANY_MODEL = OfKind(MODELS, "specimen")
PRODUCTS = 600  # with the derivative, for the directions of a field that many candidates tell
SIDES = {f"{axis}-{side}": (k, end) for k, axis in enumerate(AXES) for side, end in (("min", 0), ("max", -1))}


class DesignStudy(Sourced, OfCandidates, FromPython, StudyKind):
    """What could be observed, and how much of it.

    Parameters
    ----------
    model
        What is measured: a specimen, whose `observed` displacements and outputs of load cases can be chosen, or any
        other model, whose outputs can; with candidates, as far as these have it in common.
    parameters
        Priors by the paths of the unknown numbers of the model; none for a field of nodal values.
    source
        Draws of unknown numbers; in a file it is ``parameters.from``: a posterior as prior.
    correlations
        Correlations between them.
    candidates
        Models by name, as of a comparison, that the observations should tell apart.
    uncertain
        Standard deviations of what is taken for granted, as of inversions: what only that moves tells less.
    method
        What is chosen and how.
    """

    stopped: ClassVar[str] = "a design"
    explains: ClassVar[bool] = False
    restricted: ClassVar[bool] = True

    model: Annotated[SerializeAsAny[ModelSpec] | dict[str, Any], AS_DECIDED, PartOrKind(ANY_MODEL)]
    candidates: Annotated[dict[str, CandidateModel], Field(min_length=2)] | None = None
    uncertain: dict[str, Uncertain] = Field(default={})
    method: Design

    @model_validator(mode="before")
    @classmethod
    def _by_candidates(cls, blocks: Any) -> Any:
        """Take the model as it is where each candidate completes it."""
        whole = at(blocks, "candidates") is None
        return decided(blocks, model=Annotated[ModelSpec, ANY_MODEL]) if whole else blocks

    @cached_property
    def of_candidates(self) -> Mapping[str, ModelSpec]:
        return {"/": self.spec} if self.candidates is None else super().of_candidates

    @property
    def specs(self) -> tuple[ModelSpec, ...]:
        return tuple(self.of_candidates.values())

    @property
    def planned(self) -> int:
        """Number of solves: for each draw, of each candidate, one, and of few parameters another for the uncertain."""
        return self.method.draws * len(self.of_candidates) * (2 if self.uncertain and not self.field else 1)

    @property
    def field(self) -> bool:
        return self.candidates is None and super().field

    def takes(self, name: str, values: Measurements | None) -> TakenForGranted:
        """Return what a candidate takes for granted of values that may be measured."""
        spec: Any = self.of_candidates[name]
        if values is not None:
            some = replace(values, some=True, names=values.labels)
            values = values.in_model(spec.observable) if spec.placed else some
        return TakenForGranted(spec, self.unknown_of(name), [values], self.uncertain, alone=values is not None)

    def unknown_of(self, name: str) -> tuple[str, ...]:
        """Paths of the unknown numbers of a candidate or of the one model, and of coefficients."""
        return self.of_candidates[name].coefficients if self.field else self.parameters_of(name)

    @property
    def findings(self) -> tuple[Finding, ...]:
        if self.candidates is not None:
            return tuple(dict.fromkeys(self.findings_of_models))
        model: Any = self.model
        inputs, source = self.inputs, self.source
        of_draws = () if source is None else source.findings(self.spec, inputs)
        return (*model.findings_over(ranges(self.given)), *findings_of_materials(inputs), *of_draws)

    def plan(self, rank_groups: int) -> list[str]:
        method, costs = self.method, [spec.cost() for spec in self.specs]
        draw = sum(cost.textbook for cost in costs if cost is not None)
        if self.candidates is None:
            told, draw = self._unknown(draw)
        else:
            told = [f"candidate   {name}: {spec.description}" for name, spec in self.of_candidates.items()]
        draw *= self.planned / (method.draws * len(costs))
        if self.uncertain:
            told.append(f"uncertain   {', '.join(self.uncertain)}: errors that the observations share")
        return [
            f"method      {method.kind}, criterion {method.criterion}",
            *told,
            f"chosen      {method.wanted}",
            f"solves      {self.planned}{'' if self.candidates else ', each with its derivatives'}",
            *([] if None in costs else [f"time        about {duration(method.draws * draw)} on 1 core (rough)"]),
        ]

    def _unknown(self, solve: float) -> tuple[list[str], float]:
        """Say what is unknown of the model, and predict the time (s) of a draw: a solve with its derivatives."""
        model: Any = self.model
        cost, d = self.spec.cost(), len(self.inputs.names)
        unknown = f"{d}: {', '.join(self.inputs.names[:12])}{', …' if d > 12 else ''}"
        if self.field:
            unknown = f"{len(model.coefficients):,} values of ln stiffness"
        derivatives = 0.0 if cost is None else PRODUCTS * PRODUCT * cost.textbook if self.field else cost.tangents(d)
        lines = (f"{what:10}  {found}" for what, found in model.described(ranges(self.given)))
        return [*lines, f"unknown     {unknown}"], solve + derivatives

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> Job:
        """Make the model, or those of all candidates, which are all observed at the places of the first; collective."""
        method, specs = self.method, self.of_candidates
        first, *others = specs
        model: Any = specs[first].build(ensemble.group, self.unknown_of(first))
        if self.candidates is None or self.uncertain:
            derivable(model, specs[first].kind)
        values = values_of(specs[first], model)
        taken = {one: self.takes(one, values) for one in specs if self.uncertain}
        taken = {one: found for one, found in taken.items() if found.groups}
        if self.field:
            return self._of_field(ensemble, checkpoint, model, values, taken.get(first))
        recorders: dict[str, Recorder] = {}

        def made(name: str) -> Any:
            other: Any = specs[name].build(ensemble.group, self.parameters_of(name))
            if specs[name].placed and specs[first].placed:
                other = other.observing(model.places, model.axes.tolist(), model.cases.tolist())
            elif other.outputs != model.outputs:
                raise ModelError(f"{name} gives {', '.join(other.outputs[:3])}, …, expected the outputs of {first}")
            return other

        def task(evaluate: Evaluate) -> xr.Dataset:
            for one in specs:
                recorders[one] = Recorder(evaluate if one == first else evaluate.on(one))
            assumed = {name: one.of(one.data, by_evaluation(evaluate.on(held[name]))) for name, one in taken.items()}
            if self.candidates is None:
                of_mesh = evaluate if self.spec.bodies else None
                return method.run(self.inputs, recorders[first], values, of_mesh, assumed.get(first))
            weights = {one: candidate.weight for one, candidate in self.candidates.items()}
            return method.run_models(self.priors, weights, recorders, values, assumed)

        held = {name: f"{name}/{ASSUMED}" for name in taken}
        makers: dict[str, Callable[[], ForwardModel]] = {one: partial(made, one) for one in others}
        makers |= {held[name]: partial(one.model, ensemble.group) for name, one in taken.items()}
        return MethodJob(model, makers, task, recorders, texts=lambda found: files(specs[first], found))

    def _of_field(
        self, ensemble: Ensemble, checkpoint: Checkpoint, model: Any, values: Measurements, held: TakenForGranted | None
    ) -> TasksJob:
        """Each draw of the field is a task of one group."""
        from forward.combine import Recorded

        method = self.method
        spec: Any = self.spec
        prior = spec.fields[0].prior(spec.body)
        names = [f"draw {number}" for number in range(method.draws)]
        solving: list[Kept] = []  # of the draw at hand
        goals, assumed = method.candidates(values)[1], None
        if held is not None:
            assumed = held.of(held.data, by_model(held.model(ensemble.group)))

        def linearise(number: int, solved: list[Evaluations]) -> xr.Dataset:
            solving.append(Kept(checkpoint, ensemble.group, names[number]))
            kept = Recorded(model, KeptSolves(solving[-1], solved))
            whitened = method.whitened(number, len(model.parameters))
            try:
                solution = kept.solve(prior.root(whitened))
            except SolveError:
                ensemble.count(1, 1)
                raise
            ensemble.count(1, 0)
            sigma = method.sigma(values, solution.outputs[None])
            mesh = None
            if method.mesh_error and number == 0:
                with suppress(SolveError):  # nothing tells what the mesh takes away
                    mesh = solution.mesh_error()
            errors = np.zeros((0, len(values)))
            if assumed is not None:
                errors = assumed.errors(prior.root(whitened)[None], np.array(solution.state), ~goals)[0]
            parts = (prior, prior.matern.mass, sigma, goals, errors, method.rank, method.seed)
            found = of_field(kept, solution, whitened, *parts)
            return found if mesh is None else found.assign(mesh_error=("value", mesh.outputs))

        def results(outcomes: Sequence[Outcome]) -> xr.Dataset:
            found = [one.dataset for one in outcomes if one.dataset is not None]
            if not found:
                raise SolveError(f"the model has no answer at any of the {len(outcomes)} draws: {outcomes[0].reason}")
            return method.of_fields(found, values, 0 if assumed is None else len(assumed.weights))

        return TasksJob(names, linearise, results, solving, texts=lambda found: files(spec, found))

    def parameters_of(self, label: str) -> tuple[str, ...]:
        return self.inputs.names if self.candidates is None else super().parameters_of(label)

    def units_of(self, label: str) -> dict[str, str]:
        return StudyKind.units_of(self, label) if self.candidates is None else super().units_of(label)

    def identity(self) -> dict[str, Any]:
        """Return everything that evaluations depend on; files count by their contents, not their path."""
        return super().identity() | (self.by_contents if self.candidates is None else {})

    def mistakes(self) -> Iterator[Mistake]:
        wrong = list(self._of_model() if self.candidates is None else self._of_candidates())
        yield from wrong
        if self.uncertain and not wrong:
            yield from of_none([self.takes(name, None) for name in self.of_candidates])

    def _of_model(self) -> Iterator[Mistake]:
        model: Any = self.model
        if self.method.criterion == "models":
            yield ("method", "criterion"), "one model, expected several as candidates", "models"
        if self.source is not None:
            if self.source.model == AVERAGED:
                yield ("parameters", "from", "model"), "one model is linearised, expected one of them", AVERAGED
                return
            wrong = list(self.source.mistakes(model, tuple(self.parameters)))
            yield from wrong
            if wrong:
                return
        fields, nodal = self.random_fields, self.nodal
        if nodal and (len(fields) > 1 or self.given):
            message = "a field of nodal values is unknown alone, expected no other fields and no parameters"
            yield ("model", "fields", nodal[0], "basis"), message, "nodes"
            return
        if nodal and fields[nodal[0]].of != "stiffness":
            yield ("model", "fields", nodal[0], "of"), "expected stiffness", "density"
        if not nodal and not self.inputs.names:
            yield ("parameters",), "nothing is unknown, expected at least one parameter", {}
        yield from model.mistakes_of_mesh()
        yield from self.mistakes_of_ranks(self.spec)
        yield from self.mistakes_of_parameters()
        yield from _mistakes_of_values(self.method, model)

    def _of_candidates(self) -> Iterator[Mistake]:
        if self.method.criterion != "models":
            yield ("method", "criterion"), "there are candidates, expected 'models'", self.method.criterion
        for block, given in (("parameters", self.parameters), ("correlations", self.correlations)):
            if given or self.source is not None:
                yield (block,), "those of each candidate are its own, expected none of the model", list(given)
                return
        first = True
        for spec, wrong in self.models_and_mistakes():
            yield from wrong
            if spec is None:
                continue
            if first:  # which the others are observed like
                yield from _mistakes_of_values(self.method, spec)
                first = False
            yield from self.mistakes_of_ranks(spec)


# --- what could be measured: of a specimen by its settings as far as these tell, and by its model ---------------------


def _mistakes_of_values(method: Design, spec: ModelSpec) -> Iterator[Mistake]:
    """Find what a design asks for that a model does not have; nothing where only its mesh knows."""
    values = known(spec) if spec.placed else of_outputs(spec)
    if values is None:
        return
    if not len(values):
        message = "nothing is observed, expected boundaries or points, or outputs of load cases"
        yield ("model", "observed"), message, ()
        return
    for key, message, given in method.mistakes(values):
        yield ("method", key), message, given


def of_outputs(spec: ModelSpec) -> Measurements:
    """Say what each output of a model is that is no specimen."""
    axes, names = dict(spec.axes_of_outputs), tuple(output.name for output in spec.returned)
    steps = [str(step) for step in axes["step"][1]] if "step" in axes else [""] * len(names)
    parts = [str(part) for part in axes["output_of"][1]] if "output_of" in axes else list(names)
    return Measurements.possible(names, np.full((len(names), 3), np.nan), steps, parts)


def known(spec: Any) -> Measurements | None:
    """Say what the values of a specimen are; None where nodes of a mesh from a file are observed."""
    nodes: dict[str, Any] = {item.on: _nodes(spec.body, item.on) for item in spec.observed if item.on is not None}
    if any(points is None for points in nodes.values()):
        return None
    rows = list(spec.rows(nodes.__getitem__))
    cases, names, axes, places = zip(*rows, strict=True) if rows else ((), (), (), ())
    return _possible(spec, names, np.array(places).reshape(-1, 3), cases, axes)


def _nodes(body: Any, on: str) -> FloatArray | None:
    """Places (n, 3) of the nodes of a side as they lie on a cube of cells of one size; None of other boundaries."""
    cells = getattr(body, "cells", None)
    if cells is None or len(cells) != len(AXES) or on not in SIDES:
        return None
    lines = [np.linspace(0.0, 1.0, body.degree * n + 1) for n in cells]
    axis, end = SIDES[on]
    lines[axis] = lines[axis][[end]]
    return np.asarray(np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3))


def values_of(spec: Any, model: Any) -> Measurements:
    """Say of each output of a model what it is and where it is measured."""
    if not spec.placed:
        return of_outputs(spec)
    return _possible(spec, model.outputs, model.places, model.cases, model.axes)


def _possible(
    spec: Any, names: Sequence[str], places: FloatArray, cases: Iterable[int], axes: Iterable[int]
) -> Measurements:
    """Return what could be measured of a specimen: displacements along axes, or other outputs of load cases."""
    of = [spec.cases[number] for number in cases]
    each = zip(axes, of, strict=True)
    parts = [AXES[k] if k < len(AXES) else case.outputs[k - len(AXES)].name for k, case in each]
    return Measurements.possible(names, places, [case.name for case in of], parts)


# --- files: a table, what other studies take of a specimen, and a form for the data ----------------------------------


def files(spec: ModelSpec, found: xr.Dataset) -> dict[str, str]:
    """Return a table of the chosen observations, and of a specimen what other studies take, by their names."""
    texts = {"design.csv": _table(found)}
    if spec.placed:
        blocks = (
            [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in one.items()]
            for one in observed(found)
        )
        lines = "".join(f"    {{ {', '.join(block)} }},\n" for block in blocks)
        texts["observed.toml"] = f"# What was chosen, for the block [model] of a specimen.\nobserved = [\n{lines}]\n"
        texts["observed.csv"] = _form(found)
    return texts


def _table(found: xr.Dataset) -> str:
    """The chosen observations in their order."""
    rows = [["order", "name", "case", "x", "y", "z", "measured", "cost", "gain", "information"]]
    for k, one in enumerate(found["chosen"].to_numpy()):
        at = found.isel(candidate=int(one), choice=k)
        place = ["" if np.isnan(x) else _metres(x) for x in at["candidate_place"].to_numpy()]
        words = [str(at[f"candidate_{what}"].item()) for what in ("case", "part")]
        numbers = [f"{float(at[what]):.6g}" for what in ("candidate_cost", "gain", "information")]
        rows.append([str(k + 1), str(at["candidate"].item()), words[0], *place, words[1], *numbers])
    return _csv(rows)


def observed(found: xr.Dataset) -> list[dict[str, Any]]:
    """Return blocks `model.observed` of the chosen displacements, in their order."""
    blocks = []
    for k, rows in enumerate(_rows(found)):
        cases: dict[tuple[tuple[float, ...], str], list[str]] = {}
        parts: dict[tuple[tuple[float, ...], str], str] = {}
        for row in rows:
            place = tuple(np.round(found["value_place"].to_numpy()[row], NEAR).tolist())
            case, part = (str(found[f"value_{what}"].to_numpy()[row]) for what in ("case", "part"))
            parts[place, case] = parts.get((place, case), "") + part
        for (place, case), components in parts.items():
            cases.setdefault((place, components), []).append(case)
        for i, ((place, components), where) in enumerate(cases.items()):
            name = f"{k + 1}" if len(cases) == 1 else f"{k + 1}-{i + 1}"
            blocks.append({"name": name, "at": [list(place)], "components": components, "cases": where})
    return blocks


def _rows(found: xr.Dataset) -> list[list[int]]:
    """Numbers of the displacements of each chosen candidate."""
    at = np.isfinite(found["value_place"].to_numpy()).all(axis=1)
    which = found["value_candidate"].to_numpy()
    return [np.flatnonzero((which == one) & at).tolist() for one in found["chosen"].to_numpy()]


def _form(found: xr.Dataset) -> str:
    """A table of data to be filled in: a row for each point in a load case, with the errors that were assumed."""
    rows = [["x", "y", "z", "ux", "uy", "uz", "sigma", "case", "output", "value", "sigma_value"]]
    sigma, which = found["value_sigma"].to_numpy(), found["value_candidate"].to_numpy()
    chosen = found["chosen"].to_numpy()
    displaced = {row for numbers in _rows(found) for row in numbers}
    for numbers in _rows(found):
        first: dict[tuple[str, ...], int] = {}
        for row in numbers:
            place = map(_metres, found["value_place"].to_numpy()[row])
            first.setdefault((*place, str(found["value_case"].to_numpy()[row])), row)
        rows += [[*place, "", "", "", f"{sigma[row]:.4e}", case, "", "", ""] for (*place, case), row in first.items()]
    for row in (row for one in chosen for row in np.flatnonzero(which == one).tolist() if row not in displaced):
        case, part = (str(found[f"value_{what}"].to_numpy()[row]) for what in ("case", "part"))
        rows.append([*[""] * 7, case, part, "", f"{sigma[row]:.4e}"])
    if all(not any(row[8:]) for row in rows[1:]):
        rows = [row[:8] for row in rows]
    return "# To be filled in: measured displacements (m) at the chosen points.\n" + _csv(rows)


def _metres(x: float) -> str:
    return f"{np.round(x, NEAR) + 0.0:.8g}"


def _csv(rows: Sequence[Sequence[str]]) -> str:
    file = io.StringIO()
    csv.writer(file, lineterminator="\n").writerows(rows)
    return file.getvalue()
