"""The results of all shipped studies on another commit and here: the same bytes, or by how much they differ.

python -m benchmarks.same_results COMMIT [NAME ...] runs every study (or those named) from a copy of that commit
and from this tree, shortened where it would take minutes, and compares all groups of results.nc but measured times.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import xarray as xr

ROOT = Path(__file__).parent.parent
SHORTER = {  # what keeps the kind of study, at less cost
    "batch": ("method.samples=32", "method.starts=1"),
    "beam-million": ("model.body.cells=[4, 1, 2]",),
    "beam-compare": ("method.repeats=2", "method.textbook=1", "model.body.cells=[4, 1, 2]"),
    "beam-coverage": ("method.repeats=2",),
    "four-parameters": ("method.repeats=2", "method.textbook=1"),
    "inclusion-material": ("method.samples=32", "method.starts=1", "model.body.cells=[3, 3, 3]"),
    "beam-monte-carlo": ("method.samples=128",),
    "beam-saltelli": ("method.samples=128",),
    "beam-wide": ("method.samples=200",),
    "organ": ("method.samples=16",),
    "brain": ("method.samples=64",),
}
NOT_HERE = ("um-bridge",)  # wants a server
MEASURED = ("seconds", "times")  # in names of variables of what no run gives again


def main() -> int:
    """Run and compare; 1 where anything differs."""
    commit, *names = sys.argv[1:]
    names = names or sorted(path.stem for path in (ROOT / "configs").glob("*.toml") if path.stem not in NOT_HERE)
    differs = False
    with tempfile.TemporaryDirectory() as scratch:
        before = Path(scratch) / "tree"
        subprocess.run(["git", "-C", ROOT, "worktree", "add", "--quiet", "--detach", before, commit], check=True)
        try:
            for name in names:
                codes = [_run(tree, name, Path(scratch) / label) for label, tree in (("a", before), ("b", ROOT))]
                said = _compared(Path(scratch) / "a" / name, Path(scratch) / "b" / name)
                if codes[0] != codes[1]:
                    said.append(f"exit code {codes[0]} before, {codes[1]} here")
                differs |= bool(said)
                sys.stdout.write(f"{name:28} {'; '.join(said) or f'the same bytes (exit code {codes[1]})'}\n")
                sys.stdout.flush()
        finally:
            subprocess.run(["git", "-C", ROOT, "worktree", "remove", "--force", before], check=True)
    return int(differs)


def _run(tree: Path, name: str, out: Path) -> int:
    """Run a study with the code of a tree."""
    settings = [word for setting in SHORTER.get(name, ()) for word in ("--set", setting)]
    command = [sys.executable, "-m", "workflows", "run", f"configs/{name}.toml", "--out", out / name, "--quiet"]
    done = subprocess.run(
        [*command, *settings],
        cwd=tree,
        env=os.environ | {"PYTHONPATH": str(tree)},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode not in {0, 3}:
        sys.stderr.write(f"{name} in {tree}: {done.stderr}")
    return done.returncode


def _compared(before: Path, here: Path) -> list[str]:
    """Say what differs between two results, group by group."""
    try:
        trees = [_groups(directory / "results.nc") for directory in (before, here)]
    except OSError as error:
        return [f"no results: {error}"]
    old, new = trees
    said = [f"group {name} only in one" for name in sorted(old.keys() ^ new.keys())]
    for name in old.keys() & new.keys():
        left, right = old[name], new[name]
        both = set(map(str, left.variables)) & set(map(str, right.variables))
        said += [
            f"{name}{one} only in one" for one in sorted({*map(str, left.variables), *map(str, right.variables)} - both)
        ]
        for variable in sorted(one for one in both if not any(word in one for word in MEASURED)):
            a, b = (np.asarray(found[variable].to_numpy()) for found in (left, right))
            if a.shape == b.shape and a.dtype == b.dtype and _same(a, b):
                continue
            if a.shape != b.shape or a.dtype.kind != "f" or b.dtype.kind != "f":
                said.append(f"{name}{variable} differs")
                continue
            largest = np.nanmax(np.abs(a - b)) / (np.nanmax(np.abs(a)) or 1.0)
            said.append(f"{name}{variable} by {largest:.1e}")
    return said


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.array_equal(a, b) if a.dtype.kind == "O" else a.tobytes() == b.tobytes())


def _groups(path: Path) -> dict[str, xr.Dataset]:
    """Return the groups of a file by name, of its root too."""
    import h5py

    found = ["/"]
    with h5py.File(path) as file:
        file.visititems(lambda name, item: found.append(f"/{name}/") if isinstance(item, h5py.Group) else None)
    return {name: xr.load_dataset(path, group=name.strip("/") or None, engine="h5netcdf") for name in found}


if __name__ == "__main__":
    sys.exit(main())
