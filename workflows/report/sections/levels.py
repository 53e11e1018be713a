"""Levels of multilevel chaos."""

from __future__ import annotations

from collections.abc import Iterator

from forward.words import number
from workflows.report import plots
from workflows.report.blocks import Block, Heading, Picture, Pictures, Table, Text
from workflows.report.section import Results, Section


class Levels(Section):
    """Costs and accuracy of the levels of multilevel chaos."""

    def applies(self, results: Results) -> bool:
        """Whether there are some."""
        return "level_change" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """A table, a picture, and the moments by control variates."""
        yield Heading("Levels")
        yield Text(
            "Every level starts its samples from the expansion of the previous level. Residuals are relative to the "
            "loads."
        )
        yield levels(results)
        caption = "Residuals at the samples, relative to the loads, and relative change of the moments, level by level."
        yield Pictures([Picture.drawn(plots.levels(results.dataset), caption)])
        yield Text(
            "Moments from the samples of the last level, with the expansion of the previous level, which does not "
            "depend on them, as control variate; the distance between these and the moments of the expansion is part "
            "of the errors of the latter."
        )
        yield controlled(results)


def levels(results: Results) -> Table:
    """Costs and accuracy of the levels of multilevel chaos."""
    rows = []
    for k in results.dataset["level"].to_numpy():
        level = results.dataset.sel(level=k)
        work = {str(name): int(level["level_work"].sel(operation=name)) for name in level["operation"].to_numpy()}
        iterations = int(level["level_iterations"])
        rows.append(
            (
                f"{k}",
                f"{iterations}" if iterations else "to the tolerance",
                f"{int(level['level_solves'])}",
                f"{int(level['level_converged'])}",
                number(float(level["level_residual"]), 2),
                number(float(level["level_residual_median"]), 2),
                number(float(level["level_change"]), 2),
                *(f"{work[name]:,}" for name in ("residuals", "back_substitutions", "factorisations")),
            )
        )
    head = (
        *("level", "iterations", "samples", "at equilibrium", "largest residual", "median residual"),
        *("change of the moments", "residuals", "back-substitutions", "factorisations"),
    )
    return Table(head, rows)


def controlled(results: Results) -> Table:
    """Moments from the samples of the last level, with the expansion of the previous level as control variate."""
    names = ("control_mean", "control_std")
    rows = [(output, *(results.estimate(output, name) for name in names)) for output in results.outputs]
    return Table(("output", "mean", "standard deviation"), rows)
