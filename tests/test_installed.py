"""Kinds of an installed package: every family by its entry points, run, served, compared, and refused once changed."""

import json
import re
import subprocess
import tomllib
import urllib.request

import jsonschema
import meshio
import numpy as np
import pytest
import xarray as xr

from tests import meshes
from tests.launch import ROOT, TISSUQ, environment, in_process, run

PAGE = (ROOT / "docs" / "how-to" / "extending.md").read_text()
DECLARED = dict(re.findall(r'^    "(\w+\.\w+)" = "([\w.:]+)"$', PAGE, re.M))
WITHOUT_DOTS = {place.replace(":", "."): name.partition(".")[2] for name, place in DECLARED.items()}


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder of installed packages with the modules of the page as a distribution, found by its entry points."""
    made = tmp_path_factory.mktemp("installed") / "site-packages"
    information = made / "my_kinds-1.0.dist-info"
    information.mkdir(parents=True)
    names = []
    for name, text in re.findall(r"^```python\n# (\S+)\n(.*?)^```", PAGE, re.M | re.S):
        (made / name).write_text(text)
        names.append(name)
    points = "".join(f"{name} = {place}\n" for name, place in DECLARED.items())
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: my-kinds\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text(f"[tissuq]\n{points}")
    (information / "top_level.txt").write_text("".join(f"{name.removesuffix('.py')}\n" for name in names))
    (information / "RECORD").write_text("".join(f"{name},,\n" for name in names))
    return made


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The studies of the page, which name kinds without dots."""
    made = tmp_path_factory.mktemp("studies")
    page = re.sub(r"^\[report\]\n.*?\n", "", PAGE, flags=re.M)  # installed sections are in every report
    for dotted, kind in WITHOUT_DOTS.items():
        page = page.replace(f'"{dotted}"', f'"{kind}"').replace(f"loads.{dotted.partition('.')[2]}.", f"loads.{kind}.")
    for name, text in re.findall(r"^```toml\n# (\S+)\n(.*?)^```", page, re.M | re.S):
        (made / name).write_text(text)
    return made


def done(site, ranks, *words):
    """Run the program with the package on its path."""
    found = run(ranks, TISSUQ, *words, path=site)
    assert found.returncode == 0, found.stderr
    return found.stdout


def rows_of(page):
    """The cells of all rows of tables of a report."""
    return [re.findall(r"<td[^>]*>([^<]*)</td>", row) for row in re.findall(r"<tr>.*?</tr>", page, re.S)]


def test_the_page_declares_every_family():
    families = {"material", "load", "output", "method", "section", "model", "reader", "study"}
    assert {name.partition(".")[0] for name in DECLARED} == families


@pytest.mark.slow
@pytest.mark.fem
@pytest.mark.mpi
def test_a_body_of_installed_kinds_on_two_ranks(site, folder):
    study, out = folder / "wound.toml", folder / "wound"
    assert not re.search(r'kind = "\w+\.', study.read_text())
    jsonschema.validate(tomllib.loads(study.read_text()), json.loads(done(site, None, "schema")))
    assert f"my_tissue ({site / 'my_tissue.py'})" in done(site, None, "check", study)
    done(site, 2, "run", study, "--out", out)
    data = xr.load_dataset(out / "results.nc")
    area = 0.02 * 0.02
    swept, stretch = (data["largest"].sel(output=name).item() for name in ("swept", "stretch"))
    assert swept == pytest.approx(area * stretch, rel=1e-10)
    assert "The ends of what is likely" in (out / "report.html").read_text()
    kept = json.loads((out / "sources.json").read_text())
    assert kept["files"].keys() >= {"my_tissue", "my_loads", "my_outputs", "my_methods"}
    assert kept["versions"]["my-kinds"] == "1.0"
    tissue = site / "my_tissue.py"
    before = tissue.read_text()
    tissue.write_text(before.replace("c / (2 * b)", "c / (3 * b)"))
    other = run(None, TISSUQ, "run", study, "--out", out, path=site)
    tissue.write_text(before)
    assert other.returncode == 2
    assert "my_tissue.py has changed" in other.stderr
    without = in_process("check", study)
    assert without.returncode == 2
    assert "unknown kind" in without.stderr
    assert "Traceback" not in without.stderr


def test_a_kind_of_study(site, folder):
    """On one rank; on two it is one of a module beside the study."""
    done(site, None, "run", folder / "scan.toml", "--out", folder / "scan", "--no-report")
    found = xr.load_dataset(folder / "scan" / "results.nc")
    assert found["scanned"].to_numpy().ravel() == pytest.approx(np.array([0.08, 0.1, 0.12]) ** 3 / 12)


