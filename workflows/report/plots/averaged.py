"""What candidates add to the variance of averaged predictions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from forward.model import FloatArray
from workflows.report.plots.figure import COLOURS, DARK, axes, text_of

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

SHOWN = 12  # outputs that have bars
PARTS = ("within", "between")


def within_and_between(predictions: Mapping[str, xr.Dataset], ax: Axes | None = None) -> Axes:
    """Draw a bar for each averaged prediction: the shares of its variance within the models and between them."""
    names = list(predictions)[:SHOWN]
    of = {part: np.array([float(predictions[name][f"average_{part}"]) for name in names]) for part in PARTS}
    return _bars(names, {"within the models": of["within"]}, "between them", of["between"], ax)


def parts_of_variance(dataset: xr.Dataset, ax: Axes | None = None) -> Axes:
    """Draw a bar for each output: the share of its variance within each candidate, and that between them."""
    outputs = [str(name) for name in dataset["output"].values][:SHOWN]
    some = dataset.sel(output=outputs)
    within = {}
    for name in dataset["candidate"].values:
        one = some.sel(candidate=name)
        share = float(one["candidate_probability"]) * one["candidate_std"] ** 2
        within[f"within {text_of(str(name))}"] = share.to_numpy()
    return _bars(outputs, within, "between", some["between"].to_numpy(), ax)


def _bars(
    names: Sequence[str], within: Mapping[str, FloatArray], label: str, between: FloatArray, ax: Axes | None
) -> Axes:
    """Draw a bar for each of some names: shares of parts (n,) within candidates, and of that between them."""
    ax = ax or axes(height=1.3 + 0.35 * len(names), width=7.0)
    left, places, whole = np.zeros(len(names)), np.arange(len(names))[::-1], sum(within.values()) + between
    colours = [COLOURS[i % len(COLOURS)] for i in range(len(within))]
    for (said, part), colour in zip([*within.items(), (label, between)], [*colours, DARK], strict=True):
        share = np.divide(part, whole, out=np.zeros(len(names)), where=whole > 0)
        ax.barh(places, share, left=left, height=0.7, color=colour, label=said)
        left = left + share
    ax.set_yticks(places, [text_of(name) for name in names])
    ax.set_xlim(0, 1)
    ax.set_xlabel("share of the variance")
    ax.legend(fontsize=7, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    return ax
