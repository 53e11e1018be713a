"""Sections of a report: those of the program, and one from outside in one file."""

import importlib
import json
import re
import sys

import pytest

from tests.launch import ROOT
from workflows.__main__ import main
from workflows.report.blocks import Folded, Html, Text
from workflows.report.page import render
from workflows.report.section import SECTIONS, Section

PAGE = (ROOT / "docs" / "how-to" / "own-sections.md").read_text(encoding="utf-8")
STUDY = """
[model]
kind = "python"
function = "tests.functions.beam"
parameters = { E = 1e6, load = 1.0, length = 0.1 }
outputs = [{ name = "sag", unit = "m" }, "weight"]

[parameters]
E = { kind = "uniform", lower = 0.9e6, upper = 1.1e6 }

[method]
kind = "monte-carlo"
samples = 16
"""


@pytest.fixture
def folder(tmp_path, monkeypatch, undrawn):
    """A study with the section that the documentation shows in a file beside it."""
    code, named = (re.search(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)[1] for language in ("python", "toml"))
    (tmp_path / "my_sections.py").write_text(code, encoding="utf-8")
    (tmp_path / "plain.toml").write_text(STUDY)
    (tmp_path / "study.toml").write_text(STUDY + named)
    monkeypatch.setattr(sys, "path", sys.path.copy())
    yield tmp_path
    sys.modules.pop("my_sections", None)


def tissuq(command, study, out=None, *more):
    """Exit code of a command, as from a shell without what other tests have imported."""
    sys.modules.pop("my_sections", None)
    return main([command, str(study), *(["--out", str(out), "--quiet"] if out else []), *more])


def test_a_section_beside_the_study_stands_where_it_wants_to(folder):
    assert tissuq("check", folder / "study.toml") == 0
    assert tissuq("run", folder / "study.toml", folder / "out") == 0
    page = (folder / "out" / "report.html").read_text()
    places = [page.index(text) for text in ("<h2>Is it too soft?</h2>", "<h2>Distribution and", "<h2>Mean and")]
    assert places == sorted(places)
    assert "0 % of the samples sag by more than 12 cm." in page
    assert "Samples of the sag." in page
    assert page.count("document.getElementById('limit').value = '12 cm';") == 1
    (folder / "out" / "report.html").unlink()
    assert tissuq("report", folder / "out", None, "--code") == 0
    assert (folder / "out" / "report.html").read_text() == page


def test_a_finished_study_gets_a_section_and_repeats_nothing(folder, capsys):
    assert tissuq("run", folder / "plain.toml", folder / "out") == 0
    results = (folder / "out" / "results.nc").read_bytes()
    assert "too soft" not in (folder / "out" / "report.html").read_text()
    assert tissuq("run", folder / "study.toml", folder / "out") == 0
    assert "too soft" in (folder / "out" / "report.html").read_text()
    assert (folder / "out" / "results.nc").read_bytes() == results
    assert "report" not in results.decode(errors="ignore")
    assert tissuq("run", folder / "plain.toml", folder / "out") == 0
    assert "too soft" not in (folder / "out" / "report.html").read_text()


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("my_sections.Limits", "has no section 'Limits'; did you mean 'Limit'?"),
        (
            "other.Limit",
            "the section 'other.Limit' cannot be imported: No module named 'other'; expected in other.py in ",
        ),
        ("my_sections.Heading", "cannot be used as section: expected a subclass of Section"),
        ("Limit", "report.sections[0]: "),
    ],
)
def test_a_section_that_is_not_there_is_said_before_anything_is_solved(folder, capsys, name, said):
    path = folder / "study.toml"
    path.write_text(path.read_text().replace("my_sections.Limit", name))
    assert tissuq("check", path) == 2
    assert said in capsys.readouterr().err


