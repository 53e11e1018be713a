"""One tolerance for all errors: whether it is kept, what each takes of it and costs, and why it was split so."""

from __future__ import annotations

from collections.abc import Iterator

from forward.readable import and_error
from forward.words import number
from workflows.report import plots
from workflows.report.blocks import Block, Heading, Pairs, Picture, Pictures, Table, Text
from workflows.report.section import Results, Section

WORDS = {"mean": "mean", "std": "standard deviation"}


class Tolerance(Section):
    """The budget of a tolerance."""

    def applies(self, results: Results) -> bool:
        """Whether one was asked for."""
        return "accuracy" in results.summary

    def content(self, results: Results) -> Iterator[Block]:
        """A sentence, bars, the reasons, and the values that the tolerance is held by."""
        told = results.summary["accuracy"]
        worst = f"the {told['worst']['of']} of {told['worst']['output']}"
        yield Heading("Tolerance")
        asked, reached = number(100 * told["tolerance"]), number(100 * told["reached"], 2)
        yield Text(
            f"Asked for: {asked} % of every mean and standard deviation, all errors together, at 95 %. "
            f"{'Kept' if told['kept'] else 'Not kept'}: {worst} is known to {reached} %, no other less well.",
            tone="lead" if told["kept"] else "warning",
        )
        for name, share in told.get("unmet", {}).items():
            yield Text(
                f"All samples of {name} are the same: what happens in up to {number(100 * share, 2)} % of all cases "
                "may be missed.",
                tone="warning",
            )
        if told["mesh"] is not None and not told["mesh"]["estimated"]:
            yield Text("The error of the mesh is not known, and not counted.", tone="warning")
        yield Pictures([Picture.drawn(plots.tolerance_bars(told), "What each error takes of the tolerance.")])
        seconds = results.summary.get("accuracy_seconds", {})
        costs = [f"{source}: {number(value, 3)} s of processor time" for source, value in seconds.items()]
        yield Pairs([("why", told["reasons"]), *([("what it took", costs)] if costs else [])])
        yield Table(
            ("estimate", "value ± 95 %", "mesh", "sampling", "in all"),
            [
                (
                    f"{WORDS[estimate]} of {name}",
                    and_error(of["value"], of["error"], results.unit(name)),
                    *(f"{100 * of[source]:.2g} %" for source in ("mesh", "sampling", "total")),
                )
                for name, estimates in told["outputs"].items()
                for estimate, of in estimates.items()
            ],
        )
        if told["mesh"] is not None:
            yield Text("Values are corrected by the estimated error of the mesh. Shares are of the tolerance.")
