"""The blocks of a section of a report: plain values, each drawn by the macro of its name in report.html.jinja."""

from __future__ import annotations

import base64
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal, TypeVar

from workflows.report import plots
from workflows.report.plots.figure import png_of
from workflows.report.small_density import Curve

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Row = TypeVar("Row")
HALF = 8.0  # inches: wider pictures are not legible on half a page


@dataclass(frozen=True)
class Block:
    """Something on the page."""

    macro: ClassVar[str]


@dataclass(frozen=True)
class Heading(Block):
    """A heading; level 1 is the title of the page."""

    macro = "heading"
    text: str
    level: Literal[1, 2, 3] = 2


@dataclass(frozen=True)
class Text(Block):
    """A paragraph."""

    macro = "text"
    text: str
    tone: Literal["", "lead", "warning", "error"] = ""


@dataclass(frozen=True)
class Pairs(Block):
    """Words, each with the lines that explain it."""

    macro = "pairs"
    items: Sequence[tuple[str, Sequence[str]]]

    @classmethod
    def of(cls, *said: tuple[str, str]) -> Pairs:
        """Explain each word in one line."""
        return cls([(word, [line]) for word, line in said])


@dataclass(frozen=True)
class Table(Block):
    """A table; the columns `text` are flush left, and those of them in `long` are wrapped; row `strong` stands out."""

    macro = "table"
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    text: frozenset[int] = frozenset({0})
    long: frozenset[int] = frozenset()
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
        cells = [[cell(row) for cell in columns.values()] for row in rows]
        return cls(tuple(columns), cells, frozenset(text), frozenset(long))


@dataclass(frozen=True)
class Picture:
    """A picture in base64 with a caption; a `wide` one has many panels and needs the whole width of the page."""

    data: str
    caption: str
    wide: bool = False
    kind: Literal["png", "svg+xml"] = "png"

    @classmethod
    def of(cls, png: bytes, caption: str) -> Picture:
        """Show a PNG file."""
        return cls(base64.b64encode(png).decode(), caption)

    @classmethod
    def painted(cls, figure: Figure, caption: str) -> Picture:
        """Show a figure whose parts overlap: as a PNG file."""
        return cls.of(png_of(figure, figure.dpi), caption)

    @classmethod
    def drawn(cls, ax: Axes, caption: str) -> Picture:
        """Show the figure of axes."""
        wide = ax.figure.get_figure(root=True).get_size_inches()[0] > HALF
        return cls(base64.b64encode(plots.svg(ax)).decode(), caption, wide=wide, kind="svg+xml")


@dataclass(frozen=True)
class Pictures(Block):
    """Pictures side by side; `small` ones are three in a row."""

    macro = "pictures"
    items: Sequence[Picture]
    small: bool = False

    @classmethod
    def of(cls, *drawn: tuple[Axes, str], small: bool = False) -> Pictures:
        """Show the figures of axes, each with its caption."""
        return cls([Picture.drawn(ax, caption) for ax, caption in drawn], small)


@dataclass(frozen=True)
class Answer:
    """One number that was asked for.

    Attributes
    ----------
    name
        What it is.
    value
        The number, rounded to its error, in a fitting unit.
    lines
        What belongs to it: an interval, its errors, what drives it.
    curve
        Its distribution, if it has one.
    leads
        Whether it is the first of several candidates.
    """

    name: str
    value: str
    lines: Sequence[str] = ()
    curve: Curve | None = None
    leads: bool = False


@dataclass(frozen=True)
class Card(Block):
    """The question of a study in words, what forbids to believe the answers, and these side by side."""

    macro = "card"
    question: str
    answers: Sequence[Answer] = ()
    errors: Sequence[str] = ()


@dataclass(frozen=True)
class Viewer(Block):
    """A body that turns.

    Attributes
    ----------
    label
        What it is, for those who cannot see it.
    told, data
        A scene, as `scene.packed` writes it.
    stills
        Pictures for paper, and for browsers that cannot turn it.
    """

    macro = "viewer"
    label: str
    told: str
    data: str
    stills: Pictures


@dataclass(frozen=True)
class Code(Block):
    """Text as it is in a file."""

    macro = "code"
    text: str


@dataclass(frozen=True)
class Folded(Block):
    """Blocks that open when their title is clicked, and on paper if they are `printed`."""

    macro = "folded"
    title: str
    blocks: Sequence[Block]
    printed: bool = True


@dataclass(frozen=True)
class Html(Block):
    """Markup that is put on the page as it is; its style and script are in the page once.

    Whoever makes it escapes what is not markup (`html.escape`). Reports are one file: nothing may be fetched.
    """

    macro = "html"
    markup: str
    style: str = ""
    script: str = ""
