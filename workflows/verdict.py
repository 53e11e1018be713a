"""What a comparison of models, or an inversion, says in sentences."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from forward.model import Finding
from inverse.weights import worth
from workflows.words import number, with_error

if TYPE_CHECKING:
    import xarray as xr

    from uq.evaluate import Evaluations

SUSPICIOUS = 0.01  # posterior predictive probability below which a model is in conflict with the data
GRADES = ((1.0, "not worth more than a bare mention"), (3.0, "positive"), (5.0, "strong"))


def grade(log_bayes_factor: float) -> str:
    """Return the word for ln B ≥ 0 (R. E. Kass, A. E. Raftery, J. Am. Stat. Assoc. 90 (1995) 773–795)."""
    return next((word for limit, word in GRADES if log_bayes_factor < limit), "very strong")


def ranking(values: xr.DataArray) -> list[str]:
    """Names of the models, the one with the largest value first."""
    return [str(name) for name in values.model.values[np.argsort(-values.to_numpy(), kind="stable")]]


def conflicts(dataset: xr.Dataset, model: str) -> list[str]:
    """Say in which way the residuals of a model are not what it says of them; nothing where they may be."""
    of_model = dataset.sel(model=model)
    asked = 2 * dataset.sizes["group"]
    said = []
    for name, words in (
        ("misfit_probability", "are larger than the errors"),
        ("correlation_probability", "follow one another along the tests, as errors would not"),
    ):
        chances = of_model[name]
        bad = [
            str(group) for group, p in zip(dataset.group.values, chances.values, strict=True) if p * asked < SUSPICIOUS
        ]
        if bad:
            where = f" in {', '.join(bad)}" if dataset.sizes["group"] > 1 else ""
            smallest = float(chances.min())
            said.append(f"{words}{where} ({_chance(smallest)})")
    return said


def findings(dataset: xr.Dataset) -> list[Finding]:
    """Say which model the data support, by how much, how sure that is and what it depends on."""
    order = ranking(dataset["log_evidence"])
    best = order[0]
    P = float(dataset["probability"].sel(model=best))
    said: list[Finding] = []
    if len(order) > 1:
        ln_B, error = bayes_factor(dataset, best, order[1])
        support = (
            f"{best} is the most probable of the candidates, with {number(100 * P, 4)} %; ln of the Bayes factor over "
            f"{order[1]}: {with_error(ln_B, error)}, {grade(ln_B)}."
        )
    else:
        support = f"{best} is the only candidate."
    said.append(Finding("note", support))
    wrong = conflicts(dataset, best)
    if wrong:
        said.append(Finding("warning", f"Best of bad models: the residuals of {best} {'; and '.join(wrong)}."))
    changed = []
    for variant in dataset.variant.values[1:]:
        other = ranking(dataset["variant_log_evidence"].sel(variant=variant))
        if other[0] != best:
            changed.append(f"{other[0]} with {variant}")
        elif other != order:
            said.append(
                Finding("note", f"With {variant}, {best} stays first but the order changes: {', '.join(other)}.")
            )
    if changed:
        said.append(Finding("warning", f"It depends: the most probable is {'; '.join(changed)}."))
    predicts = ranking(dataset["score"])[0]
    if predicts != best:
        said.append(Finding("warning", f"Left-out data are predicted best by {predicts}."))
    if "held_out_score" in dataset:
        predicts = ranking(dataset["held_out_score"].sum("left_out"))[0]
        if predicts != best:
            said.append(Finding("warning", f"Whole tests are predicted best, from the others, by {predicts}."))
    doubtful = _doubtful(dataset, order)
    if doubtful:
        text = f"Evidences not to be trusted: {', '.join(doubtful)}; more points may help (method.samples)."
        said.append(Finding("warning", text))
    return said


def _doubtful(dataset: xr.Dataset, order: list[str]) -> list[str]:
    """Evidences that cannot be trusted, each with what its weights are worth."""
    found = []
    for model in order:
        for group in dataset.group.values:
            one = dataset.sel(model=model, group=group)
            if not bool(one["trusted"]):
                where = f"{model} in {group}" if dataset.sizes["group"] > 1 else model
                count = int(np.isfinite(one["point"].to_numpy()).any(axis=-1).sum())
                found.append(f"{where} ({worth(float(one['tail']), float(one['effective']), count)})")
    return found


def findings_of_inversion(dataset: xr.Dataset) -> list[Finding]:
    """Say of each data set what stands and what does not."""
    said = []
    for name in dataset.data_set.values:
        one = dataset.sel(data_set=name)
        words, ok = str(one["why"].item()), bool(one["ok"])
        text = f"{name}: {words}" if ok else f"{name} could not be inverted: {words}"
        said.append(Finding("note" if ok and int(one["trust"]) == 0 else "warning", text))
    return said


def findings_of_solves(evaluations: Iterable[Evaluations]) -> list[Finding]:
    """Say how many solves were of parameters for which there is no model: they explain nothing, and did not fail."""
    every = list(evaluations)
    lost = [failure for found in every for failure in found.failures if failure.inadmissible]
    if not lost:
        return []
    solves = sum(len(found.points) for found in every)
    text = (
        f"{len(lost):,} of {solves:,} solves were of parameters for which there is no model, as for the first of them "
        f"({lost[0].reason}): their likelihood is zero, and they count as answered."
    )
    return [Finding("note", text)]


def bayes_factor(dataset: xr.Dataset, one: str, other: str) -> tuple[float, float]:
    """Return ln of the Bayes factor of one model over another, and its standard error."""
    values, errors = (dataset[name] for name in ("log_evidence", "log_evidence_error"))
    difference = float(values.sel(model=one) - values.sel(model=other))
    return difference, float(np.hypot(errors.sel(model=one), errors.sel(model=other)))


def _chance(p: float) -> str:
    return "p < 0.0003" if p < 3e-4 else f"p = {number(p, 2)}"
