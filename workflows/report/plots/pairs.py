"""Parameters in pairs: contours of their joint density, each alone on the diagonal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from forward.model import FloatArray
from workflows.report.plots.figure import DARK, HIGH, axes, span

if TYPE_CHECKING:
    from matplotlib.axes import Axes

HELD = (0.9, 0.5)  # of the probability: within the contours
LATTICE = 40  # points along an axis at which densities are computed
DOTS = 160  # draws shown in each pair
CURVE = 120  # points of a density on the diagonal


def pairs(
    columns: Mapping[str, FloatArray],
    weights: FloatArray,
    colour: str,
    *,
    worth: float | None = None,
    modes: Sequence[float] = (),
    truths: Sequence[float] = (),
) -> Axes:
    """Draw the densities of parameters by draws with weights (n,).

    Parameters
    ----------
    columns
        Draws (n,) by what is written at the axes.
    weights
        How much each counts.
    colour
        Of densities.
    worth
        Number of independent draws that they are worth, if it is not told by the weights.
    modes, truths
        The most probable values, and the true ones if known (NaN otherwise), in the order of the columns.
    """
    names, n = list(columns), len(columns)
    first = axes(height=1.0 + 1.25 * n, width=1.4 + 1.45 * n)
    figure = first.get_figure(root=True)
    assert figure is not None
    first.remove()
    # Places by hand: a layout that looks at every label takes longer than all densities.
    figure.set_layout_engine(None)
    wide, high = figure.get_size_inches()
    figure.subplots_adjust(0.75 / wide, 0.55 / high, 1 - 0.1 / wide, 1 - 0.1 / high, 0.12, 0.12)
    places = figure.add_gridspec(n, n)
    tops: list[Axes] = []  # of the columns, which share their axis
    used = weights > 1e-6 * weights.max()
    shares = weights[used] / weights[used].sum()
    draws = [np.asarray(columns[name])[used] for name in names]
    ends = [_wide(span(x, shares), truth) for x, truth in zip(draws, [*truths, *[np.nan] * n], strict=False)]
    for i, j in [(row, column) for row in range(n) for column in range(row + 1)]:
        ax = figure.add_subplot(places[i, j], sharex=tops[j] if j < i else None)
        tops += [ax] * (i == j)
        if i == j:
            at = np.linspace(*ends[i], CURVE)
            ax.fill_between(
                at, density(draws[i][:, None], shares, at[:, None], worth), color=colour, alpha=0.5, linewidth=0
            )
            ax.set_yticks([])
            ax.set_ylim(bottom=0)
        else:
            _contours(ax, np.stack([draws[j], draws[i]], axis=1), shares, worth, (ends[j], ends[i]), colour)
            ax.set_ylim(ends[i])
            ax.locator_params(axis="y", nbins=4)
        for values, line in ((modes, DARK), (truths, HIGH)):
            if len(values) and np.isfinite(values[j]):
                ax.axvline(values[j], linewidth=0.9, color=line)
                if i != j:
                    ax.axhline(values[i], linewidth=0.9, color=line)
        ax.set_xlim(ends[j])
        ax.locator_params(axis="x", nbins=3)
        ax.tick_params(labelsize="x-small", labelbottom=i == n - 1)
        ax.spines[["top", "right"]].set_visible(False)
        if i == n - 1:
            ax.set_xlabel(names[j], fontsize="small")
        if j == 0 and i > 0:
            ax.set_ylabel(names[i], fontsize="small")
        elif j > 0:
            ax.tick_params(labelleft=False)
    return tops[0]


def density(draws: FloatArray, shares: FloatArray, at: FloatArray, worth: float | None = None) -> FloatArray:
    """Return the density (m,) at points (m, d) of draws (n, d) with shares (n,) that add up to one.

    Gaussian kernels with Scott's share of the covariance of the draws, counted by their effective number, or by
    `worth`, the number of independent ones that they stand for.
    """
    d = draws.shape[1]
    off = draws - shares @ draws
    covariance = (shares[:, None] * off).T @ off
    scales = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    covariance = covariance / np.outer(scales, scales) + 1e-9 * np.eye(d)
    width = (float((shares**2).sum()) if worth is None else 1 / max(worth, 2.0)) ** (1 / (d + 4))
    root = np.linalg.cholesky(covariance) * width
    whitened, places = (np.linalg.solve(root, ((x - shares @ draws) / scales).T).T for x in (draws, at))
    square = (places**2).sum(axis=1)[:, None] + (whitened**2).sum(axis=1) - 2 * places @ whitened.T
    norm = np.sqrt(2 * np.pi) ** d * np.prod(np.diag(root)) * np.prod(scales)
    return np.asarray(np.exp(-square / 2) @ shares / norm)


def levels(values: FloatArray, shares: Sequence[float] = HELD) -> list[float]:
    """Return the heights of a density (any shape) on a lattice above which it has these shares of its integral."""
    ordered = np.sort(values.ravel())[::-1]
    reached = np.cumsum(ordered) / ordered.sum()
    return [float(ordered[min(int(np.searchsorted(reached, share)), len(ordered) - 1)]) for share in shares]


def _contours(
    ax: Axes,
    draws: FloatArray,
    shares: FloatArray,
    worth: float | None,
    ends: Sequence[tuple[float, float]],
    colour: str,
) -> None:
    first, second = (np.linspace(*end, LATTICE) for end in ends)
    lattice = np.stack([one.ravel() for one in np.meshgrid(first, second)], axis=1)
    found = density(draws, shares, lattice, worth).reshape(LATTICE, LATTICE)
    heights = levels(found)
    top = 1.01 * float(found.max())
    if heights[0] < heights[1] < top:
        ax.contourf(first, second, found, levels=[*heights, top], colors=[colour, colour], alpha=0.3)
        ax.contour(first, second, found, levels=heights, colors=[colour], linewidths=1)
    # As many dots as can be told apart, by their weights: the first of a fixed, evenly spread order.
    at = np.searchsorted(np.cumsum(shares), (np.arange(DOTS) + 0.5) / DOTS).clip(max=len(draws) - 1)
    chosen = np.unique(at)
    ax.plot(*draws[chosen].T, ".", color=colour, markersize=2, alpha=0.5)


def _wide(ends: tuple[float, float], truth: float) -> tuple[float, float]:
    """Move the ends of an axis so that they hold the truth, unless it is far away."""
    low, high = ends
    wide = high - low
    if low - wide < truth < high + wide:
        return min(low, truth - 0.05 * wide), max(high, truth + 0.05 * wide)
    return ends
