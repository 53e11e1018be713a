"""The results of the shipped studies and of the net on another commit and here: the same, or what differs.

python -m benchmarks.same_results COMMIT [NAME ...] [--net] runs all studies (or those named, or the net only) with the
code of that commit and of this tree, and says in one line for each what differs: variables to the bit, attributes,
findings, what is in the summary, files that are written, and the exit code, but measured times. The net is the small
studies in benchmarks/net, which keep abilities that no file in configs/ runs. Both codes run the files of this tree.
Reports, which take longer than most of these studies, are written where a study has a block of its own on them.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from tests.launch import environment, on_ranks

ROOT = Path(__file__).parent.parent
NET = Path("benchmarks/net")
FOLDERS = (Path("configs"), NET)
SHORTER = {  # what keeps the kind of study, at less cost
    "batch": ("method.samples=32", "method.starts=1", "model.body.cells=[3, 3, 3]"),
    "beam-million": ("model.body.cells=[4, 1, 2]",),
    "beam-compare": ("method.repeats=2", "method.textbook=1", "model.body.cells=[4, 1, 2]"),
    "beam-coverage": ("method.repeats=2",),
    "beam-field": ("method.samples=32", "model.body.cells=[6, 1, 2]"),
    "beam-monte-carlo": ("method.samples=128",),
    "beam-multifidelity": ("model.body.cells=[6, 1, 2]",),
    "beam-saltelli": ("method.samples=128",),
    "beam-tolerance": ("accuracy.tolerance=1e-2", "model.body.cells=[4, 1, 2]"),
    "beam-wide": ("method.samples=200",),
    "brain": ("method.samples=64",),
    "compression": ("model.body.cells=[2, 2, 2]",),
    "cook": ("method.samples=16",),
    "four-parameters": ("method.repeats=2", "method.textbook=1"),
    "inclusion": ("method.samples=32", "method.starts=1", "model.body.cells=[3, 3, 3]"),
    "inclusion-material": ("method.samples=32", "method.starts=1", "model.body.cells=[3, 3, 3]"),
    "indentation": ("method.samples=32", "method.starts=1", "model.body.cells=[2, 2, 2]"),
    "indentation-forward": ("model.body.cells=[3, 3, 3]",),
    "indentation-material": ("model.body.cells=[2, 2, 2]",),
    "organ": ("method.samples=16",),
    "palpation": ("model.body.degree=1",),
    "palpation-field": ("model.body.degree=1",),
    "scan": ("method.samples=32", "model.body.cells=[3, 3, 3]"),
    "slab": ("method.snapshots=24", "method.modes=12", "method.unseen=8", "model.body.cells=[4, 3, 1]"),
    "slab-inversion": ("method.samples=64", "method.starts=1", "model.body.cells=[4, 3, 1]"),
    "stiffness-field": ("model.body.cells=[6, 6, 6]",),
    "synthesize-batch": ("model.body.cells=[4, 4, 4]",),
    "synthesize-field": ("model.body.cells=[5, 5, 5]",),
    "synthesize-inclusion": ("model.body.cells=[4, 4, 4]",),
    "synthesize-inclusion-material": ("model.body.cells=[4, 4, 4]",),
    "synthesize-indentation": ("model.body.cells=[3, 3, 3]",),
    "synthesize-palpation": ("model.body.cells=[3, 3, 2]",),
    "synthesize-palpation-field": ("model.body.cells=[3, 3, 2]",),
    "synthesize-scan": ("model.body.cells=[4, 4, 4]",),
    "synthesize-slab": ("model.body.cells=[5, 4, 2]",),
    "treloar": ("method.samples=64",),
}
NOT_HERE = ("um-bridge",)  # wants a server
MOST = 12  # differences of a study that are said
NAMES_OF_RESULTS = ("from", "file", "files", "source")  # keys that may name the results of another study
# In names of variables, attributes and keys of the summary: what no run gives again, and where and when it ran.
MEASURED = ("seconds", "times", "date", "commit", "results_sha256")


class Case(NamedTuple):
    """A study: its file, from the root of the tree."""

    file: Path

    @property
    def name(self) -> str:
        """What it is called on the command line and where its results are."""
        return self.file.stem

    @property
    def text(self) -> Mapping[str, Any]:
        """What stands in the file."""
        return tomllib.loads((ROOT / self.file).read_text(encoding="utf-8"))

    @property
    def needs(self) -> set[str]:
        """Names of the studies of the net whose results it reads."""
        if self.file.parent != NET:
            return set()
        beside = {path.stem for path in (ROOT / NET).glob("*.toml")}
        return {Path(value).parts[0] for key, value in _texts(self.text) if key in NAMES_OF_RESULTS} & beside

    @property
    def ranks(self) -> int:
        """On how many ranks it has to run."""
        found: int = self.text.get("parallel", {}).get("ranks_per_model", 1)
        return found


class Done(NamedTuple):
    """A run: where its results are, its exit code and its processor time (s)."""

    directory: Path
    code: int
    seconds: float

    @property
    def results(self) -> dict[str, xr.Dataset]:
        """The groups of its results by name, of the root too."""
        import h5py

        path, found = self.directory / "results.nc", ["/"]
        with h5py.File(path) as file:
            file.visititems(lambda name, item: found.append(f"/{name}/") if isinstance(item, h5py.Group) else None)
        return {name: xr.load_dataset(path, group=name.strip("/") or None, engine="h5netcdf") for name in found}

    @property
    def summary(self) -> dict[str, Any]:
        """What is in summary.json."""
        found: dict[str, Any] = json.loads((self.directory / "summary.json").read_text(encoding="utf-8"))
        return found

    @property
    def files(self) -> set[str]:
        """The files that it has written."""
        return {str(path.relative_to(self.directory)) for path in self.directory.rglob("*") if path.is_file()}


def main() -> int:
    """Run and compare; 1 where anything differs."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.same_results", description=__doc__)
    parser.add_argument("commit", help="what this tree is compared with")
    parser.add_argument("names", nargs="*", metavar="NAME", help="studies; by default all")
    parser.add_argument("--net", action="store_true", help="the net only")
    given = parser.parse_args()
    cases = cases_of([NET] if given.net else FOLDERS)
    wrong = set(given.names) - cases.keys()
    if wrong:
        parser.error(f"no study is called {', '.join(sorted(wrong))}")
    differs, spent = False, np.zeros(2)
    with tempfile.TemporaryDirectory() as scratch:
        before = Path(scratch) / "tree"
        subprocess.run(["git", "-C", ROOT, "worktree", "add", "--quiet", "--detach", before, given.commit], check=True)
        places = {"before": before, "here": ROOT}
        for place in places:
            for folder in FOLDERS:
                shutil.copytree(ROOT / folder, Path(scratch) / place / folder)
        try:
            for case in in_order(cases, given.names):
                old, new = (_run(tree, case, Path(scratch) / place) for place, tree in places.items())
                said = list(compared(old, new))
                differs |= bool(said)
                spent += old.seconds, new.seconds
                words = "; ".join(said[:MOST]) or f"the same (exit code {new.code})"
                words += f"; and {len(said) - MOST} more" if len(said) > MOST else ""
                sys.stdout.write(f"{case.name:28} {old.seconds:6.1f} s {new.seconds:6.1f} s  {words}\n")
                sys.stdout.flush()
        finally:
            subprocess.run(["git", "-C", ROOT, "worktree", "remove", "--force", before], check=True)
    sys.stdout.write(f"{'processor time':28} {spent[0]:6.1f} s {spent[1]:6.1f} s\n")
    return int(differs)


