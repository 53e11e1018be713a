"""Photograph the first screens of reports for the gallery: python -m tests.gallery RESULTS ... (needs Chromium)."""

from __future__ import annotations

import io
import math
import sys
from pathlib import Path

from PIL import Image

from tests.browser import Page, browser

FOLDER = Path(__file__).parents[1] / "docs" / "gallery"
COLOURS = 200  # of a picture
PHONE = 390
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
    image = Image.open(io.BytesIO(png)).convert("RGB").quantize(COLOURS)
    image.save(FOLDER / name, optimize=True)
    sys.stdout.write(f"{FOLDER / name}\n")


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
