"""Predictions averaged over candidates: of each, of all, and what varies within them and between them."""

from __future__ import annotations

from collections.abc import Iterator

from forward.readable import and_error
from workflows.report import plots
from workflows.report.blocks import Block, Heading, Picture, Pictures, Table, Text
from workflows.report.section import Results, Section


class AveragedCandidates(Section):
    """A table for each output, and a bar of the parts of its variance."""

    def applies(self, results: Results) -> bool:
        """Whether candidates were averaged."""
        return "candidate_mean" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """The tables, then the bars."""
        of = results.dataset
        yield Heading("Averaged over candidates")
        stacked = of.attrs.get("weights") == "stacked"
        what = "weight in the mixture that predicts left-out data best" if stacked else "probability"
        yield Text(
            f"Each candidate predicts with its own posterior, and counts by its {what}. The variance is that "
            "within the candidates, and that between their means: what it matters which of them is right."
        )
        for output in results.drawn:
            unit, rows = results.unit(output), []
            for name in map(str, of["candidate"].values):
                one = of.sel(candidate=name, output=output)
                share = f"{100 * float(one['candidate_probability']):.3g} %"
                cells = [
                    and_error(float(one[f"candidate_{m}"]), float(one[f"candidate_{m}_error"]), unit) for m in MOMENTS
                ]
                rows.append((name, share, *cells))
            rows.append(("all", "100 %", *(results.estimate(output, m) for m in MOMENTS)))
            yield Heading(output, level=3)
            yield Table(("candidate", "weight" if stacked else "probability", "mean", "standard deviation"), rows)
        caption = "Parts of the variance: within each candidate, by what it counts, and between candidates."
        yield Pictures([Picture.drawn(plots.parts_of_variance(of), caption)])


MOMENTS = ("mean", "std")
