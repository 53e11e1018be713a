"""The blocks of a section of a report: plain values, each drawn by the macro of its name in report.html.jinja."""

from __future__ import annotations

import base64
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, TypeVar

import numpy as np

from forward.readable import interval
from workflows.report.plots.figure import figure_of, png_of, svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from forward.model import FloatArray

Row = TypeVar("Row")
Level = Literal[1, 2, 3]  # of a heading
Tone = Literal["", "lead", "warning", "error"]
CURVE = 48  # points
ALIKE = 1e-12  # standard deviation over the mean up to which values are the same
HALF = 8.0  # inches: wider pictures are not legible on half a page


def words(*texts: str) -> int:
    """Count words, and numbers and units among them."""
    return sum(any(map(str.isalnum, word)) for text in texts for word in text.split())


def first_within(limit: int, sizes: Sequence[int]) -> int:
    """Return how many of the first ones are together within a limit: at least one, if there is one."""
    return max(int(np.searchsorted(np.cumsum(sizes), limit, side="right")), min(len(sizes), 1))


@dataclass(frozen=True)
class Block:
    """Something on the page; a style and a script that it needs are there once."""

    style = script = ""

    @property
    def macro(self) -> str:
        """The name of what draws it in report.html.jinja: its own."""
        return type(self).__name__.lower()

    @property
    def lines(self) -> Sequence[str]:
        """What a terminal shows of it."""
        return ()

    def whole(self) -> Iterator[Block]:
        """Go through this block and all that it holds."""
        yield self


@dataclass(frozen=True)
class Heading(Block):
    """A heading; level 1 is the title of the page."""

    text: str
    level: Level = 2


@dataclass(frozen=True)
class Text(Block):
    """A paragraph, of which `more` is folded."""

    text: str
    tone: Tone = ""
    more: str = ""

    @property
    def lines(self) -> Sequence[str]:
        """Its text."""
        return (self.text,)


@dataclass(frozen=True)
class Pairs(Block):
    """Words, each with the lines that explain it."""

    items: Sequence[tuple[str, Sequence[str]]]

    @classmethod
    def of(cls, *said: tuple[str, ...]) -> Pairs:
        """Explain words, each the first of its tuple, in the lines that follow."""
        return cls([(word, lines) for word, *lines in said])


