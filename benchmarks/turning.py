"""Large bodies in reports: size of the file, and time of script for a frame (python -m benchmarks turning).

A body with sliders, made of hexahedra, moved by an expansion in six parameters. Frames are timed in a headless
Chromium, the whole of `update` and `paint` of viewer.js as a slider moves: expansion, places, normals, buffers. What
the graphics processor does is not in it. Needs Chromium.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from forward.model import FloatArray
from tests.browser import Page, browser, executable
from uq.inputs.distributions import Uniform
from uq.inputs.random_parameters import Inputs
from uq.surrogates.basis import hyperbolic, orthonormal
from workflows.report.blocks import Heading
from workflows.report.page import render
from workflows.report.scene.scene import Quantity, Scene
from workflows.report.scene.sliders import sliders
from workflows.report.sections.bodies import turning

PARAMETERS, ORDER, SHAPES = 6, 3, 24
FRAMES = 30
TIMED = """(() => {{ const v = document.querySelector('.viewer').viewer, x = v.expansion;
  for (let k = 0; k < {frames}; k++) {{
    x.fixed.fill(true); x.values = x.parameters.map((p, i) => p.low + (p.high - p.low) * (0.5 + 0.4 * Math.sin(k + i)));
    x.regroup(); x.outputs(); v.update(); v.paint(); }} }})()"""


def main(words: Sequence[str] = ()) -> None:
    """Print a line for each number of surface triangles."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks turning")
    parser.add_argument("--triangles", type=float, nargs="+", default=[1e4, 1e5])
    asked = parser.parse_args(words)
    if executable() is None:
        sys.stdout.write("needs Chromium\n")
        return
    sys.stdout.write(
        "triangles   file (MB)   modes   script a frame (ms of processor time)   rounding / largest displacement\n"
    )
    with tempfile.TemporaryDirectory() as folder, browser() as page:
        for count in asked.triangles:
            n = max(2, round((count / 12) ** 0.5))
            path = Path(folder) / f"{n}.html"
            largest = write(path, n)
            page.open(path, 1280)
            page.run(TIMED.format(frames=3))
            before = script(page)
            page.run(TIMED.format(frames=FRAMES))
            milliseconds = 1e3 * (script(page) - before) / FRAMES
            modes = page.run("document.querySelector('.viewer').viewer.expansion.field.factors[0].length")
            rounding = page.run("document.querySelector('.viewer').viewer.expansion.field.rounding") / largest
            assert not page.errors, page.errors
            size = path.stat().st_size / 1e6
            sys.stdout.write(f"{12 * n**2:9d} {size:11.2f} {modes:7d} {milliseconds:24.1f} {rounding:35.1e}\n")
            sys.stdout.flush()


def script(page: Page) -> float:
    """Return the processor time (s) of the processes that run scripts: other work on the machine is not in it."""
    session, page.session = page.session, ""
    found = page.call("SystemInfo.getProcessInfo")["processInfo"]
    page.session = session
    return float(sum(one["cpuTime"] for one in found if one["type"] == "renderer"))


def write(path: Path, n: int) -> float:
    """Write a report of a bent block whose surface has n² squares on each side; return its largest displacement."""
    points, cells = shell(n)
    inputs = Inputs({f"material.c{i}": Uniform(lower=0.0, upper=1.0) for i in range(PARAMETERS)})
    basis = orthonormal(inputs, hyperbolic(PARAMETERS, ORDER, 0.75))
    rng = np.random.default_rng(0)
    # Smooth shapes, of which each is seen less than those before, as in the singular values of bodies.
    shapes = np.stack([np.sin(points @ wave) for wave in rng.normal(size=(SHAPES, 3, 3)) * 2.0])
    amounts = rng.normal(size=(len(basis.indices), SHAPES)) * 0.2 * 0.45 ** np.arange(SHAPES)
    amounts /= 1.0 + 3.0 * np.arange(len(basis.indices))[:, None]
    fields = np.tensordot(amounts, shapes, axes=1)
    told = sliders(expanded(inputs, basis, fields), SimpleNamespace(given=inputs.marginals, units_of=lambda _: {}))
    size = np.linalg.norm(fields[0], axis=1)
    quantities = [Quantity("Mean displacement", size, "m"), Quantity("Deviation", 0.1 * size, "m", std=True)]
    scene = Scene(points, cells, 12, np.eye(3)[2], fields[0], quantities, sliders=told)
    path.write_text(render("Large", [("body", [Heading("Large", 1), turning(scene, "a block")])]), encoding="utf-8")
    return float(size.max())


def shell(n: int) -> tuple[FloatArray, np.ndarray]:
    """Return nodes and hexahedra of a block that are at its surface: what is inside does not travel."""
    x = np.linspace(0.0, 1.0, n + 1)
    i, j, k = (one.ravel() for one in np.meshgrid(*[np.arange(n)] * 3, indexing="ij"))
    outer = (np.minimum(np.minimum(i, j), k) == 0) | (np.maximum(np.maximum(i, j), k) == n - 1)
    i, j, k = i[outer], j[outer], k[outer]
    m = n + 1
    corner = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
    numbers = np.stack([((i + a) * m + (j + b)) * m + (k + c) for a, b, c in corner], axis=1)
    used, cells = np.unique(numbers, return_inverse=True)
    at = np.stack([used // m**2, used // m % m, used % m], axis=1)
    return x[at], cells.reshape(-1, 8)


def expanded(inputs, basis, fields):  # type: ignore[no-untyped-def]
    """Return results that hold the expansion."""
    import xarray as xr

    coordinates, terms = basis.coordinates, len(basis.indices)
    outputs = 1.0 / (1.0 + np.arange(terms))[:, None]
    return xr.Dataset(
        {
            "multi_index": (("term", "parameter"), basis.indices),
            "coefficients": (("term", "output"), outputs),
            "coordinate_logarithmic": ("parameter", coordinates.logarithmic.astype(int)),
            "coordinate_mean": ("parameter", coordinates.centre),
            "coordinate_std": ("parameter", coordinates.scale),
            "recurrence_alpha": (("parameter", "degree"), basis.alpha),
            "recurrence_beta": (("parameter", "degree"), basis.beta),
            "range_lower": ("parameter", np.zeros(PARAMETERS)),
            "range_upper": ("parameter", np.ones(PARAMETERS)),
            "field_coefficients": (("term", "node", "component"), fields),
            "loo_error": ("output", [1e-3]),
            "std": ("output", [1.0]),
            "unit": ("output", ["m"]),
        },
        {"parameter": list(inputs.names), "output": ["y"]},
    )


if __name__ == "__main__":
    main(sys.argv[1:])
