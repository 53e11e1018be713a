"""A reduced model that was made of a body: how well it follows it, and what it is made of."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from forward.readable import percent, size
from forward.words import duration, number
from workflows.report.blocks import Answer, Block, Card, Heading, Pairs, Pictures, Table, Text
from workflows.report.plots import accuracy as plots
from workflows.report.section import Results, section


@section(when=lambda results: "reduced" in results.summary)
def reduced_model_of_body(results: Results) -> Iterator[Block]:
    """Errors on unseen samples, and how the model is made."""
    told, found = results.summary["reduced"], results.dataset
    drawn = []
    if told.get("errors"):
        yield from _errors(told)
        if told["unseen"] > 1:
            caption = "Estimated against true errors at the unseen samples, over the root mean square of each output."
            drawn.append((plots.estimates(found), caption))
    else:
        yield Text("Nobody has measured how well it follows the body, with no unseen samples (method.unseen).")
    drawn.append((plots.energies(found, told["modes"]), "The part of the snapshots that so many modes leave out."))
    yield Pictures.of(*drawn)
    yield Heading("What it is made of")
    file, seconds = told["file"], told["seconds"]
    use = f"model = {{ kind = 'reduced', file = '{file}' }} in any study"
    yield Pairs(
        [
            ("snapshots", [f"{told['snapshots']:,} solves of the body, {told['unknowns']:,} unknowns"]),
            ("modes", [f"{told['modes']}; {told['modes of the larger model']} of the model that tells the errors"]),
            ("points of the material", [f"{told['points']:,}"]),
            ("made in", [duration(seconds["snapshots"] + seconds["reduction"]) + " of processor time"]),
            ("use it", [f"tissuq live {file}: a page with sliders", use]),
        ]
    )


def _errors(told: Mapping[str, Any]) -> Iterator[Block]:
    """A table of the errors on unseen samples."""
    yield Heading("How well it follows the body")
    yield Text(
        f"Errors on {told['unseen']} samples that the model has not seen: their root mean square over the spread "
        "of each output, and what the correction by the residual leaves of them. The effectivity is the estimated "
        "over the true error; where it is 1, estimates can be taken for the errors."
    )
    left = {name: percent(error) for name, error in told.get("errors after correction", {}).items()}
    shares = {name: f"{share:.2f}" for name, share in told.get("effectivity", {}).items()}
    rows = [
        (name, percent(error), left.get(name, "–"), shares.get(name, "–"))
        for name, error in told.get("errors", {}).items()
    ]
    yield Table(("output", "error", "after the correction", "effectivity"), rows)


def card(results: Results) -> Card:
    """How small the model is, and how large its errors are."""
    told = results.summary["reduced"]
    lines = [f"instead of {told['unknowns']:,} unknowns", f"from {told['snapshots']} solves", f"in {told['file']}"]
    own, full = (1e3 * told["seconds"].get(f"{which} solve", math.nan) for which in ("reduced", "full"))
    if math.isfinite(own):
        lines.insert(1, f"a solve takes {number(own, 2)} ms, one of the body {number(full, 2)} ms")
    answers = [Answer("reduced model", f"{told['modes']} modes", lines)]
    for name, error in told.get("errors", {}).items():
        if name not in told.get("effectivity", {}):
            answers.append(
                Answer(f"error of {name}", percent(error), ["of its spread; nothing estimates or corrects it"])
            )
            continue
        left = told["errors after correction"][name]
        true, estimated = (results.dataset[f"reduced_{w}"].sel(output=name) for w in ("error", "estimate"))
        rms = float(((true - estimated) ** 2).mean() ** 0.5)
        lines = [
            f"of its spread, or {size(rms, results.unit(name))}, once corrected by the residual",
            f"{percent(error)} without the correction",
            f"estimated over true error: {told['effectivity'][name]:.2f}",
        ]
        answers.append(Answer(f"error of {name}", percent(left), lines))
    return Card("How well does a reduced model follow the body?", answers)
