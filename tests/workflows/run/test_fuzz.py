"""Studies with mistakes in them, made by chance: one line for each, no traceback, nothing of pydantic's inner life."""

import random
import re
import tomllib
from pathlib import Path

import meshio
import pytest
import tomli_w
from pydantic import ValidationError

from forward.bodies.mesh_file import MeshFile
from inverse.data.scans import Scan, read
from inverse.data.table import DataError
from tests.forward.bodies.test_mesh_file import box, numbered
from tests.fuzz import damaged_bytes, damaged_table, mutations
from workflows.__main__ import main
from workflows.config.mistakes import StudyError
from workflows.config.study import parse
from workflows.run import run as study_runs

CONFIGS = Path(__file__).parent.parent.parent.parent / "configs"
SHIPPED = {path.stem: tomllib.loads(path.read_text()) for path in CONFIGS.glob("*.toml")}
INNER = re.compile(
    r"function-|tagged-union|union_tag|pydantic|Traceback|type=|input_value|valid dictionary|instance of|lax-|"
    r"after validation|discriminat|typeerror|\[key\]|tuple\[|dict\[|list\[|NoneType|object has no|list index"
)
LONGEST = 620
FUNCTION = """
[model]
kind = "python"
function = "tests.functions.beam"
jacobian = "tests.functions.slopes"
parameters = { E = 1e6, load = 1.0, length = 0.1 }
outputs = [{ name = "tip", unit = "m" }, "weight"]

[parameters]
load = { kind = "truncated-normal", mean = 1.0, std = 0.1, lower = 0.5, upper = 1.5 }
E = { kind = "uniform", lower = 0.9e6, upper = 1.1e6 }

[method]
METHOD
"""
METHODS = (
    'kind = "monte-carlo"\nsamples = 8\nseed = 1',
    'kind = "quasi-monte-carlo"\nsamples = 16\ncontrol = "tangent"\nscrambles = 2',
    'kind = "chaos"\nsamples = 10\nmax_order = 3',
    'kind = "sobol"\nsamples = 8\ndesign = "saltelli"',
    'kind = "derivative-based"\nsamples = 8',
    'kind = "local-sensitivity"',
)


def assert_said_plainly(code, said, what):
    """Exit code 2 with a line for each mistake, as one reads it."""
    assert code == 2, (code, said, what)
    assert said.strip(), what
    assert len(said.splitlines()) <= 51, what
    for line in said.split("\n"):
        assert line.isprintable(), (line, what)
        assert len(line) <= LONGEST, (line, what)
        assert not INNER.search(line), (line, what)


def check_all(folder, capsys, documents, count, seed):
    path = folder / ".mutated.toml"
    valid = 0
    try:
        for name, document, done in mutations(documents, count, seed):
            path.write_text(tomli_w.dumps(document), encoding="utf-8")
            code, said = main(["check", str(path)]), capsys.readouterr().err
            valid += code == 0
            if code:
                assert_said_plainly(code, said, (name, done))
    finally:
        path.unlink(missing_ok=True)
    return valid


def test_mutations_of_shipped_studies(capsys):
    assert 10 < check_all(CONFIGS, capsys, SHIPPED, 75, 1) < 50


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3])
def test_many_mutations_of_shipped_studies(capsys, seed):
    check_all(CONFIGS, capsys, SHIPPED, 2000, seed)


