"""What the documentation site needs in a browser, opened from disk: the search's worker, and formulas."""

import importlib.metadata
import importlib.util

import pytest

from tests.browser import browser, executable
from tests.launch import ROOT

pytestmark = pytest.mark.skipif(executable() is None, reason="no Chromium is installed (Debian: chromium)")
ASSETS = ROOT / "docs" / "assets"


@pytest.fixture(scope="module")
def page():
    with browser() as found:
        yield found


def test_a_worker_answers_from_disk_in_turn(page, tmp_path):
    """Two messages before it is there, one after: as the search of the theme uses it."""
    (tmp_path / "helper.js").write_text("self.twice = (x) => 2 * x;")
    (tmp_path / "work.js").write_text(
        "const there = importScripts('helper.js');"
        "addEventListener('message', async ({ data }) => { await there; postMessage(twice(data)); });"
    )
    script = "\n".join(
        [
            "window.found = [];",
            "const worker = new Worker(new URL('work.js', location));",
            "worker.addEventListener('message', ({ data }) => {",
            "    found.push(data);",
            "    if (data === 4) worker.postMessage(3);",
            "});",
            "worker.postMessage(1); worker.postMessage(2);",
        ]
    )
    (tmp_path / "page.html").write_text(
        f"<body><script src='{(ASSETS / 'iframe-worker.js').as_uri()}'></script><script>{script}</script></body>"
    )
    page.open(tmp_path / "page.html")
    page.wait("found.length === 3")
    assert page.run("found") == [2, 4, 6]
    assert not page.errors


def test_formulas_are_typeset_without_network(page, tmp_path):
    pytest.importorskip("mkdocs")
    spec = importlib.util.spec_from_file_location("reference", ROOT / "docs" / "reference.py")
    reference = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(reference)
    try:
        script = reference.mathjax()
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("sphinx-mathjax-offline is not installed")
    formula = r"\(\mathrm{Var}\,\psi = \sum_{a\neq 0} c_a^2\)"
    (tmp_path / "page.html").write_text(
        f"<script src='{(ASSETS / 'formulas.js').as_uri()}'></script><script src='{script.as_uri()}'></script>"
        f"<body><span class='arithmatex'>{formula}</span><p>{formula}</p></body>"
    )
    page.open(tmp_path / "page.html")
    page.wait("document.querySelectorAll('.arithmatex svg').length")
    assert page.run("document.querySelectorAll('p svg').length") == 0
    assert all(address.startswith(("file:", "data:")) for address in page.requests)
    assert not page.errors


def test_every_formula_of_the_pages_is_closed():
    for path in (ROOT / "docs").rglob("*.md"):
        text = path.read_text()
        for opening, closing in ((r"\(", r"\)"), (r"\[", r"\]")):
            if path.parent.name == "theory":
                assert text.count(opening) == text.count(closing), path
