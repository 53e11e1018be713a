"""Photograph the first screens of reports for the gallery: python -m tests.gallery RESULTS ... (needs Chromium)."""

from __future__ import annotations

import io
import sys
from pathlib import Path

from PIL import Image

from tests.browser import browser

FOLDER = Path(__file__).parents[1] / "docs" / "gallery"
COLOURS = 200  # of a picture
PHONE = 390
SLIDE = """(() => { const s = document.querySelector('.slider input[type=range]');
    if (s) { s.value = Number(s.min) + 0.9 * (s.max - s.min); s.dispatchEvent(new Event('input')); } })()"""


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
            assert not page.errors, page.errors


def _save(png: bytes, name: str) -> None:
    image = Image.open(io.BytesIO(png)).convert("RGB").quantize(COLOURS)
    image.save(FOLDER / name, optimize=True)
    sys.stdout.write(f"{FOLDER / name}\n")


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
