"""Where the time of an indentation study goes: a ball pressed against an organ, phase by phase."""

from __future__ import annotations

import pkgutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

STUDY = """
[model]
kind = "hyperelastic"
body = {{ kind = "mesh", file = "{mesh}", unit = 1e-3, degree = 2 }}
material = {{ kind = "mooney-rivlin", C1 = 2.5e3, C2 = 1.5e3, D1 = 8e4 }}
regions = {{ tumour = {{ contrast = 4 }} }}
clamp = ["vessel"]
outputs = [{{ name = "force", kind = "force" }}]

[[model.loads]]
kind = "indenter"
shape = "sphere"
radius = 0.03
on = "tool"
at = [0.04, 0, 0.042]
direction = [0, 0, -1]
depth = 4e-3

[parameters]
"material.C1" = {{ kind = "truncated-normal", mean = 2.5e3, std = 250, lower = 1.5e3, upper = 3.5e3 }}
"regions.tumour.contrast" = {{ kind = "uniform", lower = 3, upper = 5 }}
{more}
[method]
kind = "chaos"
samples = {samples}
seed = 1

[accuracy]
mesh_error = false
"""
DEPTH = '"loads.indenter.depth" = { kind = "uniform", lower = 3.8e-3, upper = 4.2e-3 }\n'
JUDGED = ("equilibrium", "newton", "corrections")  # modules that ask whether a state is stable


@contextmanager
def timed(where: str, name: str) -> Iterator[list[float]]:
    """Note the processor time (s) of every call of a function, named as `patch` names it."""
    owner = pkgutil.resolve_name(where)
    original, spent = getattr(owner, name), list[float]()

    def call(*arguments: Any, **more: Any) -> Any:
        start = time.process_time()
        try:
            return original(*arguments, **more)
        finally:
            spent.append(time.process_time() - start)

    with patch.object(owner, name, call):
        yield spent


def study(samples: int, more: str) -> None:
    """Run a study in this process, and print what its phases took."""
    from workflows.__main__ import main

    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        path = Path(folder) / "study.toml"
        path.write_text(STUDY.format(mesh=Path("configs/meshes/organ.msh").resolve(), samples=samples, more=more))

        def note(where: str, name: str) -> list[float]:
            return stack.enter_context(timed(where, name))

        built = note("forward.fem.model:HyperelasticModel", "__init__")
        solved = note("forward.fem.model:HyperelasticModel", "solve")
        judged = [note(f"forward.solvers.{module}", "accepted") for module in JUDGED]
        reported = note("workflows.report.page", "write_report")
        start = time.process_time()
        code = main(["run", str(path), "--out", str(Path(folder) / "out"), "--quiet"])
        whole = time.process_time() - start
    of_judging = sum(map(sum, judged))
    others = np.array(solved[1:])
    rest = whole - sum(built) - sum(solved) - sum(reported)
    sys.stdout.write(
        f"exit code {code}; whole {whole:.1f}: mesh, forms and model {sum(built):.1f}; first solve {solved[0]:.1f}; "
        f"{len(others)} other solves {others.sum():.1f}, median {np.median(others):.2f}, largest {others.max():.1f}; "
        f"stability, in these {of_judging:.1f}; report {sum(reported):.1f}; the rest (imports, expansion) {rest:.1f}\n"
    )
    sys.stdout.flush()


def phases(samples: int = 20) -> None:
    """Print the phases of two studies."""
    sys.stdout.write("A ball on the organ (19,782 unknowns), CPU time (s), forms compiled before\n")
    for what, more in (("constants are random", ""), ("and the depth", DEPTH)):
        sys.stdout.write(f"{what}: ")
        study(samples, more)
