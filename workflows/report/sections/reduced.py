"""A reduced model that was made of a body: how well it follows it, and what it is made of."""

from __future__ import annotations

from collections.abc import Iterator

from forward.readable import percent, size
from forward.words import duration, number
from workflows.report.blocks import Answer, Block, Card, Heading, Pairs, Picture, Pictures, Table, Text
from workflows.report.plots import reduced as plots
from workflows.report.section import Results, Section


class ReducedModelOfBody(Section):
    """Errors on unseen samples, and how the model is made."""

    def applies(self, results: Results) -> bool:
        """Whether one was made."""
        return "reduced" in results.summary

    def content(self, results: Results) -> Iterator[Block]:
        """A table and pictures of the errors, then sizes."""
        told, found = results.summary["reduced"], results.dataset
        yield Heading("How well it follows the body")
        yield Text(
            f"Errors on {told['unseen']} samples that the model has not seen, root mean square, relative to the spread "
            "of each output; what the correction by the residual leaves of them; and the effectivity, the estimated "
            "over the true error, which is 1 where estimates can be taken for the errors."
        )
        rows = [
            (
                name,
                *(percent(told[which][name]) for which in ("errors", "errors after correction")),
                number(told["effectivity"][name], 3),
            )
            for name in told.get("errors", ())
        ]
        yield Table(("output", "error", "after the correction", "effectivity"), rows)
        drawn = []
        if told["unseen"] > 1:
            caption = "Estimated against true errors at the unseen samples, over the root mean square of each output."
            drawn.append(Picture.drawn(plots.estimates(found), caption))
        drawn.append(
            Picture.drawn(
                plots.energies(found, told["modes"]), "The part of the snapshots that is in modes beyond a number."
            )
        )
        yield Pictures(drawn)
        yield Heading("What it is made of")
        file = told["file"]
        yield Pairs(
            [
                ("snapshots", [f"{told['snapshots']:,} solves of the body, {told['unknowns']:,} unknowns"]),
                ("modes", [f"{told['modes']}; {told['modes of the larger model']} of the model that tells the errors"]),
                ("points of the material", [f"{told['points']:,}"]),
                ("made in", [duration(sum(told["seconds"].values())) + " of processor time"]),
                (
                    "use it",
                    [
                        f"tissuq live {file}: a page with sliders",
                        f"model = {{ kind = 'reduced', file = '{file}' }} in any study",
                    ],
                ),
            ]
        )


def card(results: Results) -> Card:
    """How small the model is, and how large its errors are."""
    told = results.summary["reduced"]
    lines = [f"instead of {told['unknowns']:,} unknowns", f"from {told['snapshots']} solves", f"in {told['file']}"]
    answers = [Answer("reduced model", f"{told['modes']} modes", lines)]
    for name, error in told.get("errors", {}).items():
        left = told["errors after correction"][name]
        true, estimated = (results.dataset[f"reduced_{w}"].sel(output=name) for w in ("error", "estimate"))
        rms = float(((true - estimated) ** 2).mean() ** 0.5)
        lines = [
            f"of its spread ({size(rms, results.unit(name))}), corrected by the residual",
            f"{percent(error)} without the correction",
            f"its own estimates of errors are {number(told['effectivity'][name], 2)} times the true ones",
        ]
        answers.append(Answer(f"error of {name}", percent(left), lines))
    return Card("How well does a reduced model follow the body?", answers)
