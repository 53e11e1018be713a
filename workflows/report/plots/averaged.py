"""What candidates add to the variance of averaged predictions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from workflows.report.plots.figure import COLOURS, DARK, axes, text_of

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

SHOWN = 12  # outputs that have bars


def within_and_between(predictions: Mapping[str, xr.Dataset], ax: Axes | None = None) -> Axes:
    """Draw a bar for each averaged prediction: the shares of its variance within the models and between them."""
    names = list(predictions)[:SHOWN]
    ax = ax or axes(height=1.3 + 0.35 * len(names), width=7.0)
    parts = [
        np.array([float(predictions[name][f"average_{part}"]) for name in names]) for part in ("within", "between")
    ]
    left, places, whole = np.zeros(len(names)), np.arange(len(names))[::-1], sum(parts)
    for part, colour, label in zip(parts, (COLOURS[0], DARK), ("within the models", "between them"), strict=True):
        share = np.divide(part, whole, out=np.zeros(len(names)), where=whole > 0)
        ax.barh(places, share, left=left, height=0.7, color=colour, label=label)
        left = left + share
    ax.set_yticks(places, [text_of(name) for name in names])
    ax.set_xlim(0, 1)
    ax.set_xlabel("share of the variance")
    ax.legend(fontsize=7, ncols=2, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    return ax


def parts_of_variance(dataset: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw a bar for each output: the share of its variance within each candidate, and that between them."""
    outputs = [str(name) for name in dataset["output"].values][:SHOWN]
    ax = ax or axes(height=1.3 + 0.35 * len(outputs), width=7.0)
    some = dataset.sel(output=outputs)
    whole = (some["within"] + some["between"]).to_numpy()
    parts = {
        f"within {text_of(str(one))}": (
            float(dataset["candidate_probability"].sel(candidate=one)) * some["candidate_std"].sel(candidate=one) ** 2
        ).to_numpy()
        for one in dataset["candidate"].values
    }
    left, places = np.zeros(len(outputs)), np.arange(len(outputs))[::-1]
    colours = [COLOURS[i % len(COLOURS)] for i in range(len(parts))]
    for (name, part), colour in zip(
        [*parts.items(), ("between", some["between"].to_numpy())], [*colours, DARK], strict=True
    ):
        share = np.divide(part, whole, out=np.zeros_like(whole), where=whole > 0)
        ax.barh(places, share, left=left, height=0.7, color=colour, label=name)
        left = left + share
    ax.set_yticks(places, [text_of(name) for name in outputs])
    ax.set_xlim(0, 1)
    ax.set_xlabel("share of the variance")
    ax.legend(fontsize=7, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    return ax