def cases_of(folders: Sequence[Path]) -> dict[str, Case]:
    """Return the studies in folders by name."""
    files = [path.relative_to(ROOT) for folder in folders for path in sorted((ROOT / folder).glob("*.toml"))]
    return {path.stem: Case(path) for path in files if path.stem not in NOT_HERE}


def in_order(cases: Mapping[str, Case], names: Sequence[str]) -> list[Case]:
    """Return studies by name, and those that they need before them; without names, all."""
    sorter, waiting = TopologicalSorter[str](), list(names or cases)
    while waiting:
        name = waiting.pop(0)
        sorter.add(name, *sorted(cases[name].needs - {name}))
        waiting += sorted(cases[name].needs - {name})
    return [cases[name] for name in sorter.static_order()]


def compared(old: Done, new: Done) -> Iterator[str]:
    """Say what differs between two runs of one study."""
    if old.code != new.code:
        yield f"exit code {old.code} before, {new.code} here"
    try:
        yield from _of_results(old.results, new.results)
        yield from _of_summaries(old, new)
    except OSError as error:
        yield f"no results: {error}"
    yield from (f"file {name} only {_where(name, new.files)}" for name in sorted(old.files ^ new.files))


def _run(tree: Path, case: Case, place: Path) -> Done:
    """Run a study of a folder, where those are that it needs, with the code of a tree.

    While it runs, the folder has the same name for all trees: results keep the paths of what was read.
    """
    now = place.with_name("now")
    folder = now / case.file.parent
    command = [sys.executable, "-m", "workflows", "run", case.file.name, "--out", case.name, "--quiet"]
    command += [word for setting in SHORTER.get(case.name, ()) for word in ("--set", setting)]
    if "report" not in case.text:
        command.append("--no-report")
    command = on_ranks(case.ranks if case.ranks > 1 else None, *command)
    paths = environment() | {"PYTHONPATH": str(tree)}
    start = _spent()
    place.rename(now)
    try:
        done = subprocess.run(command, cwd=folder, env=paths, capture_output=True, text=True, check=False)
    finally:
        now.rename(place)
    if done.returncode not in {0, 3}:
        sys.stderr.write(f"{case.name} in {tree}: {done.stderr}")
    return Done(place / case.file.parent / case.name, done.returncode, _spent() - start)


