"""The modules of a user's model: found beside the study, never in place of others, and never mixed with older ones."""

import importlib
import json
import shutil
import sys
from importlib.metadata import version

import numpy as np
import pytest
import xarray as xr

from forward.external import own_modules
from forward.external.models import PythonModel
from forward.external.own_modules import Loaded, Sources, sources
from tests.launch import ROOT, run_script
from workflows.__main__ import main

STUDY = """
[model]
kind = "python"
function = "{0}.f"
parameters = {{ a = 1.0 }}
outputs = ["b"]

[parameters]
a = {{ kind = "uniform", lower = 0.5, upper = 1.5 }}

[method]
kind = "monte-carlo"
samples = 40
"""
# Interrupted with some blocks on disk, where a file says so.
MODEL = """
import pathlib
{0}
count = 0

def f(p):
    global count
    count += 1
    if count > 20 and (pathlib.Path(__file__).parent / "die").exists():
        raise KeyboardInterrupt
    {1}
    return p * factor()
"""
HELPER = "def factor():\n    return {}\n"
WAYS = {  # of importing factor(): at the head of the module, in the function, and where it comes from
    "helper": ("from own_helper import factor", "", "own_helper.py"),
    "of a helper": ("from own_first import factor", "", "own_helper.py"),
    "package": ("from own_package.deep.inner import factor", "", "own_package/deep/inner.py"),
    "its head": ("from own_package.deep.inner import factor", "", "own_package/__init__.py"),
    "relative": ("from own_package import factor", "", "own_package/deep/inner.py"),
    "when called": ("", "from own_helper import factor", "own_helper.py"),
    "by a text": ("import importlib", "factor = importlib.import_module('own_helper').factor", "own_helper.py"),
    "by a computed name": (
        "import importlib",
        "factor = importlib.import_module('own_' + 'helper').factor",
        "own_helper.py",
    ),
    "from a folder of its own": (
        "import sys; sys.path.insert(0, str(pathlib.Path(__file__).parent / 'lib')); import own_lib",
        "factor = own_lib.factor",
        "lib/own_lib.py",
    ),
}


def write(folder, way):
    head, within, _ = WAYS[way]
    for name, text in {
        "study.toml": STUDY.format("own_model"),
        "own_model.py": MODEL.format(head, within),
        "own_helper.py": HELPER.format(2),
        "own_first.py": "from own_helper import factor\n",
        "own_package/__init__.py": "from .deep import inner\nfactor = inner.factor\n",
        "own_package/deep/__init__.py": "",
        "own_package/deep/inner.py": HELPER.format(2),
        "lib/own_lib.py": HELPER.format(2),
        "die": "",
    }.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


@pytest.fixture
def tissuq(monkeypatch, capsys):
    """The command in this process, each time as if it were a new one that had not seen the user's modules."""

    def command(*arguments):
        with monkeypatch.context() as changed:
            changed.setattr(sys, "path", [*sys.path])
            code = main([*map(str, arguments)])
            for name in [name for name in sys.modules if name.startswith("own_")]:
                del sys.modules[name]
        return code, capsys.readouterr().err.splitlines()

    return command


@pytest.mark.few(1)
@pytest.mark.parametrize("way", WAYS)
def test_a_module_that_changes_between_interrupt_and_restart_is_refused(tmp_path, tissuq, way):
    write(tmp_path, way)
    command = ("run", tmp_path / "study.toml", "--out", tmp_path / "out", "--quiet", "--no-report")
    code, said = tissuq(*command)
    assert code == 1, said
    assert any((tmp_path / "out" / "evaluations").glob("*.block"))
    (tmp_path / "die").unlink()
    changed = tmp_path / WAYS[way][2]
    before = changed.read_text()
    changed.write_text(HELPER.format(3))
    code, said = tissuq(*command)
    assert code == 2
    assert said == [f"{tmp_path / 'out'}: holds results of other code: {changed} has changed; choose another --out"]
    changed.write_text(before)
    assert tissuq(*command)[0] == 0
    data = xr.load_dataset(tmp_path / "out" / "results.nc")
    np.testing.assert_array_equal(data["values"].values, 2 * data["points"].values)
    changed.unlink()
    assert tissuq(*command)[0] == 2


def test_before_anything_is_computed_the_model_may_change(tmp_path, tissuq):
    write(tmp_path, "helper")
    model = tmp_path / "own_model.py"
    model.write_text(model.read_text().replace("count > 20", "count > 0"))
    command = ("run", tmp_path / "study.toml", "--out", tmp_path / "out", "--quiet", "--no-report")
    code, said = tissuq(*command)
    assert code == 1, said
    (tmp_path / "own_helper.py").write_text(HELPER.format(3))
    (tmp_path / "die").unlink()
    assert tissuq(*command)[0] == 0
    assert json.loads((tmp_path / "out" / "sources.json").read_text())["files"].keys() == {"own_model", "own_helper"}


