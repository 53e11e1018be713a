"""What is installed: one package in site-packages, which finds the others in itself."""

import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile

import pytest
import yaml
from packaging.requirements import Requirement

from tests.launch import ROOT, environment, run_script
from tests.release import DATE, VERSION, stated


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder with what the wheel holds."""
    folder = tmp_path_factory.mktemp("wheel")
    build = "import sys; from hatchling.build import build_wheel; build_wheel(sys.argv[1])"
    done = subprocess.run([sys.executable, "-c", build, folder], check=False, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


def python(site, folder, *arguments):
    """Run Python elsewhere, with the wheel before all other places."""
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=environment() | {"PYTHONPATH": str(site)},
        check=False,
        capture_output=True,
        text=True,
    )


def test_no_name_but_its_own(site):
    assert sorted(path.name.partition("-")[0] for path in site.iterdir()) == ["tissuq", "tissuq"]


def test_the_command_runs(site, tmp_path):
    done = python(site, tmp_path, "-m", "tissuq", "check", ROOT / "configs" / "tiny.toml")
    assert done.returncode == 0, done.stderr
    assert "unknowns    405" in done.stdout


def test_packages_and_templates_are_within_it(site, tmp_path):
    script = (
        "import tissuq, forward, workflows.report, pathlib; "
        "print(forward.__file__, *pathlib.Path(workflows.report.__file__).parent.glob('*.jinja'))"
    )
    done = python(site, tmp_path, "-c", script)
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.split()) > 1
    assert all(path.startswith(str(site / "tissuq" / "_packages")) for path in done.stdout.split())


def test_another_package_of_that_name_is_not_taken_for_it(site, tmp_path):
    (tmp_path / "forward.py").write_text("")
    done = python(site, tmp_path, "-c", "import forward, tissuq")
    assert "a module called 'forward'" in done.stderr.splitlines()[-1]


@pytest.mark.parametrize(
    "absent", ["dolfinx", "mpi4py", *(pytest.param(name, marks=pytest.mark.slow) for name in ("petsc4py", "h5py"))]
)
def test_a_run_without_fenicsx_says_in_a_line_how_to_get_it(site, tmp_path, absent):
    words = ["run", str(ROOT / "configs" / "tiny.toml"), "--out", str(tmp_path / "out")]
    script = f"import sys; sys.modules['{absent}'] = None; from tissuq.__main__ import main; sys.exit(main({words}))"
    done = python(site, tmp_path, "-c", script)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"failed: {absent} cannot be imported")
    assert "apt-get install python3-dolfinx python3-h5py-mpi" in line
    assert "pip install 'tissuq[fenicsx]'" in line


def test_a_dolfinx_that_nobody_has_tried_is_named(tmp_path, monkeypatch):
    """With its version and those that were tried; on request it is taken, as if it were the newest of these."""
    script = (
        "import contextlib, sys\n"
        "with contextlib.suppress(ImportError):\n"
        "    import dolfinx_solver\n"  # what finds the libraries of wheels
        "import dolfinx\n"
        "dolfinx.__version__ = '0.9.0'\n"
        "from tissuq.__main__ import main\n"
        "sys.exit(main())"
    )
    words = ["run", str(ROOT / "configs" / "tiny.toml"), "--out", str(tmp_path / "out"), "--no-report"]
    words += ["--set", "method.samples=2", "--set", "model.body.cells=[2, 1, 1]", "--set", "mesh_error=false"]
    for asked in ("", "1"):
        monkeypatch.setenv("TISSUQ_ANY_DOLFINX", asked)
        done = run_script(None, script, *words)
        assert ("DOLFINx 0.9.0, expected one of 0.5.x, 0.11.x" in done.stderr) is (not asked)


def test_a_script_without_fenicsx_is_told_too(site, tmp_path):
    script = (
        "import sys; sys.modules['petsc4py'] = None; import tissuq; "
        f"tissuq.Model(tissuq.load({str(ROOT / 'configs' / 'tiny.toml')!r}).model)"
    )
    assert "pip install 'tissuq[fenicsx]'" in python(site, tmp_path, "-c", script).stderr.splitlines()[-1]


def test_on_debian_pip_takes_nothing_that_its_dolfinx_brings(site):
    """Debian's h5py has a name that pip does not know; another NumPy would break its DOLFINx."""
    (information,) = site.glob("tissuq-*.dist-info")
    lines = (information / "METADATA").read_text().splitlines()
    needed = [Requirement(line.removeprefix("Requires-Dist: ")) for line in lines if line.startswith("Requires-Dist: ")]
    debian = {"python_version": "3.11", "extra": ""}
    on_debian = {one.name: one for one in needed if one.marker is None or one.marker.evaluate(debian)}
    assert not {"h5py", "pyvista", "dolfinx-solver-real"} & set(on_debian)
    assert "1.24.2" in on_debian["numpy"].specifier
    assert "1.26.0" not in on_debian["numpy"].specifier