@dataclass(frozen=True)
class Table(Block):
    """A table; the columns `text` are flush left, and those of them in `long` are wrapped; row `strong` stands out."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    text: Collection[int] = (0,)
    long: Collection[int] = ()
    strong: int | None = None

    @classmethod
    def of(
        cls,
        rows: Iterable[Row],
        columns: Mapping[str, Callable[[Row], str]],
        text: Collection[int] = (0,),
        long: Collection[int] = (),
    ) -> Table:
        """Write rows of anything by what each column says of one."""
        return cls(tuple(columns), [[cell(row) for cell in columns.values()] for row in rows], text, long)


@dataclass(frozen=True)
class Picture:
    """A picture in base64 with a caption; a `wide` one has many panels and needs the whole width of the page."""

    data: str = field(repr=False)
    caption: str
    wide: bool = False
    kind: Literal["png", "svg+xml"] = "png"

    def _repr_mimebundle_(self, **_: object) -> dict[str, str]:
        """Show itself in a notebook."""
        data = self.data if self.kind == "png" else base64.b64decode(self.data).decode()
        return {f"image/{self.kind}": data}

    @classmethod
    def of(cls, png: bytes, caption: str) -> Picture:
        """Show a PNG file."""
        return cls(base64.b64encode(png).decode(), caption)

    @classmethod
    def drawn(cls, shown: Axes | Figure, caption: str) -> Picture:
        """Show the figure of axes; a figure, whose parts overlap, as a PNG file."""
        from matplotlib.figure import Figure

        if isinstance(shown, Figure):
            return cls.of(png_of(shown, shown.dpi), caption)
        wide = figure_of(shown).get_size_inches()[0] > HALF
        return cls(base64.b64encode(svg(shown)).decode(), caption, wide=wide, kind="svg+xml")


@dataclass(frozen=True)
class Pictures(Block):
    """Pictures side by side; `small` ones are three in a row."""

    items: Sequence[Picture]
    small: bool = False

    @classmethod
    def of(cls, *drawn: tuple[Axes | Figure, str], small: bool = False) -> Pictures:
        """Show figures, or those of axes, each with its caption."""
        return cls([Picture.drawn(*one) for one in drawn], small)


@dataclass(frozen=True)
class Curve:
    """A density: heights (n,) at equal distances, the ends of an interval as parts of its range, its ends in words."""

    heights: list[float]
    inside: tuple[float, float]
    ends: tuple[str, str]

    @property
    def path(self) -> str:
        """The curve as a path of SVG, 100 wide and 20 high."""
        top = max(self.heights, default=0.0) or 1.0
        step = 100 / max(len(self.heights) - 1, 1)
        points = "L".join(f"{step * k:.2f} {20 - 19 * y / top:.2f}" for k, y in enumerate(self.heights))
        return f"M0 20L{points}L100 20Z"


@dataclass(frozen=True)
class Answer:
    """One number that was asked for, rounded to its error, in a fitting unit.

    Below it are lines on what belongs to it (an interval, its errors, what drives it), and its distribution, if it has
    one. The first of several candidates `leads`.
    """

    name: str
    value: str
    lines: Sequence[str] = ()
    curve: Curve | None = None
    leads: bool = False


@dataclass(frozen=True)
class Card(Block):
    """The question of a study in words, what is to be read before the answers, and these side by side.

    Answers beyond the first `words` words of it are folded, the first one never.
    """

    question: str
    answers: Sequence[Answer] = ()
    before: Sequence[Text] = ()
    words: int = 80

    @property
    def parts(self) -> tuple[Sequence[Answer], Sequence[Answer]]:
        """The answers that are read at once, and those that are folded."""
        count = first_within(
            self.words - words(self.question, *(said.text for said in self.before)),
            [words(one.name, one.value, *one.lines) for one in self.answers],
        )
        return self.answers[:count], self.answers[count:]

    @property
    def lines(self) -> Sequence[str]:
        """A line for each answer."""
        return ["; ".join([f"{one.name}: {one.value}", *one.lines]) for one in self.answers]


@dataclass(frozen=True)
class Viewer(Block):
    """A body that turns: a scene, as `scene.packed` writes it.

    The label is for those who cannot see it, the stills are for paper, and for browsers that cannot turn it.
    """

    label: str
    told: str
    data: str
    stills: Pictures


@dataclass(frozen=True)
class Code(Block):
    """Text as it is in a file."""

    text: str


@dataclass(frozen=True)
class Folded(Block):
    """Blocks that open when their title is clicked, and on paper if they are `printed`."""

    title: str
    blocks: Sequence[Block]
    printed: bool = True

    def whole(self) -> Iterator[Block]:
        """Go through this block and all that it holds."""
        yield self
        for block in self.blocks:
            yield from block.whole()


@dataclass(frozen=True)
class Html(Block):
    """Markup that is put on the page as it is; its style and script are in the page once.

    Whoever makes it escapes what is not markup (`html.escape`). Reports are one file: nothing may be fetched.
    """

    markup: str
    style: str = ""
    script: str = ""


def curve_of(at: FloatArray, curve: FloatArray, inside: tuple[float, float], unit: str, value: float) -> Curve:
    """Return a density at places (m,) with the 95 % interval of a value."""
    low, high = min(float(at[0]), inside[0]), max(float(at[-1]), inside[1])
    if (low, high) != (float(at[0]), float(at[-1])):  # draws of weighted points may reach less far than their interval
        lattice = np.linspace(low, high, CURVE)
        at, curve = lattice, np.interp(lattice, at, curve, left=0.0, right=0.0)
    a, b = (float(np.clip((x - low) / ((high - low) or 1.0), 0, 1)) for x in inside)
    words = interval(low, high, unit, value)
    left, _, right = words.partition(" to " if " to " in words else "–")
    return Curve([float(y) for y in curve], (a, b), (left, right))


def smooth(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return places (m,) and the density (m,) of samples (n,) there, with Gaussian kernels on a lattice."""
    mean, std = float(values.mean()), float(values.std())
    if std <= ALIKE * abs(mean):  # one value, but for rounding: it has a place, and no density
        std = abs(mean) or 1.0
    width = 1.06 * std * len(values) ** -0.2
    low, high = max(values.min(), mean - 5 * std), min(values.max(), mean + 5 * std)
    at = np.linspace(low - width, high + width, CURVE)
    counts, edges = np.histogram(values, bins=400, range=(low, high))
    centres = (edges[1:] + edges[:-1]) / 2
    return at, np.exp(-0.5 * ((at[:, None] - centres) / width) ** 2) @ counts / len(values)
