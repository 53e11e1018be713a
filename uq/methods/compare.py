"""Error against cost: methods at growing budgets, each with independent repeats, against a reference.

A repeat r of a method with n samples gives an estimate e_rn and the standard error that it claims. Over R repeats the
root mean square of e_rn − e*, with the reference value e*, is the true error of the method, whatever it claims; the
share of repeats whose claimed 95 % interval holds e* says whether its claims are honest. Plain Monte Carlo needs
(s/RMSE)² samples for the same error, where s² is the variance of one sample: σ² of the output for the mean.

Points that several methods or budgets ask for are solved once, and charged to each as if it had solved them itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError, model_serializer, model_validator

from forward.findings import Finding, Severity
from forward.model import FloatArray
from forward.registry import Kinds, OfKind
from forward.settings import Settings
from uq.estimators.estimate import ESTIMATED, Variables
from uq.estimators.moments import ESTIMATES
from uq.estimators.scores import rate, score
from uq.evaluation.request import OWN, Evaluate, Request
from uq.findings import add
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import random_points
from uq.methods.chaos import Chaos
from uq.methods.method import SAMPLING, Amount, Method, refuse
from uq.methods.trials import Memory, Trial, trial_of
from uq.surrogates.linearisation import Linearisation, linearise, local_dataset

if TYPE_CHECKING:
    import xarray as xr

    from forward.scalars import Mistake
    from forward.spec import ModelSpec, Times

COMPARED = Kinds("method", SAMPLING, Amount)  # methods that estimate moments from samples
# A reference is solved on a model of its own, which has no cheap ones beside it.
_ALONE = {kind: where for kind, where in SAMPLING.items() if kind != "multifidelity"}
REFERENCES = Kinds("method", {"given": "uq.methods.compare:Given", **_ALONE}, Method)
TIMES = ("cpu_seconds", "own_seconds", "plain_seconds", "textbook_seconds")  # results that a restart does not reproduce
ROUNDING = 16 * np.finfo(float).eps  # smallest relative error assumed for a reference
TIGHT, TEXTBOOK, REFINED = "tight", "textbook", "refined"  # names of the models beside the study's own
TIGHTER = 1e-3  # tolerances of the solver that makes the reference, relative to those of the study
# Severity of a finding of a comparison, and those of the methods' own that it repeats.
TOLD: tuple[tuple[Severity, set[str]], ...] = (("warning", {"error", "warning"}), ("note", {"note"}))


class Known(Settings):
    """Mean and standard deviation of an output with their standard errors, in the unit of the output."""

    mean: float
    std: Annotated[float, Field(gt=0)]
    mean_error: Annotated[float, Field(ge=0)] = 0.0
    std_error: Annotated[float, Field(ge=0)] = 0.0


class Given(Method):
    """Known reference values: the moments of every output, by name."""

    kind: Literal["given"] = "given"
    values: dict[str, Known]

    def planned(self, dimension: int) -> int:
        return 0

    def mistakes(self, inputs: Inputs, spec: ModelSpec) -> Iterator[Mistake]:
        """Find outputs whose moments are not given, and moments of unknown outputs."""
        outputs = [output.name for output in spec.returned]
        if set(self.values) != set(outputs):
            yield ("method", "values"), f"expected values of every output: {', '.join(outputs)}", list(self.values)

    def run(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        """Return the known values; errors as for every method."""
        import xarray as xr

        values = [self.values[name] for name in evaluate.outputs]
        return xr.Dataset({name: ("output", [dict(known)[name] for known in values]) for name in ESTIMATES})


class Entry(Settings):
    """A method to be compared: its block, with `budgets` instead of `samples`, and a `name` if needed.

    Parameters
    ----------
    name
        Name in results; the kind of the method by default.
    budgets
        Numbers of samples, each of which the method must admit.
    sampling
        The method with the first budget; its keys are beside `name` and `budgets`.
    """

    name: str = ""
    budgets: tuple[int, ...]
    sampling: Annotated[Amount, OfKind(COMPARED)]

    @property
    def label(self) -> str:
        """The name in results."""
        return self.name or self.sampling.kind

    def at(self, budget: int, seed: int = 0) -> Amount:
        """Return the method with so many samples, for its moments only."""
        kept = {"samples": budget, "seed": seed, **_moments_only(self.sampling)}
        return type(self.sampling).model_validate(self.sampling.model_dump() | kept)

    @model_validator(mode="before")
    @classmethod
    def _split(cls, value: Any) -> Any:
        """Separate the keys of the method."""
        if not isinstance(value, dict):
            return value
        expected = "expected different numbers of samples, such as [16, 32, 64]"
        if "budgets" not in value:
            raise ValueError(f"gives no budgets, {expected}")
        budgets = np.array(value["budgets"])
        whole = budgets.dtype.kind == "i" and budgets.ndim == 1 and (budgets >= 2).all()
        if not (whole and len(np.unique(budgets)) == budgets.size):
            raise ValueError(f"budgets = {budgets.tolist()}, {expected}")
        refused = [name for name in _NOT_ITS_OWN if name in value]
        if refused:
            raise ValueError(f"gives {' and '.join(refused)}, expected none: a comparison says it for all methods")
        own = {name: value[name] for name in ("name", "budgets") if name in value}
        rest = {name: item for name, item in value.items() if name not in own}
        return {**own, "sampling": {**rest, "samples": int(budgets[0])}}

    @model_validator(mode="after")
    def _check_budgets(self) -> Entry:
        for budget in self.budgets:
            try:
                self.at(budget)
            except ValidationError as error:
                reason = str(error.errors()[0]["msg"]).removeprefix("Value error, ")
                raise ValueError(f"budget {budget}: {reason}") from None
        return self

    @classmethod
    def __get_pydantic_json_schema__(cls, core: Any, handler: Any) -> Any:
        """Put the keys of each method beside those of the entry, as files have them."""
        reference = handler(core)
        entry = handler.resolve_ref_schema(reference)
        own = {name: entry["properties"][name] for name in ("name", "budgets")}
        methods = [handler.resolve_ref_schema(m) for m in entry["properties"]["sampling"]["anyOf"]]
        entry.clear()
        entry["oneOf"] = [
            method
            | {
                "properties": {k: v for k, v in method["properties"].items() if k not in _NOT_ITS_OWN} | own,
                "required": ["kind", "budgets"],
            }
            for method in methods
        ]
        return reference

    @model_serializer(mode="wrap")
    def _joined(self, handler: Any) -> dict[str, Any]:
        block: dict[str, Any] = handler(self)
        sampling = {name: item for name, item in block.pop("sampling").items() if name not in _NOT_ITS_OWN}
        return {"name": block["name"], **sampling, "budgets": block["budgets"]}


_NOT_ITS_OWN = ("samples", "tolerance", "budget_seconds", "seed", "quantiles", "fields")


def _moments_only(method: Method) -> dict[str, Any]:
    """Return the settings by which a method estimates only moments of outputs."""
    told: dict[str, Any] = {"fields": False, "quantiles": ()}
    return {name: value for name, value in told.items() if name in type(method).model_fields}


class Compare(Method):
    """Error against run time: methods at growing budgets, repeated, against a reference.

    Parameters
    ----------
    methods
        Blocks of methods with `budgets`, a list of numbers of samples, instead of `samples`.
    reference
        The source of reference values: a block of a method, which is solved to tighter tolerances, or values of
        ``kind = "given"``.
    repeats
        Independent repeats R of every method. Errors are known to 1/√(2R), 16 % for 20.
    seed
        Repeat r has the same points in every study with this seed.
    textbook
        Number of draws that are also solved by the textbook solver (Newton's method from zero with a new factor for
        every step), to find the cost of plain Monte Carlo with it, and the error due to the solver's tolerance. 0 for
        none.
    mesh_error
        Whether the body is also solved at the mean parameters with twice the cells in each direction: the difference
        shows where the mesh error dominates.
    """

    kind: Literal["compare"] = "compare"
    methods: tuple[Entry, ...]
    reference: Annotated[Method, OfKind(REFERENCES)] = Chaos(samples=256, max_order=8)
    repeats: Annotated[int, Field(ge=2)] = 20
    seed: Annotated[int, Field(ge=0)] = 0
    textbook: Annotated[int, Field(ge=0)] = 8
    mesh_error: bool = False

    @model_validator(mode="after")
    def _check_names(self) -> Compare:
        if not self.methods:
            raise ValueError("gives no methods, expected at least one")
        names = [entry.label for entry in self.methods]
        for name in dict.fromkeys(names):
            if names.count(name) > 1:
                raise ValueError(f"{names.count(name)} methods are called '{name}', expected different names")
        return self

    @property
    def open_ended(self) -> bool:
        """Methods that use the same points share them: fewer solves than planned may be enough."""
        return True

    def planned(self, dimension: int) -> int:
        shared: dict[tuple[object, ...], int] = {}
        apart = 0
        for entry in self.methods:
            stream, top = entry.sampling.stream(), max(entry.budgets)
            if stream is None:
                apart += sum(entry.at(budget).planned(dimension) - 1 for budget in entry.budgets)
            else:
                shared[stream] = max(shared.get(stream, 0), top)
                apart += entry.at(top).planned(dimension) - 1 - top
        reference = self.reference.planned(dimension)
        others = 2 * self.textbook + int(self.mesh_error)
        return 1 + reference + others + self.repeats * (sum(shared.values()) + apart)

    def objection(self, inputs: Inputs) -> str | None:
        methods = [self.reference, *(entry.sampling for entry in self.methods)]
        return next(filter(None, (method.objection(inputs) for method in methods)), None)

    def models(self, spec: ModelSpec) -> dict[str, ModelSpec]:
        """Return the model of the reference, that of the textbook, those of the methods and one on a finer mesh."""
        found = {TIGHT: spec.tighter(TIGHTER), TEXTBOOK: spec.textbook()}
        for entry in self.methods:
            found |= entry.sampling.models(spec)
        return found | ({REFINED: spec.refined(1)} if self.mesh_error else {})

    def unfit(self, spec: ModelSpec) -> Iterator[Mistake]:
        """Find that there is no mesh to refine."""
        if self.mesh_error and not spec.meshed:
            yield ("method", "mesh_error"), f"a model of kind '{spec.kind}' has no mesh, expected false", True
        named: dict[str, tuple[str, ModelSpec]] = {}
        for i, entry in enumerate(self.methods):
            wrong = list(entry.sampling.unfit(spec))
            for (_, *place), message, given in wrong:
                yield ("method", "methods", i, *place), message, given
            for name, model in {} if wrong else entry.sampling.models(spec).items():
                label, other = named.setdefault(name, (entry.label, model))
                if other != model or name in (TIGHT, TEXTBOOK, REFINED):
                    message = f"'{label}' has another model called '{name}', expected different names"
                    yield ("method", "methods", i, "cheap"), message, name

    def mistakes(self, inputs: Inputs, spec: ModelSpec) -> Iterator[Mistake]:
        yield from super().mistakes(inputs, spec)
        for i, entry in enumerate(self.methods):
            for (block, *place), message, given in entry.at(min(entry.budgets)).mistakes(inputs, spec):
                if place == ["samples"]:
                    yield ("method", "methods", i, "budgets"), message, list(entry.budgets)
                elif block == "method":
                    yield ("method", "methods", i, *place), message, given
        for (block, *place), message, given in self.reference.mistakes(inputs, spec):
            if block == "method":
                yield ("method", "reference", *place), message, given

    def seconds(self, dimension: int, costs: Mapping[str, Times]) -> float:
        own, samples = costs[OWN], self.planned(dimension) - 1 - self.textbook
        refined = costs[REFINED].first - own.sample if self.mesh_error else 0.0
        return samples * own.sample + refined + self.textbook * own.textbook

    def run(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        """Run all methods at all budgets, repeat by repeat, and compare.

        Returns
        -------
        xarray.Dataset
            The reference (`mean`, `mean_error`, …) by output; all estimates by row (a method at a budget) and repeat;
            true errors and costs by row; see docs/results.md. All but `TIMES` is the same after a restart.
        """
        refuse(self.objection(inputs))
        memory = Memory(evaluate)
        centre = linearise(inputs, memory)
        floors = self._floors(inputs, evaluate, memory, centre)
        method = self.reference.model_copy(update=_moments_only(self.reference))
        found = method.run(inputs, evaluate.on(TIGHT) if method.planned(len(inputs.names)) else evaluate)
        reference = {name: found[name].to_numpy() for name in ESTIMATES}
        rows = [(entry, budget) for entry in self.methods for budget in sorted(entry.budgets)]
        trials: list[list[Trial]] = [[] for _ in rows]
        for r in range(self.repeats):
            # The largest budget first: its one request includes the points of the others.
            for i, (entry, budget) in reversed(list(enumerate(rows))):
                trials[i].append(trial_of(entry.at(budget, _seed(self.seed, r)), inputs, memory))
        dataset = local_dataset(inputs, evaluate, centre, fields=False)
        dataset = dataset.assign(_compared(rows, trials, reference, floors))
        dataset = dataset.assign_coords(estimator=list(dict.fromkeys(dataset["row_method"].to_numpy().tolist())))
        budgets = f"{len(self.methods)} methods at {len(rows)} budgets"
        dataset.attrs["stopped"] = f"{budgets} in all, {self.repeats} repeats of each, as asked"
        add(dataset, *_doubts(rows, trials))
        lost = [trial.reason for row in trials for trial in row if trial.reason is not None]
        if lost:
            dataset.attrs["note"] = f"{len(lost)} repeats gave no estimate and are left out: {lost[0]}"
        return dataset

    def _floors(self, inputs: Inputs, evaluate: Evaluate, memory: Evaluate, centre: Linearisation) -> Variables:
        """Measure the errors of solver and mesh, and the cost of a plain solve, by the textbook and here."""
        m = len(evaluate.outputs)
        solver, mesh = np.full(m, np.nan), np.full(m, np.nan)
        plain = textbook = np.nan
        if self.textbook:
            cubes = random_points(_seed(self.seed, 0), 0, self.textbook, len(inputs.names))
            ours = memory(Request(inputs.points(cubes), start=centre.prediction))
            theirs = evaluate.on(TEXTBOOK)(Request(ours.points))
            both = ours.ok & theirs.ok
            if both.any():
                solver = np.sqrt(((ours.outputs - theirs.outputs)[both] ** 2).mean(axis=0))
                # The median: the first solve with a reference pays for its factor.
                plain, textbook = (float(np.median(found.seconds[both])) for found in (ours, theirs))
        if self.mesh_error:
            finer = evaluate.on(REFINED)(Request(inputs.mean[None, :]))
            mesh = np.abs(finer.outputs[0] - centre.outputs)
        return {
            "solver_error": (("output",), solver),
            "mesh_error": (("output",), mesh),
            "plain_seconds": ((), plain),
            "textbook_seconds": ((), textbook),
        }


def _seed(seed: int, repeat: int) -> int:
    """Seed of a repeat: the same for all methods, so that they may share their points."""
    return int(np.random.SeedSequence([seed, repeat]).generate_state(1)[0])


def _doubts(rows: Sequence[tuple[Entry, int]], trials: Sequence[Sequence[Trial]]) -> Iterator[Finding]:
    """Collect each method's findings about its own numbers, at which budgets and how often: a line for each severity.

    Errors become warnings here, since the numbers are compared with the reference.
    """
    for label in dict.fromkeys(entry.label for entry, _ in rows):
        own = [i for i, (entry, _) in enumerate(rows) if entry.label == label]
        runs = sum(len(trials[i]) for i in own)
        for severity, told_as in TOLD:
            told = [
                (rows[i][1], next(one for one in trial.doubts if one.severity in told_as))
                for i in own
                for trial in trials[i]
                if told_as & {one.severity for one in trial.doubts}
            ]
            if told:
                budgets = ", ".join(str(budget) for budget in dict.fromkeys(budget for budget, _ in told))
                who = f"{label} with {budgets} samples, {len(told)} of {runs} runs"
                yield replace(told[0][1], severity=severity).of(who)


def _compared(
    rows: Sequence[tuple[Entry, int]],
    trials: Sequence[Sequence[Trial]],
    reference: dict[str, FloatArray],
    floors: Variables,
) -> Variables:
    """Return reference, estimates, errors and costs as labelled arrays."""

    def each(pick: Callable[[Trial], Any]) -> FloatArray:
        return np.array([[pick(trial) for trial in row] for row in trials], dtype=float)

    names = [entry.label for entry, _ in rows]
    solves = np.median(each(lambda t: t.solves), axis=1)
    own = np.median(each(lambda t: t.own_seconds), axis=1)
    seconds = np.median(each(lambda t: t.seconds + t.own_seconds), axis=1)
    halves = each(lambda t: t.half_width)
    plain = [i for i, (entry, _) in enumerate(rows) if entry.sampling.kind == "monte-carlo"]
    # The cost of plain Monte Carlo with the textbook solver follows from its solves.
    textbook = float(floors["textbook_seconds"][1])
    derived = plain if np.isfinite(textbook) else []
    shown = [*range(len(rows)), *derived]
    labels = [*names, *(f"{names[i]}, textbook solver" for i in derived)]
    data: Variables = {
        "row_method": (("row",), labels),
        "budget": (("row",), np.array([budget for _, budget in rows])[shown]),
        "derived": (("row",), np.arange(len(shown)) >= len(rows)),
        "solves": (("row",), solves[shown].astype(np.int64)),
        "cpu_seconds": (("row",), np.concatenate([seconds, solves[derived] * textbook])),
        "own_seconds": (("row",), np.concatenate([own, np.zeros(len(derived))])),
        **floors,
    }
    rounding = ROUNDING * np.maximum(np.abs(reference["mean"]), reference["std"])
    by_output, by_row, by_repeat = ("output",), ("row", "output"), ("row", "repeat", "output")
    for name in ESTIMATED:
        value, error = reference[name], reference[f"{name}_error"]
        estimates, claims = (
            np.array([[trial.estimates[key] for trial in row] for row in trials]) for key in (name, f"{name}_error")
        )
        errors = estimates - value
        scored = score(errors, claims, halves, np.maximum(error, rounding))
        slopes = []
        for method in dict.fromkeys(labels):
            of_method = [shown[i] for i, label in enumerate(labels) if label == method]
            used = [[i for i in of_method if good[i]] for good in scored.resolved.T]
            slopes.append([rate(solves[i], errors[i, :, k]) for k, i in enumerate(used)])
        single = reference["std"]
        if name == "std":
            # The error of a standard deviation depends on the fourth moment, which plain Monte Carlo estimates.
            last = plain[-1] if plain else 0
            single = scored.claimed[last] * np.sqrt(rows[last][1]) if plain else np.full(value.shape, np.nan)
        rates = np.array(slopes)
        data |= {
            name: (by_output, value),
            f"{name}_error": (by_output, error),
            f"{name}_estimate": (by_repeat, estimates[shown]),
            f"{name}_estimate_error": (by_repeat, claims[shown]),
            **{f"{name}_{which}": (by_row, values[shown]) for which, values in scored._asdict().items()},
            f"{name}_single": (by_output, single),
            f"{name}_rate": (("estimator", "output"), rates[..., 0]),
            f"{name}_rate_error": (("estimator", "output"), rates[..., 1]),
        }
    return data
