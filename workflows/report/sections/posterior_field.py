"""The posterior of a field of thousands of unknowns for each data set."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from forward.words import number
from workflows.report.blocks import Block, Pairs, Picture, Pictures
from workflows.report.plots import inversion as plots
from workflows.report.section import Results, Section
from workflows.report.sections.posterior import (
    again,
    amounts,
    cases,
    each_case,
    first,
    iterations,
    of_misfits,
    on_a_plane,
    posterior,
    verdict,
)

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes


class FieldPosterior(Section):
    """The posterior of a field for each data set."""

    def applies(self, results: Results) -> bool:
        """Whether a field was inferred."""
        return "alone_stiffness_std" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """The same for each of the first data sets."""
        for one in first(results):
            yield from verdict(results, one)
            yield from again(results, one)
            yield Pairs([*amounts(one, one.sizes["node"], results.study), *more_amounts(one)])
            yield posterior(one, results.study.units_of("/"))
            yield Pictures([Picture.drawn(ax, caption) for ax, caption in pictures(one)])
            alone = [of["alone_stiffness_std"].mean() for of in each_case(one)]
            widths = [[number(float(width), 3)] for width in (*alone, one["stiffness_std"].mean())]
            yield from cases(one, ["mean ± of ln stiffness"], widths)
            yield iterations(one)


def more_amounts(one: xr.Dataset) -> Iterator[tuple[str, list[str]]]:
    """The cost of the search, and how often the interval contains the truth, if known."""
    yield "Hessian products", [f"{int(one['products']):,}"]
    if np.isfinite(one["stiffness_true"]).all():
        inside = float((np.abs(one["stiffness_mean"] - one["stiffness_true"]) < 2 * one["stiffness_std"]).mean())
        yield "true ln stiffness within two standard deviations", [f"at {100 * inside:.0f} % of the nodes"]


def pictures(one: xr.Dataset) -> Iterator[tuple[Axes, str]]:
    """Draw the results for one data set, each with a caption."""
    cut = plots.Cut.of(one)
    yield from on_a_plane(one, cut)
    words = "What the data see: 0 where they determine the stiffness, 1 where it stays what the prior says,"
    yield plots.left_of_prior(one, cut), f"{words} on {cut.words}."
    words = "The directions that the data constrain most, and the last that were found"
    yield plots.direction_slices(one, cut), f"{words}, on {cut.words}."
    yield plots.alone_slices(one, cut), f"Standard deviation of ln stiffness by each load case alone, on {cut.words}."
    words = "Prior and posterior of ln stiffness where it is smallest, largest, and least certain"
    yield plots.node_marginals(one), f"{words}; the truth if known."
    yield of_misfits(one)
    if np.isfinite(one["stiffness_true"]).all():
        yield (
            plots.coverage(one),
            "Error at the nodes over the posterior standard deviation, and the standard normal density.",
        )
