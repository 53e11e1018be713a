"""Notebooks run as they stand."""

import re
import runpy
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.py"))
LONG = {"02_error_against_time", "04_materials", "06_pipeline"}  # repeats, five materials, four studies
SHORT = [pytest.param(path, marks=[pytest.mark.slow] * (path.stem in LONG)) for path in NOTEBOOKS]


@pytest.mark.few(2)
@pytest.mark.fem
@pytest.mark.parametrize("path", SHORT, ids=lambda path: path.stem)
def test_every_line_runs(path, monkeypatch, tmp_path):
    """As a script: without reports, which other tests make."""
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr("workflows.run.run._report", lambda directory: None)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    for name in re.findall(r"TISSUQ_\w+", path.read_text()):
        monkeypatch.delenv(name, raising=False)
    assert runpy.run_path(str(path))


@pytest.mark.fem
@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_jupyter_executes_it_and_shows_pictures(path, monkeypatch, tmp_path):
    pytest.importorskip("nbclient")
    from tests.notebooks import executed

    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    notebook = executed(path, timeout=300)
    shown = [output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", ())]
    assert sum("image/png" in data for data in shown) >= 2


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_it_is_a_notebook_in_short_cells(path):
    text = path.read_text()
    assert "format_name: percent" in text
    cells = text.split("\n# %%")[1:]
    assert sum(cell.startswith(" [markdown]") for cell in cells) >= 3
    code = [cell for cell in cells if not cell.startswith(" [markdown]")]
    assert max(len(cell.splitlines()) for cell in code) <= 60
