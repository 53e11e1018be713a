"""Flat pictures of what is in space: how they look at it, and the box around a body."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from forward.model import FloatArray
from forward.readable import scale
from forward.words import number
from workflows.report.plots.figure import DARK

if TYPE_CHECKING:
    from matplotlib.axes import Axes

EDGES = [(i, i ^ bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]  # of a box whose corners count in bits
# Edges with names, all in front: their corners, the side of the name, its alignment, its turn in degrees.
NAMED = ((0, 1, (0, -1), "right", 0), (1, 3, (0.5, -1), "left", 0), (0, 4, (-1, 0), "right", 90))
GAP = 0.03  # between an edge and its name, in extents
ROUNDING = 1e-9  # of the extent


def looking(up: FloatArray) -> FloatArray:
    """Return the directions (3, 3) to the right, up and towards the viewer, who is in front, to the right and above."""
    right = np.eye(3)[1 if up[0] else 0]
    towards = np.cross(right, up) + 0.6 * right + 0.4 * up
    towards /= np.linalg.norm(towards)
    side = np.cross(up, towards)
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(towards, side), towards])


SEEN_FROM = looking(np.eye(3)[2])


def seen(points: FloatArray) -> FloatArray:
    """Return where points or arrows (n, 3) are on a picture with z upwards: (n, 3) to the right, up, to the viewer."""
    return np.asarray(points @ SEEN_FROM.T)


def box(ax: Axes, ends: FloatArray) -> None:
    """Draw the box between two corners, ends (2, 3) in m, with its size along three edges; nothing else is there."""
    from matplotlib.collections import LineCollection

    corners = seen(np.array([[ends[i >> axis & 1, axis] for axis in range(3)] for i in range(8)]))[:, :2]
    ax.add_collection(LineCollection([corners[[i, j]] for i, j in EDGES], colors=DARK, linewidths=0.6))
    largest = float(np.abs(ends).max())
    one, unit = scale(largest, "m")
    gap = GAP * float(np.ptp(corners, axis=0).max())
    for axis, (i, j, off, across, turned) in enumerate(NAMED):
        low, high = (number(0.0 if abs(end) < ROUNDING * largest else end / one, 3) for end in ends[:, axis])
        words = f"{'xyz'[axis]}: {low} to {high} {unit}"
        x, y = corners[[i, j]].mean(axis=0) + gap * np.array(off)
        ax.text(x, y, words, fontsize="x-small", ha=across, va="center" if turned else "top", rotation=turned)
    ax.set_aspect("equal")
    ax.axis("off")