def _spent() -> float:
    """Processor time (s) of all processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _of_results(old: Mapping[str, xr.Dataset], new: Mapping[str, xr.Dataset]) -> Iterator[str]:
    """Say what differs between two results, group by group."""
    yield from (f"group {name} only {_where(name, new)}" for name in sorted(old.keys() ^ new.keys()))
    for name in sorted(old.keys() & new.keys()):
        left, right = old[name], new[name]
        yield from _of_mappings(f"{name}@", left.attrs, right.attrs, but="findings")
        kinds = [{str(variable): item for variable, item in found.variables.items()} for found in (left, right)]
        for variable in sorted(kinds[0].keys() | kinds[1].keys()):
            if not _measured(variable):
                yield from _of_variables(f"{name}{variable}", *(kind.get(variable) for kind in kinds))


def _of_variables(name: str, old: xr.Variable | None, new: xr.Variable | None) -> Iterator[str]:
    """Say by how much a variable differs."""
    if old is None or new is None:
        yield f"{name} only {'here' if old is None else 'before'}"
        return
    a, b = old.to_numpy(), new.to_numpy()
    if old.dims != new.dims or a.dtype != b.dtype or not _same(a, b):
        if a.shape != b.shape or not a.dtype.kind == b.dtype.kind == "f" or not np.isfinite(a).any():
            yield f"{name} differs"
        else:
            yield f"{name} by {np.nanmax(np.abs(a - b)) / (np.nanmax(np.abs(a)) or 1.0):.1e}"
    yield from _of_mappings(f"{name}@", old.attrs, new.attrs)


def _of_summaries(old: Done, new: Done) -> Iterator[str]:
    """Say which findings differ, and which entries of the summary."""
    said = [Counter(f"{one['severity']}: {one['text']}" for one in done.summary["findings"]) for done in (old, new)]
    yield from (f"only before “{text}”" for text in said[0] - said[1])
    yield from (f"only here “{text}”" for text in said[1] - said[0])
    yield from _of_mappings("summary ", old.summary, new.summary, but="findings")


def _of_mappings(name: str, old: Mapping[str, Any], new: Mapping[str, Any], but: str = "") -> Iterator[str]:
    """Say which entries of two nested mappings differ."""
    for key in dict.fromkeys((*old, *new)):
        if key == but or _measured(key):
            continue
        if key not in old or key not in new:
            yield f"{name}{key} only {_where(key, new)}"
            continue
        a, b = _opened(old[key]), _opened(new[key])
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            yield from _of_mappings(f"{name}{key}.", a, b)
        elif json.dumps(a) != json.dumps(b):
            yield f"{name}{key} differs"


def _opened(value: Any) -> Any:
    """Return a value as JSON can hold it: lists are mappings by their places, texts of JSON or TOML what these say."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, str) and value.startswith(("{", "[")):
        with suppress(ValueError):
            value = json.loads(value)
    if isinstance(value, str) and "\n" in value:
        with suppress(ValueError):
            value = tomllib.loads(value)
    return {str(place): one for place, one in enumerate(value)} if isinstance(value, list) else value


def _where(name: str, new: Any) -> str:
    return "here" if name in new else "before"


def _measured(name: str) -> bool:
    return any(word in name for word in MEASURED)


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.array_equal(a, b) if a.dtype.kind == "O" else a.tobytes() == b.tobytes())


def _texts(value: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Iterate over the texts in a table, with their keys."""
    if isinstance(value, Mapping):
        for name, one in value.items():
            yield from _texts(one, name)
    elif isinstance(value, list):
        for one in value:
            yield from _texts(one, key)
    elif isinstance(value, str) and value:
        yield key, value


if __name__ == "__main__":
    sys.exit(main())