@pytest.mark.slow
def test_the_source_archive_holds_what_the_wheel_is_made_from(site, tmp_path):
    build = "import sys; from hatchling.build import build_sdist; print(build_sdist(sys.argv[1]))"
    done = subprocess.run(
        [sys.executable, "-c", build, tmp_path], check=True, cwd=ROOT, capture_output=True, text=True
    ).stdout.split()
    with tarfile.open(tmp_path / done[-1]) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}
    packages = site / "tissuq" / "_packages"
    installed = {
        str(path.relative_to(packages)) for path in packages.rglob("*") if path.is_file() and path.suffix != ".pyc"
    }
    assert installed <= held
    assert {"Makefile", "constraints.txt", "configs/tiny.toml", "docs/tutorial.md", "LICENSE"} <= held


PAGE = (ROOT / "docs" / "install.md").read_text()
RECIPES = {name: (ROOT / "packaging" / name).read_text() for name in ("Dockerfile", "tissuq.def", "conda/recipe.yaml")}


def variable(name):
    """A variable of the Makefile, as words."""
    found = re.search(rf"^{name} :?= ((?:.*\\\n)*.*)$", (ROOT / "Makefile").read_text(), re.M)
    return found[1].replace("\\\n", " ").split()


def test_containers_take_the_packages_and_versions_of_the_makefile():
    install = [*variable("INSTALL")]
    for name in ("Dockerfile", "tissuq.def"):
        joined = RECIPES[name].replace("\\\n", " ")
        taken = re.search(r"--no-install-recommends (.*?)(?:&&|\n)", joined)[1].split()
        assert taken == variable("PACKAGES")
        pip = next(line for line in joined.replace("&&", "\n").splitlines() if "pip install" in line).split()
        assert pip[0] == f"PIP_CONSTRAINT=/src/{install[0].partition('=')[2]}"
        assert "--no-compile" not in pip  # whoever runs it may not write there, and each start would compile all again
    assert set(re.search(r"apt-get install (.*)", PAGE)[1].split()) == set(variable("PACKAGES"))


def test_the_page_has_the_commands_of_the_recipes():
    for name in ("Dockerfile", "tissuq.def"):
        for command in re.findall(r"^#     (.*)$", RECIPES[name], re.M):
            assert f"    {command}\n" in PAGE
    for path in re.findall(r"packaging/[\w./]+\w", PAGE):
        assert (ROOT / path).exists()


def test_the_recipe_of_conda_needs_what_the_wheel_needs():
    recipe = yaml.safe_load(re.sub(r"\$\{\{.*?\}\}", "x", RECIPES["conda/recipe.yaml"]))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert recipe["context"]["version"] == project["version"]
    run = {line.split()[0] for line in recipe["requirements"]["run"]}
    needed = {Requirement(line).name for line in project["dependencies"]}
    assert run - {"python", "c-compiler", "fenics-dolfinx", "petsc4py", "h5py"} == (needed - {"matplotlib"}) | {
        "matplotlib-base"
    }


def test_the_extras_of_the_page_are_those_that_there_are():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(re.findall(r"^\| `(\w+)` \|", PAGE, re.M)) == set(extras) - {"benchmarks", "dev"}


def test_version_and_date_stand_in_all_places_alike():
    assert len(set(stated(VERSION).values())) == len(set(stated(DATE).values())) == 1


def test_authors_and_classifiers_are_those_that_there_are():
    classifiers = pytest.importorskip("trove_classifiers").classifiers
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert set(project["classifiers"]) <= classifiers
    assert project["authors"] == yaml.safe_load((ROOT / "CITATION.cff").read_text())["authors"]


def test_forges_run_the_targets_that_a_change_must_pass():
    (job,) = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())["jobs"].values()
    assert job["steps"][-1]["run"] == "make ${{ matrix.target }}"
    taken, makefile = job["strategy"]["matrix"]["target"], (ROOT / "Makefile").read_text()
    assert set(taken) <= set(re.findall(r"^([\w-]+):", makefile, re.M))
    everything = set(re.findall(r"make ([\w-]+)", (ROOT / ".ci" / "run").read_text()))
    assert set(taken) == everything - {"setup", "setup-wheel"}  # which the others make


# What can execute what it is given, or reach other programs. SECURITY.md says of each what that means.
REACH = re.compile(
    r"pickle\.(?:loads?|Unpickler)|(?<![.\w])(?:eval|exec)\(|CDLL\(|import_module\(|allow_pickle=True"
    r"|subprocess\.|urlopen\(|create_server\("
)
REACHING = {
    "forward/external/models.py": "servers of UM-Bridge",
    "forward/external/own_modules.py": "modules that a study names",
    "forward/fem/dolfinx/lanes.py": "compiled forms",
    "forward/files/vtk.py": "a process that reads a file",
    "forward/native.py": "compiled kernels",
    "forward/registry.py": "kinds: the program's own, and of installed packages",
    "inverse/optional.py": "packages that may be missing",
    "tissuq/__init__.py": "the program's own modules",
    "uq/evaluation/checkpoint.py": "finished blocks, by a reader of plain data",
    "uq/evaluation/ensemble.py": "errors, to other ranks",
    "workflows/http.py": "who is answered",
    "workflows/live/mail.py": "the processes of tissuq live",
    "workflows/run/progress.py": "a process that says a line a minute",
    "workflows/run/version.py": "git",
}


def test_what_can_execute_code_is_known():
    found = {
        path.relative_to(ROOT).as_posix()
        for package in ("forward", "uq", "inverse", "workflows", "tissuq")
        for path in (ROOT / package).rglob("*.py")
        if REACH.search(path.read_text())
    }
    assert found == set(REACHING)
