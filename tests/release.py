"""Build what is published into dist/, and check it as those get it who install it: `make release`."""

import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import zipfile
from pathlib import Path

from packaging.metadata import Metadata

from tests.launch import ROOT, environment

DIST = ROOT / "dist"
VERSION = {  # where it stands
    "pyproject.toml": r'^version = "(.+)"$',
    "CITATION.cff": r"^version: (.+)$",
    "CHANGELOG.md": r"^## \[(\d.*?)\]",
    "docs/install.md": r"tissuq-(.+?)-py3-none-any\.whl",
    "packaging/conda/recipe.yaml": r"^ +version: \"?([\d.]+)",
}
DATE = {"CITATION.cff": r"^date-released: (.+)$", "CHANGELOG.md": r"^## \[\d.*?\] - (.+)$"}
SITE = "import tissuq; print(tissuq.__file__)"


def stated(places):
    """What each file says, by its name."""
    return {name: re.search(pattern, (ROOT / name).read_text(), re.M)[1] for name, pattern in places.items()}


def git(*words):
    """What git says of this tree."""
    return subprocess.check_output(["git", *words], cwd=ROOT, text=True)


def refused():
    """Why there is nothing to release, if so."""
    for said in map(stated, (VERSION, DATE)):
        if len(set(said.values())) > 1:
            return f"files do not agree: {said}"
    if re.search(r"^## \[Unreleased\]", (ROOT / "CHANGELOG.md").read_text(), re.M):
        return "CHANGELOG.md has changes without a version"
    changed = git("status", "--porcelain")
    return f"what is not committed would be published:\n{changed}" if changed else ""


def do(*command, place=ROOT, **more):
    """Run a command; what it prints."""
    begin = time.monotonic()
    done = subprocess.run(
        list(map(str, command)), cwd=place, env=environment() | more, check=True, stdout=subprocess.PIPE, text=True
    )
    said = f"{time.monotonic() - begin:4.0f} s  {Path(command[0]).name} {' '.join(map(str, command[1:]))}"
    sys.stdout.write(f"{said[:120]}\n")
    sys.stdout.flush()
    return done.stdout.strip()


def main():
    """Build and check; an exception, or a line that says why not."""
    why = refused()
    if why:
        sys.exit(why)
    version = stated(VERSION)["pyproject.toml"]
    shutil.rmtree(DIST, ignore_errors=True)
    do(Path(sys.executable).parent / "hatchling", "build", "--target", "sdist")
    (archive,) = DIST.glob("*.tar.gz")
    with tarfile.open(archive) as files:
        held = {Path(*Path(one.name).parts[1:]).as_posix() for one in files if one.isfile()}
    extra = held - {"PKG-INFO", *git("ls-files").splitlines()}
    assert not extra, extra
    offline = ("--quiet", "--no-index", "--no-deps", "--no-build-isolation")
    do(sys.executable, "-m", "pip", "wheel", *offline, "--wheel-dir", DIST, archive)  # from what is published
    (wheel,) = DIST.glob("*.whl")
    with zipfile.ZipFile(wheel) as files:
        told = Metadata.from_email(files.read(f"tissuq-{version}.dist-info/METADATA"), validate=True)
    assert (told.name, str(told.version), told.description_content_type) == ("tissuq", version, "text/markdown")
    with tempfile.TemporaryDirectory() as place:
        inside = Path(place) / "venv" / "bin"
        do(sys.executable, "-m", "venv", "--system-site-packages", inside.parent)
        pinned = {"PIP_CONSTRAINT": str(ROOT / "constraints.txt"), "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
        do(inside / "pip", "install", "--quiet", wheel, **pinned)
        assert Path(do(inside / "python", "-c", SITE, place=place)).is_relative_to(place)
        assert do(inside / "tissuq", "--version", place=place) == f"tissuq {version}"
        do(inside / "tissuq", "run", ROOT / "configs" / "tiny.toml", "--out", Path(place) / "tiny", place=place)
        assert (Path(place) / "tiny" / "report.html").exists()
    docker = shutil.which("docker")
    if docker and subprocess.run([docker, "info"], capture_output=True, check=False).returncode == 0:
        do(docker, "build", "--tag", f"tissuq:{version}", "--file", "packaging/Dockerfile", ".")
    else:
        sys.stdout.write("packaging/Dockerfile is not built: no daemon of docker answers here\n")
    for path in sorted(DIST.iterdir()):
        sys.stdout.write(f"{path.relative_to(ROOT)}  {path.stat().st_size / 1e6:.1f} MB\n")


if __name__ == "__main__":
    main()
