"""The answer, before everything else: the question in words, and each number that was asked for."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from forward.readable import and_error, duration, interval, margin, number, percent, quantity, size, spoken, with_error
from uq.estimators.estimate import single
from uq.findings import NOT_KNOWN
from workflows.report.blocks import CURVE, Answer, Block, Card, Curve, Text, curve_of, smooth
from workflows.report.section import Results, section
from workflows.report.sections.cost import reduced_card
from workflows.report.sections.errors import counting, parts_of
from workflows.report.sections.frame import gravest, told
from workflows.report.sections.inversions import design_card, population_card
from workflows.report.sections.posterior import measured_kind
from workflows.results.comparison import bayes_factor, by_probability, grade, odds
from workflows.results.summary import NEITHER, leading

if TYPE_CHECKING:
    import xarray as xr

    from forward.model import FloatArray

ENDS = (0.025, 0.975)
LEAST = 40  # samples of which quantiles are told
TILES = 12  # answers; the others are in the tables
DRIVERS = 3  # parameters named in a line
UNSEEN = 0.1  # part of an error that is not worth a word: without it, the whole is less by half a percent
SAID = 0.02  # share of the variance that is worth a word
NAMED = 4  # names in a question
MODES = 2  # of a field, from which on they are named together
GOALS = 4  # predictions on the card
SEVERAL = 3  # candidates with lines of their own; the others are told together
WEIGHED = 1e-3  # probability, or weight in stacking, that is worth a line
LAPLACE = 0  # value of `source`, see docs/results.md


@section()
def answer_first(results: Results) -> Iterator[Block]:
    """What was asked and found, for every kind of study."""
    dataset = results.dataset
    card = next((card for has, card in CARDS.items() if has in dataset or has in dataset.dims), None)
    if card is not None:
        found = card(results)
        yield Card(found.question, found.answers[:TILES], [told(one) for one in gravest(results)])
        if len(found.answers) > TILES:
            yield Text(f"The other {len(found.answers) - TILES} are in the tables of the report.")


def forward(results: Results) -> Card:
    """Each output: its mean, spread, errors, and what drives it; at the mean parameters if nothing was sampled."""
    of = results.dataset
    sampled = "mean" in of
    names = gathered(results.parameters) if "parameter" in of.coords else []
    path = " at the last step of the path" if "step" in of.coords else ""
    first = leading(of, results.asked, TILES)
    outputs = sorted(results.asked, key=lambda output: output not in first)
    asked = listed([called(results, output) for output in outputs])
    be = "is" if len(outputs) == 1 else "are"
    uncertain = f"{listed(names)} {'is' if len(names) == 1 and ' modes of ' not in names[0] else 'are'} uncertain"
    if sampled:
        question = f"How large {be} {asked}{path}, {f'if {uncertain}' if names else 'by all candidates'}?"
    else:
        question = f"How do {listed(names)} change {asked}{path}?" if names else f"What {be} {asked}{path}?"
    spec = results.study.spec
    counts = counting(results) if spec.meshed else np.ones(len(results.outputs))
    own = getattr(spec, "errors", {})  # of a reduced model itself: what a mean may be off by at most
    name, answers = "mean" if sampled else "nominal", []
    sources = parts_of(results, name)
    for output in outputs:
        k, one, unit = results.outputs.index(output), results.of(output), results.unit(output)
        if not counts[k]:
            answers.append(Answer(called(results, output), "0", ("zero but for rounding",)))
            continue
        estimate, errors = single(one, name), {source: float(e[k]) for source, e in sources.items()}
        errors |= {"reduced model": own[output]} if output in own else {}
        spread, curve = distribution(one, unit) if sampled else ("", None)
        lines = [spread] if sampled else []
        lines += known(errors, unit, estimate.value, mesh=output not in results.meshes_unknown)
        if np.isfinite(estimate.corrected):
            lines.append(f"corrected for the mesh: {and_error(estimate.corrected, estimate.left, unit)}")
        lines += drivers(one, unit, sampled=sampled)
        shown = results.value(output, estimate.value, whole(errors))
        answers.append(Answer(called(results, output), shown, lines, curve))
    return Card(question, answers)


def gathered(paths: Sequence[str]) -> list[str]:
    """Name parameters, and all modes of a random field together: `fields.stiffness.0`, … are modes of the stiffness."""
    of = {path: path.split(".")[1] for path in paths if path.startswith("fields.") and path[-1].isdigit()}
    count = Counter(of.values())
    modes = {path: f"{count[name]} modes of the {name}" for path, name in of.items() if count[name] >= MODES}
    return list(dict.fromkeys(modes.get(path, spoken(path)) for path in paths))


def called(results: Results, output: str) -> str:
    """Return the name of an output; along a path, where all are those of the last step, without its number."""
    return str(results.dataset["output_of"].sel(output=output).item()) if "step" in results.dataset.coords else output


def whole(errors: dict[str, float]) -> float:
    """Return the total of errors by source: as estimated, otherwise the square root of the sum of squares."""
    total = errors.get("total", np.nan)
    parts = [e for source, e in errors.items() if source != "total" and np.isfinite(e)]
    return total if np.isfinite(total) else float(np.sqrt(np.sum(np.square(parts))))


def known(errors: dict[str, float], unit: str, value: float, *, mesh: bool) -> Iterator[str]:
    """Say how well a number is known, and the parts of its error; or that of its `mesh` it is not."""
    total = whole(errors)
    parts = {k: e for k, e in errors.items() if k != "total" and np.isfinite(e) and e >= UNSEEN * total}
    if total > 0:
        said = ", ".join(f"{source} {margin(e, unit, like=value)}" for source, e in parts.items())
        all_parts = f": {said}" if len(parts) > 1 else "".join(f" ({source})" for source in parts)
        error = f"± {margin(total, unit, like=value)}"
        yield f"known to {error}{all_parts}" if mesh else f"{NOT_KNOWN}; {error} without it{all_parts}"
    elif not mesh:
        yield NOT_KNOWN


def distribution(one: xr.Dataset, unit: str) -> tuple[str, Curve | None]:
    """Tell the 95 % interval of an output, and draw its density: by its expansion, its samples, or its deviation."""
    mean, sampled = float(one["mean"]), "values" in one and one["values"].dims == ("sample",)
    values = one["values"].to_numpy()[one["ok"].to_numpy() if "ok" in one else slice(None)] if sampled else np.zeros(0)
    drawn: tuple[FloatArray, FloatArray] | None = None
    if "density_edge" in one and np.isfinite(one["density"]).all():
        edges, density = one["density_edge"].to_numpy(), one["density"].to_numpy()
        reached = np.concatenate([[0], np.cumsum(density * np.diff(edges))])
        low, high = np.interp(ENDS, reached / reached[-1], edges).tolist()
        at = np.linspace(edges[0], edges[-1], CURVE)
        drawn = at, np.interp(at, (edges[1:] + edges[:-1]) / 2, density, left=0, right=0)
    elif len(values) >= LEAST:
        low, high = np.quantile(values, ENDS).tolist()
        drawn = smooth(values) if np.ptp(values) > 1e-12 * np.abs(values).max() else None
    else:
        reach = 1.96 * float(one["std"])
        return f"mean ± 1.96 std: {interval(mean - reach, mean + reach, unit, mean)}", None
    curve = None if drawn is None else curve_of(*drawn, (low, high), unit, mean)
    return f"95\u00a0%: {interval(low, high, unit, mean)}", curve


def drivers(one: xr.Dataset, unit: str, *, sampled: bool) -> Iterator[str]:
    """Say which parameters an output is driven by."""
    known = ("sobol_total", "shapley", "derivative_per_std")
    name = next((name for name in known if name in one and one[name].dims == ("parameter",)), None)
    if name is None:
        return
    effects, words = one[name].to_numpy(), "driven by"
    names = [spoken(str(p)) for p in one["parameter"].to_numpy()]
    if name == "derivative_per_std" and not sampled:
        largest = [(names[i], float(effects[i])) for i in np.argsort(-np.abs(effects))[:DRIVERS]]
        by = ", ".join(f"{parameter} by {'+' if x > 0 else ''}{size(x, unit)}" for parameter, x in largest)
        yield f"moved, by one standard deviation of: {by}"
        return
    if name == "derivative_per_std":
        effects, words = effects**2 / max(float((effects**2).sum()), 1e-300), "driven, to first order, by"
    order = [i for i in np.argsort(-effects)[:DRIVERS] if effects[i] >= SAID]
    if order and np.isfinite(effects).all():
        yield f"{words} {', '.join(f'{names[i]} ({percent(float(effects[i]))})' for i in order)}"


def inversion(results: Results) -> Card:
    """Each unknown: its posterior, and what it was before; of several data sets, how they went."""
    of, units = results.dataset, results.study.units_of("/")
    sets = [str(name) for name in of["data_set"].values]
    data = int(np.isfinite(of["measured"]).sum())
    whose = sets[0].replace("-", "\N{NON-BREAKING HYPHEN}") if len(sets) == 1 else f"each of {len(sets)} specimens"
    question = f"Which parameters explain {data:,} measured values of {whose}?"
    if of.attrs.get("quantity") != "output":
        question = f"What is inside {whose}, given {data:,} measured {measured_kind(of, results.study)}?"
    if len(sets) > 1:
        return Card(question, list(_sets(of, units)))
    if not bool(of["ok"].all()):
        return Card(question, [Answer(sets[0], "no answer", ("the data could not be inverted; the reason is below",))])
    one = of.isel(data_set=0)
    answers = [_unknown(one.sel(parameter=name), str(name), units.get(str(name), "1")) for name in one.parameter.values]
    if "stiffness_mean" in one and "draw" not in one:
        # The one number beside the values at the nodes is the mean of their logarithm.
        answers = [replace(a, name=a.name.replace("stiffness mean", "mean of ln stiffness")) for a in answers]
        answers = [_stiffness(one), *answers]
    if "prediction_share" in one:
        goals, unknown = {str(name): _goal(str(name)) for name in one["goal"].values}, results.meshes_unknown
        asked = listed([*goals.values()])
        question += f" And what {'is' if len(goals) == 1 else 'are'} {asked}, which nobody measured?"
        first = [_predicted(one.sel(goal=name), goals[name], name not in unknown) for name in [*goals][:GOALS]]
        answers = [*first, *answers]
    return Card(question, answers)


def _goal(name: str) -> str:
    """Name what is predicted: `press.target.0.x` is target x in press, `press.energy` is energy in press."""
    case, *parts = name.split(".")
    return f"{' '.join(part for part in parts if part != '0')} in {case}" if len(parts) in (1, 3) else name


def _predicted(at: xr.Dataset, name: str, known_mesh: bool) -> Answer:
    """A quantity that was not measured, by the posterior."""
    names = ("mean", "std", "lower", "upper", "prior_mean", "prior_std")
    mean, std, lower, upper, before, wide = (float(at[f"prediction_{which}"]) for which in names)
    unit, mesh = str(at["goal_unit"].item()), single(at, "prediction_mean").mesh
    if not np.isfinite(mean):
        return Answer(f"{name}, predicted", "no answer", ("it could not be predicted; the reason is below",))
    lines = [_interval(mean, std, lower, upper, unit)]
    if np.isfinite(before):
        lines.append(f"prior {and_error(before, wide, unit)}")
    if np.isfinite(mesh):
        lines.append(f"to be added for the mesh: {size(mesh, unit, like=mean)}")
    elif not known_mesh:
        lines.append(NOT_KNOWN)
    return Answer(f"{name}, predicted", quantity(mean, std, unit), lines, leads=True)


def _interval(mean: float, std: float, lower: float, upper: float, unit: str) -> str:
    """Write the ends of the interval that holds 95 %, and the standard deviation."""
    return f"95\u00a0%: {interval(lower, upper, unit, mean)}; ± {margin(std, unit, like=mean)}"


def _sets(of: xr.Dataset, units: dict[str, str]) -> Iterator[Answer]:
    """How many data sets were inverted, and each unknown over these."""
    done, count = int(of["ok"].sum()), of.sizes["data_set"]
    lines = [f"{int(((of['trust'] <= 1) & of['ok']).sum())} with a posterior to be trusted"]
    lines += [f"{count - done} could not be inverted"] if done < count else []
    yield Answer("inverted", f"{done} of {count}", lines)
    good = of.isel(data_set=np.flatnonzero(of["ok"].to_numpy()))
    for name in good.parameter.values if done else ():
        mean, std = (good[which].sel(parameter=name).to_numpy() for which in ("mean", "std"))
        unit, middle_ = units.get(str(name), "1"), float(np.median(mean))
        lines = [
            f"specimens from {interval(float(mean.min()), float(mean.max()), unit, middle_)}",
            f"each known to ± {margin(float(np.median(std)), unit, like=middle_)} (median)",
        ]
        yield Answer(f"{spoken(str(name))}, median", quantity(middle_, float(np.median(std)), unit), lines)


def _unknown(one: xr.Dataset, name: str, unit: str) -> Answer:
    by_laplace = "source" in one and int(one["source"]) == LAPLACE and int(one["trust"]) == NEITHER
    middle, label = ("mode", f"{spoken(name)}, by Laplace") if by_laplace else ("mean", spoken(name))
    mean, std, lower, upper = (float(one[which]) for which in (middle, "std", "lower", "upper"))
    before, wide = float(one["prior_mean"]), float(one["prior_std"])
    narrower = wide / std if std > 0 else np.inf
    said = f"{number(narrower, 2)} times as wide" if narrower > 1.05 else "the data say nothing of it"
    lines = [_interval(mean, std, lower, upper, unit), f"prior {and_error(before, wide, unit, like=mean)}: {said}"]
    if np.isfinite(true := float(one["true"])):
        lines.append(f"truth {size(true, unit, 4)}, {'inside' if lower <= true <= upper else 'outside'}")
    smoothed = smooth(one["draw"].to_numpy()) if "draw" in one and one["draw"].ndim == 1 else None
    drawn = None if smoothed is None else curve_of(*smoothed, (lower, upper), unit, mean)
    return Answer(label, quantity(mean, std, unit), lines, drawn)


def _stiffness(one: xr.Dataset) -> Answer:
    factors = np.exp(one["stiffness_mean"].to_numpy())
    std = one["stiffness_std"].to_numpy()
    place = ", ".join(size(float(x), "m", 3) for x in one["node_position"].to_numpy()[int(np.argmax(factors))])
    lines = [
        f"stiffest at ({place}), softest {number(float(factors.min()), 2)} times the typical stiffness",
        f"± {percent(float(np.median(np.expm1(std))))} at a typical node",
        f"{number(float(one['determined']), 3)} of {one.sizes['node']:,} directions determined",
    ]
    return Answer("largest stiffness factor", number(float(factors.max()), 2), lines)


def selection(results: Results) -> Card:
    """The candidates, the most probable first."""
    of = results.dataset
    order = by_probability(of, of["log_evidence"])
    data = int(np.isfinite(of["measured"]).sum()) if "measured" in of else of.sizes["output"]
    kinds = {"stress": "measured stresses", "displacement": "measured displacements"}
    kind = kinds.get(str(of.attrs.get("quantity")), "measured values")
    question = f"Which of {len(order)} models do {data:,} {kind} support?"
    answers, others = [], order[SEVERAL:] if len(order) > SEVERAL + 1 else []
    for rank, model in enumerate(order[: len(order) - len(others)]):
        one, lines = of.sel(model=model), []
        if float(one["probability"]) >= WEIGHED:
            lines.append(f"ln Z {with_error(float(one['log_evidence']), float(one['log_evidence_error']))}")
        if rank == 0 and len(order) > 1:
            ln_B, _ = bayes_factor(of, model, order[1])
            lines.append(f"{odds(ln_B)} over {order[1]}: {grade(abs(ln_B))}")
        elif rank > 1:  # of the second the first has said it
            lines.append(f"{odds(bayes_factor(of, order[0], model)[0])} against it")
        if "stacking" in one and float(one["stacking"]) >= WEIGHED:
            lines.append(f"stacking {percent(float(one['stacking']))}")
        if "mesh_checked" in one and not bool(one["mesh_checked"].all()):
            lines.append(NOT_KNOWN)
        elif not bool(one["trusted"].all()):
            lines.append("not to be trusted")
        answers.append(Answer(model, percent(float(one["probability"])), lines, leads=rank == 0))
    if others:
        chance = percent(float(of["probability"].sel(model=others).sum()))
        lines = [f"{odds(bayes_factor(of, order[0], others[0])[0])} against {others[0]}, no less against the others"]
        doubted = [model for model in others if not bool(of["trusted"].sel(model=model).all())]
        lines += [f"not to be trusted: {', '.join(doubted)}"] if doubted else []
        unseen = "mesh_checked" in of and not bool(of["mesh_checked"].sel(model=others).all())
        lines += [NOT_KNOWN] if unseen else []
        answers.append(Answer(f"the other {len(others)}", chance, lines))
    return Card(question, answers)


def compared(results: Results) -> Card:
    """The smallest error of each method in the mean of the first output, and what it takes."""
    output = results.outputs[0]
    found = {name: rows for name, rows in results.summary["methods"].items() if rows}
    best = {name: min(rows, key=lambda row: row["error"]) for name, rows in found.items()}
    answers: list[Answer] = []
    for name, row in sorted(best.items(), key=lambda item: item[1]["error"] ** 2 * item[1]["cpu_seconds"]):
        line = f"error with {number(row['cost'], 4)} solves, {duration(row['cpu_seconds'])}"
        answers.append(Answer(name, size(row["error"], results.unit(output)), (line,), leads=not answers))
    return Card(f"Which method finds the mean of {output} most exactly for its time?", answers)


def made(results: Results) -> Card:
    """How many data were made."""
    counts, name = np.isfinite(results.dataset["values"].to_numpy()).sum(axis=1), str(results.summary["study"])
    names = [name] if len(counts) == 1 else [f"{name}-{k}" for k in range(1, len(counts) + 1)]
    answers = [Answer(name, f"{n:,} data", ("in the folder data",)) for name, n in zip(names, counts, strict=True)]
    return Card("What would be measured of a specimen that is known?", answers)


# By a variable or dimension that only such results have, the first that is there.
CARDS: dict[str, Callable[[Results], Card]] = {
    "probability": selection,
    "alone_eigenvalue": inversion,
    "population_draw": population_card,
    "estimator": compared,
    "clean": made,
    "chosen": design_card,
    "mode_energy": reduced_card,
    "nominal": forward,
    "candidate_mean": forward,
}


def listed(names: Sequence[str]) -> str:
    """Write names in a sentence."""
    names = [*names[:NAMED], f"{len(names) - NAMED} others"] if len(names) > NAMED + 1 else names
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