def run_all(folder, capsys, count, seed):
    """Run what passes `check`, if it is small."""
    documents = {str(i): tomllib.loads(FUNCTION.replace("METHOD", method)) for i, method in enumerate(METHODS)}
    path, ran = folder / "study.toml", 0
    for i, (name, document, done) in enumerate(mutations(documents, count, seed)):
        try:
            if parse(document).planned > 300:
                continue
        except StudyError:
            continue
        path.write_text(tomli_w.dumps(document), encoding="utf-8")
        code = main(["run", str(path), "--out", str(folder / str(i)), "--quiet"])
        said = capsys.readouterr().err
        ran += 1
        assert code in {0, 1, 2, 3}, (name, done)
        assert "Traceback" not in said, (said, name, done)
        if code == 1:
            assert said.startswith("failed: "), (said, name, done)
        if code == 2:
            assert_said_plainly(code, said, (name, done))
    return ran


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_runs_of_mutations(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(study_runs, "_report", lambda directory: None)
    assert run_all(tmp_path, capsys, 600, 5) > 100


@pytest.mark.parametrize("kind", [[], ["chaos"], {}, {"kind": "chaos"}, 3, 1.5, True, "", "tetra hedron", "chaos "])
@pytest.mark.parametrize("place", ["method", "model", "model.body", "model.material", "parameters.material.D1"])
def test_kinds_that_are_none(place, kind):
    document = tomllib.loads((CONFIGS / "tiny.toml").read_text())
    here = document
    for step in place.split(".", 1) if place.startswith("parameters") else place.split("."):
        here = here[step]
    here["kind"] = kind
    with pytest.raises(StudyError) as caught:
        parse(document)
    (line,) = caught.value.args
    assert line.startswith(f"{place}.kind: ")
    given = line.partition("given ")[2]
    assert given == repr(kind)
    assert f"did you mean {given}?" not in line


@pytest.mark.parametrize(
    "text",
    ["a = " + "[" * 5000, ".".join("a" * 5000) + " = 1", "[" + ".".join("a" * 5000) + "]", "a = " + "{a=" * 5000],
)
def test_thousands_of_levels(tmp_path, capsys, text):
    path = tmp_path / "deep.toml"
    path.write_text(f"{text}\n")
    assert main(["check", str(path)]) == 2
    assert "nested too deeply" in capsys.readouterr().err
    assert main(["check", str(CONFIGS / "tiny.toml"), "--set", text.replace(" ", "")]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_bytes_that_are_no_study(tmp_path, capsys):
    chance = random.Random(4)
    text = (CONFIGS / "tiny.toml").read_bytes()
    path = tmp_path / "study.toml"
    for _ in range(100):
        damaged = bytearray(text[: chance.randrange(len(text))])
        for _ in range(chance.randrange(4)):
            damaged[chance.randrange(len(damaged) + 1) : 0] = chance.randbytes(1)
        path.write_bytes(bytes(damaged))
        assert main(["check", str(path)]) == 2
        assert_said_plainly(2, capsys.readouterr().err, bytes(damaged))


@pytest.mark.parametrize("name", ["inclusion", "brain"])
def test_tables_with_mistakes(tmp_path, capsys, name):
    study = tmp_path / "study.toml"
    study.write_bytes((CONFIGS / f"{name}.toml").read_bytes())
    table = tmp_path / "data" / f"{name}.csv"
    table.parent.mkdir()
    lines = (CONFIGS / "data" / f"{name}.csv").read_text().splitlines()
    head = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    text = "\n".join([*lines[: head + 1], *lines[head + 1 :: 20]])
    chance = random.Random(1)
    for _ in range(25):
        data, done = damaged_table(text, chance)
        table.write_bytes(data)
        code, said = main(["check", str(study)]), capsys.readouterr().err
        if code:
            assert_said_plainly(code, said, (name, done))


@pytest.mark.few(1)
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("count", [6, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("name", "how"),
    [
        ("a.vtu", {"binary": False}),
        ("a.xdmf", {}),
        pytest.param("a.vtu", {}, marks=pytest.mark.slow),
        pytest.param("a.vtk", {}, marks=pytest.mark.slow),
    ],
)
def test_meshes_with_mistakes(tmp_path, name, how, count):
    """As bodies and as files of displacements in turn: some formats are read by a process of their own each time."""
    whole = numbered(box())
    whole.point_data["displacement"] = whole.points / 100
    meshio.write(tmp_path / name, whole, **how)
    path = tmp_path / name
    good, chance = path.read_bytes(), random.Random(2)
    for number in range(count):
        data, done = damaged_bytes(good, chance)
        path.write_bytes(data)
        said = []
        try:
            if number % 2:
                read(path.parent, Scan(file=path.name), ("one",))
            else:
                MeshFile(file=str(path))
        except ValidationError as error:
            said += [str(mistake["msg"]) for mistake in error.errors()]
        except DataError as error:
            said += error.args
        for line in said:
            assert line.isprintable(), (line, done)
            assert len(line) <= LONGEST, (line, done)


@pytest.mark.parametrize("corner", [-1, 10**6])
def test_corners_that_are_no_points(tmp_path, corner):
    """Those below zero once counted from the end, and were another mesh."""
    whole = numbered(box())
    whole.cells[0].data[0, 0] = corner
    meshio.write(tmp_path / "a.vtk", whole)
    with pytest.raises(ValidationError, match="corners that are not among its"):
        MeshFile(file=str(tmp_path / "a.vtk"))


@pytest.mark.parametrize("numbers", ["mean = 1e300, std = 1", "mean = 1, std = 1e100", "mean = 1e-200, std = 1e-201"])
@pytest.mark.parametrize("kind", ["normal", "log-normal"])
def test_numbers_whose_powers_are_none(capsys, kind, numbers):
    given = f"parameters.density={{ kind = '{kind}', {numbers} }}"
    code = main(["check", str(CONFIGS / "beam.toml"), "--set", given])
    assert_said_plainly(code, capsys.readouterr().err, given)


@pytest.mark.parametrize("number", ["1" + "0" * 400, "-1e308", "5e-324", "9" * 5000, str(2**63 - 1)])
@pytest.mark.parametrize(
    "place",
    ["method.samples", "method.seed", "material.D1", "loads.gravity.density", "body.size", "loads.gravity.direction"],
)
def test_numbers_that_are_none(capsys, place, number):
    """Integers beyond 64 bits, and sizes of which the square is no number, in the study or on the command line."""
    whole = place if place.startswith("method") else f"model.{place}"
    given = f"{whole}=[{number}, 1, 1]" if place.endswith(("size", "direction")) else f"{whole}={number}"
    code = main(["check", str(CONFIGS / "tiny.toml"), "--set", given])
    said = capsys.readouterr().err
    if code == 0:
        assert number == str(2**63 - 1)
    else:
        assert_said_plainly(code, said, given)
        assert len(said) < 300


def test_names_of_files_that_are_no_names(capsys):
    assert_said_plainly(main(["check", "a\0b"]), capsys.readouterr().err, "")
