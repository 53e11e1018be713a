"""Figures of the theory pages, drawn by the program's own functions: ``python docs/figures.py``."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from forward.terms.tools import NUMPY, pressure
from workflows.report.plots.figure import CONTROLLED, DARK, HIGH, PLAIN, grid, svg

HERE = Path(__file__).parent / "theory"


def contact_law() -> None:
    """Draw the pressure over the gap and its complementarity, in units of the width."""
    g = np.linspace(-1.5, 1.2, 400)
    left, right = grid(2, 2, (3.4, 2.8))
    left.plot(g, pressure(NUMPY, g, 1.0, 1.0), color=CONTROLLED, label="p, as it is computed")
    left.plot(g, np.maximum(-g, 0), color=DARK, linestyle="--", linewidth=1, label="εg without the smooth part")
    left.axvspan(-0.5, 0.5, color=PLAIN, alpha=0.15, linewidth=0)
    left.set_xlabel("gap g / w")
    left.set_ylabel("pressure p / (ε w)")
    left.legend(fontsize="small", frameon=False)
    outside = np.linspace(0, 0.6, 200)
    right.plot(outside, outside * pressure(NUMPY, outside, 1.0, 1.0), color=HIGH)
    right.axhline(1 / 108, color=DARK, linestyle="--", linewidth=1, label="1/108")
    right.set_xlabel("gap g / w")
    right.set_ylabel("p g / (ε w²)")
    right.legend(fontsize="small", frameon=False)
    (HERE / "contact-law.svg").write_bytes(svg(left))


def extrapolation() -> None:
    """Draw how two meshes with their own estimates tell the limit, for an error h^1.5 of which e sees 0.65."""
    from matplotlib.ticker import NullLocator

    (ax,) = grid(1, 1, (4.6, 3.0))
    h, order, seen = np.array([1.0, 0.5]), 1.5, 0.65
    exact = 1.0
    coarse = exact - 0.2 * h**order
    richer = coarse + seen * (exact - coarse)
    s = 0.5**order
    limit = richer[1] + s / (1 - s) * (richer[1] - richer[0])
    assert abs(limit - exact) < 1e-12
    for at, low, high in zip(h, coarse, richer, strict=True):
        ax.annotate("", (at, high), (at, low), arrowprops={"arrowstyle": "->", "color": HIGH})
    ax.plot(h, coarse, "o", color=CONTROLLED, label="on the mesh: ψ")
    ax.plot(h, richer, "s", color=HIGH, label="with one degree more: ψ + e")
    x = np.linspace(0, 1, 100)
    ax.plot(x, exact - (exact - richer[0]) * x**order, color=PLAIN, linewidth=1)
    ax.plot(0, limit, "*", color=DARK, markersize=12, label="extrapolated")
    ax.set_xlabel("size of the cells / that of the mesh")
    ax.set_ylabel("output / its limit")
    ax.yaxis.set_minor_locator(NullLocator())
    ax.legend(fontsize="small", frameon=False)
    (HERE / "richardson.svg").write_bytes(svg(ax))


if __name__ == "__main__":
    contact_law()
    extrapolation()
