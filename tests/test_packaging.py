"""What is installed: one package in site-packages, which finds the others in itself."""

import subprocess
import sys
import zipfile

import pytest

from tests.launch import ROOT


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
        env={"PYTHONPATH": str(site)},
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
