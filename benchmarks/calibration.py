"""Simulation-based calibration of the inversion of a spherical inclusion: how uniform the ranks of the truth are.

Specimens are drawn from the prior, measured with noise, and inverted; the probability that the posterior gives to what
lies below the truth is uniform if the posterior is right (S. Talts et al., arXiv 1804.06788). The same model makes the
data and inverts them: what is tested is the inference, not the mesh.
"""

from __future__ import annotations

import time
from argparse import ArgumentParser
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI

from benchmarks import calibration_forces, calibration_palpation
from benchmarks.beams import CONFIG
from benchmarks.simulated import Kind, calibrate
from forward.fem.joined import SpecimenModel
from forward.model import ReferenceSolution
from forward.specimen import Specimen
from inverse.data.noise import Noise
from inverse.low_dimensional.posterior import Posterior
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.request import Prediction
from uq.inputs.distributions import Distribution, LogNormal, LogUniform, Uniform
from uq.inputs.random_parameters import Inputs

if TYPE_CHECKING:
    import xarray as xr

CELLS = 4
SPECIMENS = 200
SAMPLES = 64
FILE = Path("results/calibration.nc")
PICTURE = CONFIG.parent.parent / "docs" / "gallery" / "ranks.png"
BINS = 10
NOISE = 0.02  # of the root mean square of the displacements of each load case
PRIORS: dict[str, Distribution] = {
    "inclusions.tumour.x": Uniform(lower=0.3, upper=0.7),
    "inclusions.tumour.z": Uniform(lower=0.35, upper=0.75),
    "inclusions.tumour.radius": Uniform(lower=0.2, upper=0.4),
    "inclusions.tumour.contrast": LogUniform(lower=1.5, upper=8.0),
    "material.mu": LogNormal(mean=1e4, std=2e3),
}


def specimen(cells: int = CELLS) -> Specimen:
    """Return a unit cube with a ball inside, sheared and pulled, observed at points of four faces."""
    lines = np.linspace(0, 1, 4).tolist()
    faces = [((0.0, a, b), (1.0, a, b), (a, 1.0, b), (a, b, 1.0)) for a, b in product(lines, lines)]
    points = sorted({point for four in faces for point in four if point[2] > 0})
    cases = [
        {
            "name": name,
            "clamp": ("z-min",),
            "loads": ({"kind": "traction", "on": "z-max", "direction": direction, "size": 1500.0},),
        }
        for name, direction in (("shear", (1.0, 0.0, 0.0)), ("extension", (0.0, 0.0, 1.0)))
    ]
    ball = {"name": "tumour", "x": 0.5, "y": 0.5, "z": 0.55, "radius": 0.3, "contrast": 3.5, "width": 0.2}
    return Specimen.model_validate(
        {
            "body": {"size": (1.0, 1.0, 1.0), "cells": (cells, cells, cells), "degree": 1},
            "material": {"kind": "neo-hookean-coupled", "mu": 1e4, "lmbda": 4e4},
            "inclusions": (ball,),
            "cases": cases,
            "observed": ({"at": tuple(points)},),
            "solver": {"tolerance": 1e-6},
        }
    )


def problem(cells: int = CELLS, noise: float = NOISE) -> Posterior:
    """Return the posterior of the specimen at the medians of the prior."""
    inputs = Inputs(PRIORS)
    model: SpecimenModel = specimen(cells).build(MPI.COMM_SELF, inputs.names)
    centre = inputs.from_normals(np.zeros((1, len(inputs.names))))[0][0]
    solution = model.solve(centre)
    state, slopes = map(model.space.gather, (solution.state[None], solution.state_tangent(np.eye(len(centre)))))
    assert state is not None
    assert slopes is not None
    sizes = [np.sqrt((part**2).mean()) for part in model.values(solution.outputs)]
    sigma = noise * np.array(sizes)[model.cases]
    start = Prediction(ReferenceSolution(centre, state[0], inputs.std), slopes, inputs.coordinates)
    return Posterior(inputs, SerialEvaluate(model), np.array(solution.outputs), Noise(sigma), start=start)


