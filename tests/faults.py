"""Plant faults in formulas, one after the other, and say which of them the unit tests see.

    python -m tests.faults             # all of them, in a copy of the tree
    python -m tests.faults units bias  # these

A fault is a text of a file that stands there once, and what is put in its place. One that no longer stands there, or
more than once, ends the program: the fault is to be written anew, since it shows nothing any more.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parent.parent
COPIED = ("forward", "uq", "inverse", "workflows", "tissuq", "tests", "configs", "docs", "pyproject.toml")
TESTS = ("-m", "pytest", "-m", "unit and not slow", "-q", "-x", "-p", "no:cacheprovider", "--no-header", "--tb=no")


class Fault(NamedTuple):
    """A fault in a file: the right text, and the wrong one."""

    file: str
    right: str
    wrong: str

    def planted(self, text: str) -> str:
        """Return the text of the file with the fault.

        Raises
        ------
        ValueError
            If the right text is not there once.
        """
        count = text.count(self.right)
        if count != 1:
            message = f"{self.file}: {self.right!r} stands there {count} times, expected once"
            raise ValueError(message)
        return text.replace(self.right, self.wrong)


FAULTS = {
    "field-adjoint": Fault(
        "forward/fem/solution.py",
        "gradients -= np.array([equations.field_products",
        "gradients += np.array([equations.field_products",
    ),
    "rows-mesh-error": Fault(
        "forward/combine.py",
        "else replace(found, outputs=times(self.S, found.outputs))",
        "else replace(found, outputs=-times(self.S, found.outputs))",
    ),
    "joined-adjoint": Fault(
        "forward/combine.py", "np.split(rows, ends, axis=-1),", "np.split(rows, ends, axis=-1)[::-1],"
    ),
    "friction-adjoint": Fault(
        "forward/fem/history.py",
        "carried -= np.array([equations.rubbed(row)",
        "carried += np.array([equations.rubbed(row)",
    ),
    "solver-tolerance": Fault(
        "forward/solvers/acceptance.py", "size <= tolerance * residual.scale", "size <= 10 * tolerance * residual.scale"
    ),
    "units": Fault("inverse/data/table.py", "PREFIXES[prefix] ** power", "PREFIXES[prefix]"),
    "noise-marginal": Fault(
        "inverse/fields/newton_cg.py", "+ self.count * np.log(square", "+ (self.count - 1) * np.log(square"
    ),
    "sobol-total": Fault("uq/estimators/indices.py", "(A - AB) ** 2 / 2]", "(A - AB) ** 2]"),
    "bias": Fault("uq/methods/multilevel_meshes.py", "/ (2.0**alpha - 1)", "/ 2.0**alpha"),
    "degrees-of-freedom": Fault(
        "uq/estimators/moments.py", 'int(dataset["scramble"].max())', 'int(dataset["scramble"].max()) + 1'
    ),
    "mesh-error-sign": Fault("uq/estimators/estimate.py", "value + mesh, left", "value - mesh, left"),
    "error-of-root": Fault("uq/estimators/moments.py", "upper = std / 2 * np.expm1", "upper = std * np.expm1"),
    "laplace-evidence": Fault("inverse/low_dimensional/laplace.py", "[1] / 2)", "[1])"),
    "variance-between": Fault("uq/estimators/averaged.py", "(p * away**2)", "(p**2 * away**2)"),
    "upper-quantile": Fault("uq/estimators/quantiles.py", "= p[:, None], 1 - p[:, None]", "= p[:, None], p[:, None]"),
    "predicted-quantile": Fault("uq/estimators/quantiles.py", "missing**2 / beyond", "missing**2 * beyond"),
    "small-total": Fault("uq/estimators/tails.py", "np.expm1(relative)", "np.sinh(relative)"),
    "budget": Fault("uq/methods/method.py", "(self.budget_seconds / seconds - 1)", "(self.budget_seconds / seconds)"),
    "digits": Fault("forward/readable.py", "1 if error < TWO * 10.0**power", "1 if error > TWO * 10.0**power"),
    "chains": Fault("uq/inputs/draws.py", "2 * pairs.sum() - 1", "2 * pairs.sum()"),
}


def run(copy: Path, name: str, fault: Fault, number: int) -> tuple[bool, float, str]:
    """Return whether the tests of a copy see a fault, how long they took (s), and the first that did."""
    path = copy / fault.file
    right = path.read_text(encoding="utf-8")
    path.write_text(fault.planted(right), encoding="utf-8")
    os.utime(path, (number, number))  # compiled modules are found by the time of their source
    began = time.perf_counter()
    done = unit_tests(copy)
    path.write_text(right, encoding="utf-8")
    os.utime(path, (0, 0))
    failed = next((line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))), "")
    if done.returncode not in (0, 1, 2):
        raise RuntimeError(f"{name}: the tests could not be run:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return done.returncode != 0, time.perf_counter() - began, failed


def unit_tests(copy: Path) -> subprocess.CompletedProcess[str]:
    """Run the unit tests of a copy until one fails."""
    compiled = {"PYTHONPYCACHEPREFIX": str(copy / "compiled"), "PYTHONDONTWRITEBYTECODE": "", "PYTHONPATH": str(copy)}
    command = [sys.executable, *TESTS]
    return subprocess.run(command, cwd=copy, env=os.environ | compiled, capture_output=True, text=True, check=False)


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main(words: Sequence[str] | None = None) -> int:
    """Plant the faults; 0 if the unit tests see all of them, otherwise 1."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="FAULT", help=f"of {', '.join(FAULTS)}; by default all")
    names = parser.parse_args(words).names or list(FAULTS)
    unknown = [name for name in names if name not in FAULTS]
    if unknown:
        parser.error(f"no fault '{unknown[0]}', expected one of {', '.join(FAULTS)}")
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for part in COPIED:
            if (ROOT / part).is_dir():
                shutil.copytree(ROOT / part, copy / part, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(ROOT / part, copy / part)
        began = time.perf_counter()
        done = unit_tests(copy)
        if done.returncode:
            sys.stderr.write(f"without a fault the unit tests fail already:\n{done.stdout}{done.stderr}")
            return 1
        _say(f"{'none planted':20} passed  {time.perf_counter() - began:5.1f} s")
        seen = 0
        for number, name in enumerate(names, 1):
            caught, seconds, by = run(copy, name, FAULTS[name], number)
            seen += caught
            _say(f"{name:20} {'seen' if caught else 'MISSED':7} {seconds:5.1f} s  {by[:90]}")
    _say(f"{seen} of {len(names)} faults are seen")
    return 0 if seen == len(names) else 1


if __name__ == "__main__":
    sys.exit(main())
