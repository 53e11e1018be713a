"""Whether the best model is a good one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from forward.words import NONE, number, with_error
from workflows.report.blocks import Block, Heading, Table, Text
from workflows.report.section import Results, Section
from workflows.studies.findings_selection import chance, conflicts, ranking

if TYPE_CHECKING:
    import xarray as xr


class Criticism(Section):
    """Predictions of left-out data, and residuals."""

    def applies(self, results: Results) -> bool:
        """Whether models were compared."""
        return "probability" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """Tables of scores."""
        yield Heading("Is the best one good?")
        yield Text(
            "Each datum is left out and predicted from the others, by weights that are judged in the same way; "
            "residuals are compared with those of a true model."
        )
        yield criticism(results.dataset)


def criticism(dataset: xr.Dataset) -> Table:
    """Predictive scores and checks."""
    rows = []
    for model in ranking(dataset["score"]):
        one = dataset.sel(model=model)
        behind = float(one["score_behind"])
        rows.append(
            (
                model,
                with_error(float(one["score"]), float(one["score_error"])),
                with_error(behind, float(one["score_behind_error"])) if behind else NONE,
                number(float(one["score_tail"]), 2),
                "yes" if bool(one["score_trusted"]) else "no",
                *(chance(float(one[f"{what}_probability"].min())) for what in ("misfit", "correlation")),
                "; ".join(conflicts(dataset, model)) or "none",
            )
        )
    head = (
        "model",
        "Σ ln p(left-out datum)",
        "behind the best",
        "largest k̂",
        "to be trusted",
        "p of larger residuals",
        "p of neighbours that agree more",
        "conflict",
    )
    return Table(head, rows, text=frozenset({0, 4, 7}), long=frozenset({7}))