def main(words: Sequence[str] = ()) -> None:
    """Print how uniform the ranks are; with --forces or --palpation, which intervals hold the truth, from forces."""
    parser = ArgumentParser(prog="calibration")
    parser.add_argument("--forces", action="store_true", help="curves of force over depth, with data of another mesh")
    parser.add_argument(
        "--palpation", action="store_true", help="lumps felt below a surface, with data of another mesh"
    )
    parser.add_argument("--specimens", type=int, default=None, help=f"default: {SPECIMENS}, 100 of palpation")
    parser.add_argument(
        "--inverted", type=int, default=3, help="of palpation: how many are inverted as the shipped one"
    )
    options = parser.parse_args(words)
    if options.palpation:
        calibration_palpation.main(options.specimens or 100, options.inverted)
    elif options.forces:
        calibration_forces.main(options.specimens or SPECIMENS)
    else:
        inclusions(options.specimens or SPECIMENS)


def inclusions(specimens: int = SPECIMENS, samples: int = SAMPLES) -> None:
    """Print how uniform the ranks are, write and draw them."""
    begin = time.process_time()
    found = calibrate(problem(), specimens, samples=samples, starts=1)
    seconds = time.process_time() - begin
    FILE.parent.mkdir(parents=True, exist_ok=True)
    found.dataset(BINS).to_netcdf(FILE, engine="h5netcdf")
    draw(found.dataset(BINS))
    print("| parameter | posterior | uniform? p | 50 % interval holds | 90 % | histogram of the ranks (10 bins) |")
    print("|---|---|---|---|---|---|")
    kinds: tuple[Kind, Kind] = ("laplace", "corrected")
    for kind in kinds:
        p, half, most = found.probabilities(kind), found.coverage(kind, 0.5), found.coverage(kind, 0.9)
        for i, name in enumerate(found.names):
            counts = " ".join(map(str, found.counts(kind, BINS)[i]))
            print(f"| {name} | {kind} | {p[i]:.2g} | {100 * half[i]:.0f} % | {100 * most[i]:.0f} % | {counts} |")
    good = found.trusted
    print(
        f"\n{specimens} specimens, {len(found.failures)} without a posterior; all parameters together: "
        f"p = {found.probability('laplace'):.2g} by Laplace, {found.probability('corrected'):.2g} corrected. "
        f"Weights of {samples} solves are worth {np.median(found.ess):.0f} (median), "
        f"{100 * good.mean():.0f} % of them trusted. {seconds:.0f} s of CPU; {FILE} holds the ranks."
    )


def draw(calibration: xr.Dataset) -> None:
    """Draw histograms of the ranks, with the band that holds 95 % of the bars of uniform ones."""
    from matplotlib.figure import Figure
    from scipy.stats import binom

    count = calibration["count"]
    n, bins = int(count[0, 0].sum()), count.sizes["bin"]
    low, high = binom.interval(0.95, n, 1 / bins)
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    panels = figure.subplots(*count.shape[:2], sharex=True, sharey=True)
    for (i, j), axis in np.ndenumerate(panels):
        axis.axhspan(low, high, color="0.85")
        axis.axhline(n / bins, color="0.5", linewidth=0.8)
        axis.stairs(count[i, j], np.linspace(0, 1, bins + 1), fill=True, color=f"C{i}", alpha=0.7)
        axis.text(
            0.5,
            0.96,
            f"p = {float(calibration['probability'][i, j]):.2g}",
            transform=axis.transAxes,
            ha="center",
            va="top",
        )
        if i == 0:
            axis.set_title(str(calibration.parameter.values[j]).split(".")[-1])
        if j == 0:
            axis.set_ylabel(f"specimens, {calibration.posterior.values[i]}")
    figure.supxlabel("probability that the posterior gives to what lies below the truth", fontsize="medium")
    figure.savefig(PICTURE, dpi=110)
