"""Figures that need no display, with their axes, colours and words."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from forward.readable import SIZES, is_path, power_of_ten, scale, spoken

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PLAIN, CONTROLLED, HIGH, DARK = "#8a97a6", "#0b6bb8", "#d1622b", "#1d2733"
# What is black or white on paper follows the page on a screen that is dark.
FOLLOWING = {"#000000": "var(--ink)", DARK: "var(--ink)", "#ffffff": "var(--paper)"}
FOLLOWS = """<style>svg { --ink: #000; --paper: #fff; fill: var(--ink); }
@media (prefers-color-scheme: dark) { svg { --ink: #e6ebf0; --paper: #12171c; } }</style>
<defs>"""
ON_PALE, ON_DEEP = "#010101", "#fefefe"  # what is written on a colour stays as it is
MANY_POINTS = 3000
LEGEND = 0.35  # inches that a row of a legend below all panels takes
COLOURS = (CONTROLLED, HIGH, "#2f8f4e", "#8e5bb5", PLAIN, "#b5962d", DARK, "#c2477f")  # of models


def png(ax: Axes) -> bytes:
    """Return the whole figure of axes as a PNG file."""
    in_fitting_units(figure_of(ax))
    return png_of(figure_of(ax), dpi=130)


def figure_of(ax: Axes) -> Figure:
    """Return the whole figure that axes are on."""
    figure = ax.get_figure(root=True)
    assert figure is not None
    return figure


def png_of(figure: Figure, dpi: float) -> bytes:
    """Return a figure as a PNG file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    _lay_out(figure, dpi)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=dpi)
    return file.getvalue()


def svg(ax: Axes) -> bytes:
    """Return the whole figure of axes as an SVG file, dark on dark pages; of thousands of points it holds a picture."""
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.collections import QuadMesh

    whole = figure_of(ax)
    in_fitting_units(whole)
    FigureCanvasSVG(whole)
    _lay_out(whole, FigureCanvasSVG.fixed_dpi)
    for each in whole.axes:
        for artist in (*each.collections, *each.lines):
            # Browsers leave gaps between the cells of a mesh, as colour bars are: stripes.
            artist.set_rasterized(isinstance(artist, QuadMesh) or _points(artist) > MANY_POINTS)
    file = io.BytesIO()
    # Equal results give equal files: without a date and random names.
    with mpl.rc_context({"svg.hashsalt": "tissuq", "svg.fonttype": "path"}):
        whole.savefig(file, format="svg", dpi=150, metadata={"Date": None, "Creator": None})
    text = re.sub("|".join(FOLLOWING), lambda found: FOLLOWING[found[0]], file.getvalue().decode())
    return text.replace("<defs>", FOLLOWS, 1).encode()


def _lay_out(figure: Figure, dpi: float) -> None:
    """Place all parts of a figure once and for all: to save one whose layout is open draws everything twice."""
    engine = figure.get_layout_engine()
    if engine is not None:
        figure.set_dpi(dpi)
        engine.execute(figure)
        figure.set_layout_engine(None)


def in_fitting_units(figure: Any) -> None:
    """Write the numbers of all axes whose labels end with an SI unit in one of a fitting size: mm, kPa.

    Axes stay in SI units, so that lines can be added; only what is written beside them changes.
    """
    from matplotlib.ticker import FixedLocator

    for axis in (one for ax in figure.axes for one in (ax.xaxis, ax.yaxis)):
        if axis.get_scale() == "log" and axis.isDefault_majfmt:
            axis.set_major_formatter(_of_powers())
            axis.set_minor_formatter(_of_powers())
        found = re.search(r"\(([^()]+)\)$", axis.get_label_text())
        free = axis.get_scale() == "linear" and not isinstance(axis.get_major_locator(), FixedLocator)
        if found is None or found[1] not in SIZES or not free:
            continue
        one, name = scale(float(np.abs(axis.get_view_interval()).max()), found[1])
        axis.set_label_text(axis.get_label_text()[: found.start()] + f"({name})")
        axis.set_major_formatter(_ticks(one))
        other = axis.axes.yaxis
        if axis is axis.axes.xaxis and other.get_label_text().endswith(f"(1/{found[1]})"):  # a density over it
            other.set_label_text(other.get_label_text().removesuffix(f"(1/{found[1]})") + f"(1/{name})")
            other.set_major_formatter(_ticks(1 / one))


def _of_powers() -> Any:
    """Return a formatter of logarithmic ticks in plain letters: formulas would be set by a parser of their own."""
    from matplotlib.ticker import LogFormatter

    class Powers(LogFormatter):
        def __call__(self, x: float, pos: int | None = None) -> str:
            if not super().__call__(x, pos):  # which ticks have room for a label
                return ""
            power = int(np.floor(np.log10(x) + 1e-9))
            first = round(x / 10.0**power, 6)
            if power in (0, 1):
                return f"{x:.6g}"
            return power_of_ten(power) if first == 1 else f"{first:g} × {power_of_ten(power)}"

    return Powers()


def _ticks(one: float) -> Any:
    """Return a formatter of ticks in a unit: with the decimals that tell them apart."""
    from matplotlib.ticker import Formatter

    class Ticks(Formatter):
        def __call__(self, x: float, pos: int | None = None) -> str:
            places = np.sort(np.asarray(self.locs, dtype=float) / one)
            step = float(np.diff(places).min(initial=np.inf)) if len(places) > 1 else abs(float(places[0]))
            for decimals in range(12):
                if np.abs(np.round(places, decimals) - places).max() < 1e-3 * step:
                    break
            return f"{round(x / one, decimals) + 0.0:,.{decimals}f}".replace("-", "\N{MINUS SIGN}")

    return Ticks()


def _points(artist: Any) -> int:
    """Return how many points a line or a collection has, about."""
    if hasattr(artist, "get_xdata"):
        return int(np.size(artist.get_xdata()))
    offsets, paths = artist.get_offsets(), artist.get_paths()
    drawn = sum(len(path.vertices) for path in paths)
    sizes = artist.get_sizes() if hasattr(artist, "get_sizes") else ()
    # Marks of one size are drawn once and repeated; those of many sizes are drawn each.
    marks = len(offsets) * drawn // max(len(paths), 1) if len(sizes) > 1 else len(offsets)
    return max(marks, drawn, int(np.size(artist.get_array())))


def axes(height: float = 3.2, width: float = 5.4) -> Axes:
    """Return axes on a new figure (inches) that needs no display and is not kept elsewhere."""
    from matplotlib.figure import Figure

    ax: Axes = Figure(figsize=(width, height), layout="constrained").add_subplot()
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def grid(
    count: int,
    columns: int,
    size: tuple[float, float] = (2.8, 3.0),
    inside: tuple[float, float, float, float] = (0.65, 0.5, 0.15, 0.3),
    legend: int = 0,
) -> list[Axes]:
    """Return axes side by side on a new figure, so many in a row; all lengths are inches.

    Their places are given by hand: a layout that measures every label takes longer than to draw the picture. Of the
    width and height of each panel its labels take what is `inside`: to the left, below, to the right, above. Under all
    of them there is room for a `legend` of so many rows.
    """
    from matplotlib.figure import Figure

    rows, (width, height), (left, bottom, right, top) = -(-count // columns), size, inside
    whole = width * columns, height * rows + LEGEND * legend
    figure = Figure(figsize=whole)
    places = [(width * (i % columns) + left, whole[1] - height * (i // columns + 1) + bottom) for i in range(count)]
    extent = (width - left - right) / whole[0], (height - bottom - top) / whole[1]
    return [figure.add_axes((x / whole[0], y / whole[1], *extent)) for x, y in places]


def finished(
    ax: Axes, x: str = "", y: str = "", *, log: str = "", above: int = 0, below: int = 0, **legend: Any
) -> Axes:
    """Write what axes show, and a legend of what has labels: beside the data, or in so many columns `above` it.

    In so many `below` all panels of the figure it is that of all.

    `log` names those that are logarithmic: "xy".
    """
    labels = {f"{axis}label": said for axis, said in (("x", x), ("y", y)) if said}
    ax.set(**{f"{axis}scale": "log" for axis in log}, **labels)
    shown = ax.get_legend_handles_labels()
    plain: dict[str, Any] = {"fontsize": "small", "frameon": False}
    if shown[0] and below:
        where = "lower center" if figure_of(ax).get_layout_engine() is None else "outside lower center"
        figure_of(ax).legend(*shown, loc=where, ncols=below, **plain)
    elif shown[0]:
        place = {"loc": "lower right", "bbox_to_anchor": (1.02, 1), "ncols": above} if above else {}
        ax.legend(**plain | place | legend)
    return ax


def rows(ax: Axes, names: Sequence[str]) -> NDArray[np.int64]:
    """Give each name a row, from top to bottom, and return where (n,) these are."""
    places = np.arange(len(names))[::-1]
    ax.set_yticks(places, [text_of(name) for name in names])
    ax.set_ylim(-0.6, len(names) - 0.4)
    return places


def stacked(ax: Axes, names: Sequence[str], parts: Mapping[str, FloatArray], colours: Sequence[str]) -> None:
    """Draw a bar for each name from parts (n,) that follow each other."""
    places, left = rows(ax, names), np.zeros(len(names))
    for (label, widths), colour in zip(parts.items(), colours, strict=True):
        ax.barh(places, widths, left=left, color=colour, label=label, height=0.6)
        left = left + widths


def text_of(name: str) -> str:
    """Keep matplotlib from reading a name as a formula; numbers of a model are named by the ends of their paths."""
    return (spoken(name) if is_path(name) else name).replace("$", r"\$")