def test_versions_of_installed_packages_are_part_of_the_source(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "own_versions.py").write_text(
        "import numpy as np, pydantic, yaml, json, uq.inputs.sampling, nowhere_at_all\n"
    )
    found = sources(["own_versions"])
    assert found.versions == {name: version(name) for name in ("numpy", "pydantic", "PyYAML")}
    assert found.files.keys() == {"own_versions"}
    other = Sources(found.files, found.versions | {"numpy": "1.0"})
    assert other.change(found) == f"numpy was 1.0, and is {version('numpy')}"
    assert found.change(found) is None


def test_the_model_follows_its_helpers_in_one_process(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "own_outer.py").write_text("from own_inner import factor\ndef f(p):\n    return factor() * p\n")
    model = PythonModel(function="own_outer.f", parameters={"a": 1.0}, outputs=("b",))
    for factor in (2, 3, 4):  # of one length, within a second
        (tmp_path / "own_inner.py").write_text(HELPER.format(factor))
        assert model.build(None, ("a",)).solve(np.array([1.0])).outputs == [factor]


def test_modules_are_walked_through_again_once_a_text_or_a_folder_has_changed(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "own_kind.py").write_text("from own_part import size\n")
    part, walks = tmp_path / "own_part.py", []
    monkeypatch.setattr(own_modules, "sources", lambda modules: (walks.append(modules), sources(modules))[1])
    for size in (1, 2):
        part.write_text(f"size = {size}\n")
        assert [own_modules.imported("own_kind").size for _ in range(3)] == [size] * 3
        assert len(walks) == size
    (tmp_path / "own_part").mkdir()  # a package is found before a file
    (tmp_path / "own_part" / "__init__.py").write_text("size = 3\n")
    assert [own_modules.imported("own_kind").size for _ in range(3)] == [3] * 3
    assert len(walks) == 3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["queue", "pyvista", "numpy", "inverse", "json", "h5py"])
def test_what_stands_beside_a_study_is_not_run_in_place_of_others(tmp_path, name):
    """As a process, under a study of a Python model, which needs the folder, and of a body, which does not."""
    (tmp_path / f"{name}.py").write_text("raise SystemExit('a stray file was run')\n")
    shutil.copy(ROOT / "configs" / "tiny.toml", tmp_path)
    (tmp_path / "study.toml").write_text(STUDY.format("own_beam"))
    (tmp_path / "own_beam.py").write_text("def f(p):\n    return p\n")
    script = (
        "import sys; from workflows.__main__ import main; import importlib; "
        "assert main(['check', sys.argv[1]]) == 0; importlib.import_module(sys.argv[3]); "
        "assert main(['check', sys.argv[2]]) == 0"
    )
    done = run_script(None, script, tmp_path / "tiny.toml", tmp_path / "study.toml", name)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", ["queue", "scipy", "uq", "sys"])
def test_a_model_that_is_called_like_another_module_is_refused(tmp_path, tissuq, name):
    (tmp_path / "study.toml").write_text(STUDY.format(name))
    (tmp_path / f"{name}.py").write_text("def f(p):\n    return p\n")
    code, said = tissuq("check", tmp_path / "study.toml")
    assert code == 2
    assert len(said) == 1
    assert said[0].startswith(f"model.function: '{name}' is both {tmp_path / name}.py and ")
    assert said[0].endswith("expected a name of its own: rename the first")


def test_a_helper_that_is_called_like_another_module_is_refused(tmp_path, tissuq):
    (tmp_path / "study.toml").write_text(STUDY.format("own_beam"))
    (tmp_path / "own_beam.py").write_text("import statistics\ndef f(p):\n    return statistics.factor * p\n")
    assert tissuq("check", tmp_path / "study.toml")[0] == 0
    (tmp_path / "statistics.py").write_text("factor = 3\n")
    code, said = tissuq("check", tmp_path / "study.toml")
    assert code == 2
    assert said[0].startswith(f"model.function: {tmp_path / 'own_beam.py'} imports 'statistics', which is both ")


def test_modules_of_others_are_asked_about_once(monkeypatch, tmp_path):
    """Each block that is kept asks which of the user's modules are loaded: most of a small study's time, if all are."""
    asked, known = [], own_modules._is_own
    monkeypatch.setattr(own_modules, "_is_own", lambda file: asked.append(file) or known(file))
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "mine_alone.py").write_text("import colorsys")
    monkeypatch.delitem(sys.modules, "colorsys", raising=False)
    loaded = Loaded()
    importlib.import_module("mine_alone")
    assert list(loaded()) == ["mine_alone"] == list(loaded())
    assert sorted(file.name for file in asked) == ["colorsys.py", "mine_alone.py"]
