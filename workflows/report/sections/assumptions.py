"""What inversions and comparisons have taken for granted, and how far it moves their answers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from forward.readable import number, size, spoken
from workflows.report.blocks import Block, Folded, Heading, Table, Text
from workflows.report.section import Results, section
from workflows.report.sections.bodies import first

if TYPE_CHECKING:
    import xarray as xr

OPEN, SETS = 6, 12  # rows of a table that are not folded, and candidates that have one
SAID = (
    "What was not inferred is as stated. The table tells how many posterior deviations each answer moves if the truth "
    "is larger by so much; what is known worse than that moves it in proportion. Residuals cannot show it where the "
    "unknowns swallow the change."
)

ASKED = (
    "What the body could have beside what the model says of it, in the form that the data like best. p is the "
    "probability with which a right model makes one of all questions look as much called for; where it is at most "
    "{called:g} the evidence, and by how many posterior deviations each answer would be larger, are by Laplace's "
    "method with that in the model, else to first order. What stands after ± is what the data leave open."
)


@section("assumption_shift", heading="Taken for granted")
def taken_for_granted(results: Results) -> Iterator[Block]:
    """How far everything that was not inferred moves the answers, of each data set or candidate the largest first."""
    of = results.dataset
    yield Text(SAID)
    if "model" in of["assumption_shift"].dims:
        each = {str(name): of.sel(model=name).isel(group=0) for name in of["model"].values[:SETS]}
    else:
        each = {str(one.data_set.item()): one for one in first(results)}
    for name, one in each.items():
        if len(each) > 1:
            yield Heading(name, level=3)
        yield from _table(one)


def _table(one: xr.Dataset) -> Iterator[Block]:
    from inverse.criticism.assumptions import kept_in

    shifts = one["assumption_shift"].transpose("assumption", "parameter").to_numpy()
    if not np.isfinite(shifts).any():
        yield Text("Nothing is known: the model had no answer beside the mode.")
        return
    known = np.isfinite(one["assumption_size"].to_numpy()) & np.isfinite(shifts).any(axis=1)
    some = np.isfinite(shifts).any(axis=0)
    names, columns = [spoken(str(name)) for name in one["parameter"].values[some]], shifts[:, some]
    for name, words in {"stiffness": "stiffness, where it moves most", "log_evidence": "ln Z"}.items():
        if f"assumption_{name}" in one:
            names.append(words)
            columns = np.column_stack([columns, one[f"assumption_{name}"]])
    assumed, largest = kept_in(one), np.nanmax(np.abs(columns), axis=1, initial=0.0)
    order = np.flatnonzero(known)[np.argsort(-largest[known], kind="stable")]
    yield from _folded(names, [(str(assumed[k]), *(number(float(x), 2) for x in columns[k])) for k in order])
    if not known.all():
        yield Text("Of others nothing is known: the model had no answer beside the mode, or has no such number.")
    if "uncertain_mean" in one:
        yield Text("What is uncertain is counted. The data say of it, in its deviations (0 ± 1: nothing):")
        each = zip(*(one[f"uncertain{part}"].values.tolist() for part in ("", "_mean", "_std")), strict=True)
        yield Table(("uncertain", "larger by"), [(str(n), f"{number(z, 2)} ± {number(std, 2)}") for n, z, std in each])


@section("question_probability", heading="Questions to the shape")
def questions_to_shape(results: Results) -> Iterator[Block]:
    """What the body could have beside what the model says: whether data call for it, and what the answers would be."""
    from inverse.criticism.questions import CALLED

    yield Text(ASKED.format(called=CALLED))
    for one in first(results):
        if len(results.dataset["data_set"]) > 1:
            yield Heading(str(one["data_set"].item()), level=3)
        both = one[["question_move", "question_left"]].transpose("question", "parameter")
        moves, left = both["question_move"].to_numpy(), both["question_left"].to_numpy()
        some = np.isfinite(moves).any(axis=0)
        heads = [spoken(str(name)) for name in one["parameter"].values[some]]
        forms, rows = str(one["question_forms"].item()).split("; "), []
        for k in np.argsort(one["question_probability"].to_numpy(), kind="stable"):
            chances = (number(float(one[f"question_{which}"][k]), 2) for which in ("probability", "log_evidence"))
            larger = (f"{number(x, 2)} ± {number(d, 2)}" for x, d in zip(moves[k, some], left[k, some], strict=True))
            rows.append((f"{one['question'].values[k]}, {forms[k]}", *chances, *larger))
        yield Table(("what there could be", "p", "ln Z more", *heads), rows)


@section("assumption_change", heading="What nobody made uncertain")
def not_random(results: Results) -> Iterator[Block]:
    """How far outputs change at the mean with the numbers that are not random."""
    from inverse.criticism.assumptions import kept_in

    of, assumed = results.dataset, kept_in(results.dataset)
    yield Text("Changes of the outputs at the mean, to first order, if numbers that are not random are larger.")
    changes = of["assumption_change"].sel(output=results.drawn).transpose("assumption", "output").to_numpy()
    largest, units = np.abs(changes).max(axis=0, initial=0.0), [results.unit(name) for name in results.drawn]
    over = np.abs(np.divide(changes, largest, out=np.zeros(changes.shape), where=largest > 0)).max(axis=1, initial=0.0)
    rows = [
        (str(assumed[k]), *(size(float(x), unit, 3) for x, unit in zip(changes[k], units, strict=True)))
        for k in np.argsort(-over, kind="stable")
    ]
    yield from _folded(results.drawn, rows)


def _folded(changed: list[str], rows: list[tuple[str, ...]]) -> Iterator[Block]:
    """Show the first rows of what changes if something else was the case, and fold the others."""
    head = ("if …", *changed)
    yield Table(head, rows[:OPEN])
    if len(rows) > OPEN:
        yield Folded(f"{len(rows) - OPEN} more that move less", [Table(head, rows[OPEN:])])