@pytest.mark.mpi
def test_a_model_that_is_served(site, folder):
    process = subprocess.Popen(
        [TISSUQ, "serve", folder / "beam.toml", "--port", "0"],
        stdout=subprocess.PIPE,
        text=True,
        env=environment() | {"PYTHONPATH": str(site)},
        cwd=ROOT,
    )
    try:
        assert process.stdout is not None
        address = re.search(r"http://\S+:\d+", process.stdout.readline())[0]
        question = {"name": "forward", "input": [[0.1, 4.0]]}
        request = urllib.request.Request(f"{address}/Evaluate", json.dumps(question).encode())
        answer = json.load(urllib.request.urlopen(request, timeout=60))
        assert answer["output"] == [[pytest.approx(0.5 * 0.1**3 / 3 / 4.0)]]
    finally:
        process.terminate()
        process.wait(timeout=60)


CANDIDATES = """
[model]
kind = "hyperelastic"
body = { kind = "mesh", file = "block.msh", degree = 1 }
regions = { right = { contrast = 2.0 } }
clamp = ["x-min"]
loads = [{ kind = "traction", on = "x-max", direction = [1, 0, 0], size = 200 }]
outputs = [{ name = "reach", kind = "mean-displacement", on = "x-max", component = "x" }]

[data]
outputs = { reach = [0.0212, 0.0208] }
sigma = { reach = 4e-3 }

[candidates.fung]
model.material = { kind = "fung", c = 4e3, b = 2.0, D1 = 4e3 }
model.regions = { right = { b = 5.0, contrast = 2.0 } }
parameters."material.c" = { kind = "log-normal", mean = 4e3, std = 1e3 }
parameters."regions.right.b" = { kind = "uniform", lower = 3.0, upper = 7.0 }

[candidates.neo-hookean]
model.material = { kind = "neo-hookean", C1 = 2e3, D1 = 4e3 }
parameters."material.C1" = { kind = "log-normal", mean = 2e3, std = 5e2 }

[method]
kind = "select"
samples = 64
starts = 1
noise = {}
"""


@pytest.mark.fem
@pytest.mark.mpi
@pytest.mark.slow
def test_a_candidate_with_regions_of_a_mesh(site, tmp_path):
    """By measured outputs, on two ranks and on one; the report has its constants with their units."""
    meshio.write(tmp_path / "block.msh", meshes.box(), file_format="gmsh22", binary=False)
    (tmp_path / "rivals.toml").write_text(CANDIDATES)
    for ranks, words in ((2, ("--no-report",)), (None, ())):
        done(site, ranks, "run", tmp_path / "rivals.toml", "--out", tmp_path / str(ranks), *words)
    assert (tmp_path / "2" / "results.nc").read_bytes() == (tmp_path / "None" / "results.nc").read_bytes()
    found = json.loads((tmp_path / "2" / "summary.json").read_text())["models"]
    assert sum(model["probability"] for model in found.values()) == pytest.approx(1.0)
    rows = rows_of((tmp_path / "None" / "report.html").read_text())
    assert [row for row in rows if row[2:3] == ["material.c"] and row[3].endswith("\N{NO-BREAK SPACE}kPa")]
    assert {(row[2], row[4]) for row in rows if row[3:4] and row[3].startswith("uniform")} == {("regions.right.b", "1")}
    assert "my_tissue" in json.loads((tmp_path / "2" / "sources.json").read_text())["files"]


POINTS = """
[data]
tests = [
    { mode = "uniaxial", at = [1.1, 1.3, 1.6], measured = [530.0, 1400.0, 2700.0], sigma = [30.0, 60.0, 120.0] },
]

[candidates.fung]
material = { kind = "fung" }
parameters.c = { kind = "log-normal", mean = 2e3, std = 1e3 }
parameters.b = { kind = "uniform", lower = 0.01, upper = 0.5 }

[candidates.neo-hookean]
material = { kind = "neo-hookean" }
parameters.C1 = { kind = "log-normal", mean = 1e3, std = 5e2 }

[method]
kind = "select"
samples = 64
noise = {}
"""


@pytest.mark.slow
def test_a_candidate_of_material_tests(site, tmp_path, monkeypatch, undrawn):
    (tmp_path / "points.toml").write_text(POINTS)
    monkeypatch.syspath_prepend(site)
    found = in_process("run", tmp_path / "points.toml", "--out", tmp_path / "out")
    assert found.returncode == 0, found.stderr
    rows = rows_of((tmp_path / "out" / "report.html").read_text())
    assert [row for row in rows if row[:3] == ["fung", "fung", "c"] and row[4] == "Pa"]
    assert "my_tissue" in json.loads((tmp_path / "out" / "sources.json").read_text())["files"]
