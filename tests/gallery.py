"""Photograph the first screens of reports, and draw some of their pictures: python -m tests.gallery RESULTS ...

Results are told apart by the names of their folders. Needs Chromium.
"""

from __future__ import annotations

import io
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

from tests.browser import Page, browser
from workflows.report import plots
from workflows.report.plots import inversion, posterior, selection
from workflows.results.directory import read_dataset

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FOLDER = Path(__file__).parents[1] / "docs" / "gallery"
COLOURS = 256  # of a picture
PHONE = 390
PLACES = [f"inclusions.lump.{name}" for name in ("x", "y", "z", "radius")]
SLIDE = """(() => { const s = document.querySelector('.slider input[type=range]');
    if (s) { s.value = Number(s.min) + 0.9 * (s.max - s.min); s.dispatchEvent(new Event('input')); } })()"""

FRAMES, FILM_COLOURS, WIDTH = 24, 64, 780
MOVE = """(() => {{ document.querySelectorAll('.slider input[type=range]').forEach((s, i) => {{
        s.value = Number(s.min) + (0.5 + 0.4 * Math.sin({phase} + 1.5 * i)) * (s.max - s.min);
        s.dispatchEvent(new Event('input')); }});
    const turned = new KeyboardEvent('keydown', {{key: '{key}', bubbles: true}});
    document.querySelector('.viewer canvas').dispatchEvent(turned);
    }})()"""


def main(directories: list[Path]) -> None:
    """Open the report of each directory on a screen; that of the first on a dark telephone too, a slider moved."""
    with browser() as page:
        for number, directory in enumerate(directories):
            report = directory / "report.html"
            page.open(report)
            _save(page.screenshot(Path("/dev/null")), f"report-{directory.name}.png")
            if number == 0:
                page.open(report, PHONE, dark=True)
                page.run(SLIDE)
                page.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
                _save(page.screenshot(Path("/dev/null"), ".viewer"), f"report-{directory.name}-phone.png")
                _film(page, report)
            assert not page.errors, page.errors
            _pictures(directory)


def _pictures(directory: Path) -> None:
    """Draw what the gallery shows of a study."""
    of = read_dataset(directory)
    drawn: dict[str, Axes] = {}
    if directory.name == "treloar":
        best = next(name for name, colour in selection.colours(of).items() if colour == plots.HIGH)
        group = str(of["group"].values[0])
        drawn = {
            "evidence": selection.evidence_bars(of),
            "probability": selection.probability_bars(of),
            "curves": selection.curves(of, group, "uniaxial"),
            "corner": selection.corner(of, best, group, {"mu1": "Pa", "mu2": "Pa", "mu3": "Pa"}),
        }
    elif directory.name == "inclusion":
        one = of.isel(data_set=0)
        drawn = {"pairs": inversion.correlations(one, dict.fromkeys(PLACES, "m"))}
    elif directory.name == "brain-population":
        drawn = {"population": posterior.specimens(of, "mu1", "Pa")}
    elif directory.name == "stiffness-field":
        one = of.isel(data_set=0)
        drawn = {"slices": inversion.slices(one, inversion.Cut.of(one)), "spectrum": inversion.spectrum(one)}
    for name, ax in drawn.items():
        _save(plots.png(ax), f"{name}.png")


def _film(page: Page, report: Path) -> None:
    """Move the sliders to and fro while the body turns, as one picture that moves."""
    page.open(report, WIDTH)
    frames = []
    for k in range(FRAMES):
        turn = ("ArrowLeft" if k < FRAMES / 2 else "ArrowRight") if k % 3 == 1 else ""
        page.run(MOVE.format(phase=2 * math.pi * k / FRAMES, key=turn))
        page.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        frame = Image.open(io.BytesIO(page.screenshot(Path("/dev/null"), ".viewer"))).convert("RGB")
        frames.append(frame.quantize(FILM_COLOURS, dither=Image.Dither.NONE))
    place = FOLDER / "moving.gif"
    frames[0].save(place, save_all=True, append_images=frames[1:], duration=100, loop=0, optimize=True)
    sys.stdout.write(f"{place}\n")


def _save(png: bytes, name: str) -> None:
    whole = Image.open(io.BytesIO(png)).convert("RGB")
    # Dots between the colours of a palette look like gradients; without them colour scales have steps.
    image = whole.quantize(palette=whole.quantize(COLOURS, method=Image.Quantize.MAXCOVERAGE))
    image.save(FOLDER / name, optimize=True)
    sys.stdout.write(f"{FOLDER / name}\n")


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