def test_a_report_runs_no_code_that_its_folder_names(folder, monkeypatch, capsys):
    """Neither a section, nor a module beside the study or in the folders that results name, nor one of this folder."""
    assert tissuq("run", folder / "study.toml", folder / "out") == 0
    ran = folder / "ran"
    hostile = f"from pathlib import Path\nPath({str(ran)!r}).touch()\n"
    (folder / "my_sections.py").write_text(hostile)
    for name in ("my_sections.py", "functions.py", "cftime.py", "sitecustomize.py"):
        (folder / "out" / name).write_text(hostile)
    files = {"cftime": [str(folder / "out" / "cftime.py"), ""], "my_sections": [str(folder / "my_sections.py"), ""]}
    (folder / "out" / "sources.json").write_text(json.dumps({"files": files, "versions": {}}))
    study = folder / "out" / "study.toml"
    study.write_text(study.read_text().replace('"my_sections.Limit"', '"my_sections.Limit", "cftime.A", "nowhere.B"'))
    monkeypatch.chdir(folder / "out")
    capsys.readouterr()
    assert tissuq("report", ".") == 0
    assert not ran.exists()
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert "my_sections.Limit, cftime.A, nowhere.B; --code runs" in said
    page = (folder / "out" / "report.html").read_text()
    assert "nowhere.B; --code runs it" in page
    assert '<section id="distribution">' in page
    assert main(["report", ".", str(folder / "out"), "--out", str(folder / "both.html")]) == 0
    assert not ran.exists()
    assert tissuq("report", ".", None, "--code") == 2  # what is named is no section, but it has run
    assert ran.exists()


def test_a_section_that_is_gone_is_said(folder, capsys):
    assert tissuq("run", folder / "study.toml", folder / "out") == 0
    (folder / "my_sections.py").unlink()
    assert tissuq("report", folder / "out", None, "--code") == 2
    said = capsys.readouterr().err
    assert f"No module named 'my_sections'; expected in my_sections.py in {folder}" in said
    assert len(said.splitlines()) == 1


def test_a_place_that_is_not_there_is_said(folder, capsys):
    path = folder / "my_sections.py"
    path.write_text(path.read_text().replace('before = "distribution"', 'before = "distributions"'))
    assert tissuq("check", folder / "study.toml") == 2
    assert "did you mean 'distribution'?" in capsys.readouterr().err


def test_a_section_that_fails_takes_no_report_with_it(folder):
    path = folder / "my_sections.py"
    path.write_text(
        path.read_text().replace('yield Heading("Is it', 'raise ValueError("<no limit>")\n        yield Heading("Is it')
    )
    assert tissuq("run", folder / "study.toml", folder / "out") == 0
    page = (folder / "out" / "report.html").read_text()
    assert '<p class="error">This section could not be made: ValueError: &lt;no limit&gt;</p>' in page
    assert "<h2>Provenance</h2>" in page


def test_an_installed_package_adds_a_section(folder, monkeypatch):
    """By its entry point, without a word in the study."""
    metadata = folder / "my_package-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: my-package\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text("[tissuq]\nsection.limit = my_sections:Limit\n")
    monkeypatch.syspath_prepend(folder)
    assert tissuq("run", folder / "plain.toml", folder / "out") == 0
    assert '<section id="limit">' in (folder / "out" / "report.html").read_text()
    (folder / "out" / "report.html").unlink()
    assert tissuq("report", folder / "out") == 0
    assert '<section id="limit">' in (folder / "out" / "report.html").read_text()


def test_own_sections_are_named_once():
    found = []
    for path in (ROOT / "workflows" / "report" / "sections").glob("[!_]*.py"):
        module = importlib.import_module(f"workflows.report.sections.{path.stem}")
        mine = (one for one in vars(module).values() if isinstance(one, type) and one.__module__ == module.__name__)
        found += [f"{module.__name__}:{one.__name__}" for one in mine if issubclass(one, Section)]
    assert sorted(found) == sorted(SECTIONS.own.values())


def test_what_markup_needs_is_in_the_page_once():
    viewer = Html("<canvas></canvas>", style="canvas { width: 100%; }", script="turn();")
    page = render("T", [("a", [viewer]), ("b", [Folded("more", [viewer, Text("<b> & c")])])])
    assert page.count("<canvas></canvas>") == 2
    assert page.count("turn();") == page.count("canvas { width: 100%; }") == 1
    assert "<b>" not in page
