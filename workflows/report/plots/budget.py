"""The sources of the errors of estimates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from forward.words import number
from workflows.report.plots.figure import CONTROLLED, DARK, HIGH, PLAIN, axes, text_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from forward.model import FloatArray

PART_COLOURS = {"sampling": CONTROLLED, "mesh": HIGH, "solver": PLAIN, "total": DARK}
SHOWN = 12  # outputs that have bars
SPAN = 1e-5  # of the largest error: smaller ones have a number, but no bar, so that the others can be distinguished


def error_budget(names: list[str], parts: Mapping[str, FloatArray], of: str, ax: Axes | None = None) -> Axes:
    """Draw the errors of an estimate of each output by source, relative to the estimate.

    Parameters
    ----------
    names
        Of the outputs.
    parts
        Relative errors by their source (`PART_COLOURS`), an array over the outputs each; NaN where not estimated.
    of
        The estimate, in words.
    ax
        Where to draw.
    """
    from matplotlib.ticker import LogLocator, NullLocator

    names, parts = names[:SHOWN], {name: np.asarray(values)[:SHOWN] for name, values in parts.items()}
    ax = ax or axes(height=1.5 + (0.2 * len(parts) + 0.15) * len(names))
    places = np.arange(len(names))[::-1]
    height = 0.8 / len(parts)
    positive = [float(v) for values in parts.values() for v in values if np.isfinite(v) and v > 0]
    largest = max(positive, default=1.0)
    floor = max(min(positive, default=1.0), SPAN * largest)
    left = floor / 3
    for row, (name, values) in enumerate(parts.items()):
        at = places + 0.4 - (row + 0.5) * height
        drawn = np.where(values >= floor, values, left)
        ax.barh(at, drawn - left, left=left, height=0.9 * height, color=PART_COLOURS[name], label=name)
        for y, value, end in zip(at, values, drawn, strict=True):
            text = f"{number(100 * value, 2)} %" if np.isfinite(value) else "not estimated"
            ax.annotate(
                text if end > left else f"{name} {text}",
                (end, y),
                xytext=(3, 0),
                textcoords="offset points",
                va="center",
                fontsize=8,
                color=DARK if end > left else PART_COLOURS[name],
            )
    ax.set_xscale("log")
    ax.set_xlim(left, 8 * largest)
    ax.xaxis.set_major_locator(LogLocator(numticks=5))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(lambda x, _: f"{number(100 * x, 1)} %")
    ax.set_yticks(places, [text_of(name) for name in names])
    ax.set_ylim(-0.6, len(names) - 0.4)
    ax.set_xlabel(f"error of the {of}, relative to it")
    ax.legend(loc="lower right", bbox_to_anchor=(1.02, 1), ncols=len(parts), frameon=False, fontsize="small")
    return ax
