"""Coverage of what inversions predict: 200 synthetic specimens, from data to intervals that were not measured.

Each specimen is of Demiray's material, its constants a draw of the prior, and is stretched to at most 1.3 with errors
of 5 %; predicted are its stresses at stretches of 1.2 and 1.5, and in shear. All go through one study, `tissuq run`.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np
import xarray as xr

from workflows.__main__ import main as run
from workflows.config.study import load

COUNT = 200
OUTPUTS = [f"p{i}" for i in range(6)]
MODULE = """
import numpy as np

STRETCH = np.array([1.05, 1.1, 1.15, 1.2, 1.25, 1.3])
FARTHER = np.array([1.2, 1.5])


def uniaxial(p, stretch):
    mu, b = p
    more = stretch**2 + 2 / stretch - 3
    stress = mu * np.exp(b * more) * (stretch - stretch**-2)
    return stress, np.column_stack([stress / mu, stress * more])


def sheared(p, shear):
    mu, b = p
    stress = mu * shear * np.exp(b * shear**2)
    return stress, np.array([stress / mu, stress * shear**2])


def measured(p):
    return uniaxial(p, STRETCH)[0]


def slopes(p):
    return uniaxial(p, STRETCH)[1]


def predicted(p):
    return np.append(uniaxial(p, FARTHER)[0], sheared(p, 0.4)[0])


def predicted_slopes(p):
    return np.vstack([uniaxial(p, FARTHER)[1], sheared(p, 0.4)[1]])
"""
GOALS = ("stretched to 1.2", "stretched to 1.5", "sheared by 0.4")
STUDY = f"""
[model]
kind = "python"
function = "demiray.measured"
jacobian = "demiray.slopes"
parameters = {{ mu = 1000.0, b = 1.0 }}
outputs = {OUTPUTS}

[parameters]
mu = {{ kind = "log-normal", mean = 1000, std = 500 }}
b = {{ kind = "log-normal", mean = 2, std = 1.5 }}

[data]
files = ["data"]

[predict]
model = {{ function = "demiray.predicted", jacobian = "demiray.predicted_slopes", outputs = {list(GOALS)} }}
samples = 12

[method]
kind = "invert"
samples = 128
starts = 1
"""


def coverage(folder: Path, count: int = COUNT, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the shares (k,) of 95 % intervals that hold the truth: after the data, and before them."""
    (folder / "demiray.py").write_text(MODULE)
    (folder / "study.toml").write_text(STUDY)
    (folder / "data").mkdir()
    (folder / "data" / "none.csv").write_text("output,value,sigma\np0,1,1\n")
    model: dict = {}
    exec(MODULE, model)
    rng = np.random.default_rng(seed)
    points = load(folder / "study.toml").inputs.random(seed, 0, count)
    (folder / "data" / "none.csv").unlink()
    for k, point in enumerate(points):
        clean = model["measured"](point)
        sigma = 0.05 * clean
        rows = [
            f"p{i},{y!r},{s!r}"
            for i, (y, s) in enumerate(
                zip((clean + sigma * rng.standard_normal(clean.size)).tolist(), sigma.tolist(), strict=True)
            )
        ]
        (folder / "data" / f"{k:03}.csv").write_text("\n".join(["output,value,sigma", *rows]) + "\n")
    run(["run", str(folder / "study.toml"), "--out", str(folder / "out"), "--quiet", "--no-report"])
    found = xr.load_dataset(folder / "out" / "results.nc", engine="h5netcdf")
    truth = np.array([model["predicted"](point) for point in points])
    ends = [[found[f"prediction_{of}{end}"].to_numpy() for end in ("lower", "upper")] for of in ("", "prior_")]
    after, before = (((lower <= truth) & (truth <= upper)).mean(axis=0) for lower, upper in ends)
    widths = [float(np.median(upper - lower)) for lower, upper in ends]
    print(f"median width of intervals, all outputs: {widths[0]:.3g} Pa after, {widths[1]:.3g} Pa before the data")
    return after, before


def main() -> None:
    """Print the coverage of 95 % intervals."""
    begin = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        after, before = coverage(Path(folder))
    for goal, shares in zip(GOALS, zip(after, before, strict=True), strict=True):
        print(f"{goal:18} {100 * shares[0]:5.1f} % after the data, {100 * shares[1]:5.1f} % before", flush=True)
    print(f"{COUNT} specimens, {time.process_time() - begin:.0f} s of CPU")
