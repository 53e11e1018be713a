"""What each source of errors takes of one tolerance for all of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from workflows.report.plots.budget import PART_COLOURS, SHOWN
from workflows.report.plots.figure import DARK, axes, text_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WORDS = {"mean": "mean", "std": "standard deviation"}
SOURCES = ("mesh", "sampling", "solver")


def tolerance_bars(told: Mapping[str, Any], ax: Axes | None = None) -> Axes:
    """Draw a bar for each estimate of each output: as long as its error is of the tolerance, divided by source.

    Errors add up in squares, and so the parts of a bar are as their squares.

    Parameters
    ----------
    told
        `accuracy` of summary.json.
    ax
        Where to draw.
    """
    rows = [
        (f"{text_of(name)}, {WORDS[estimate]}", parts)
        for name, of in list(told["outputs"].items())[:SHOWN]
        for estimate, parts in of.items()
    ]
    ax = ax or axes(height=1.4 + 0.3 * len(rows))
    places = range(len(rows))[::-1]
    lefts = [0.0] * len(rows)
    for source in SOURCES:
        widths = [
            parts["total"] * parts[source] ** 2 / max(sum(parts[one] ** 2 for one in SOURCES), 1e-300)
            for _, parts in rows
        ]
        ax.barh(places, widths, left=lefts, height=0.6, color=PART_COLOURS[source], label=source)
        lefts = [left + width for left, width in zip(lefts, widths, strict=True)]
    for place, left in zip(places, lefts, strict=True):
        ax.annotate(
            f"{100 * left:.0f} %", (left, place), xytext=(3, 0), textcoords="offset points", va="center", fontsize=8
        )
    ax.axvline(1.0, color=DARK, linewidth=1)
    ax.set_yticks(places, [label for label, _ in rows])
    ax.set_xlim(0, 1.12 * max(1.0, *lefts))
    ax.set_xlabel(f"share of the tolerance, {told['tolerance']:g}")
    ax.legend(loc="lower right", bbox_to_anchor=(1.02, 1), ncols=len(SOURCES), frameon=False, fontsize="small")
    return ax
