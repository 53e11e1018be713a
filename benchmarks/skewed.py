"""Skewed parameters: the borehole function by every method, against its moments, over eight seeds."""

from __future__ import annotations

import numpy as np

from forward.model import FloatArray
from forward.pointwise import FunctionModel
from uq.estimators.moments import half_width
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import LogNormal, Normal, Uniform
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.methods.chaos import Chaos
from uq.methods.monte_carlo import SensitivityMonteCarlo
from uq.methods.quasi_monte_carlo import QuasiMonteCarlo

SEEDS = range(8)
KNOWN = 2**20  # points of each of eight scrambles that the moments are known from
INPUTS = Inputs(
    {
        "rw": Normal(mean=0.1, std=0.0161812),
        "r": LogNormal(mean=3698.3, std=4891.5),
        "Tu": Uniform(lower=63070.0, upper=115600.0),
        "Hu": Uniform(lower=990.0, upper=1110.0),
        "Tl": Uniform(lower=63.1, upper=116.0),
        "Hl": Uniform(lower=700.0, upper=820.0),
        "L": Uniform(lower=1120.0, upper=1680.0),
        "Kw": Uniform(lower=9855.0, upper=12045.0),
    }
)


def borehole(p: FloatArray) -> FloatArray:
    """Return the flow through a borehole (W. V. Harper, S. K. Gupta, BMI/ONWI-516 (1983)) for p (8, …)."""
    rw, r, Tu, Hu, Tl, Hl, L, Kw = p
    ratio = np.log(r / rw)
    flow = 2 * np.pi * Tu * (Hu - Hl) / (ratio * (1 + 2 * L * Tu / (ratio * rw**2 * Kw) + Tu / Tl))
    return np.asarray(flow)


def slopes(p: FloatArray) -> FloatArray:
    """Return its derivatives (1, 8), by complex steps."""
    return np.array([[borehole(p + 1e-20j * e).imag / 1e-20 for e in np.eye(8)]])


def main() -> None:
    """Print errors of mean and standard deviation, what was claimed, and how many 95 % intervals hold the truth."""
    model = FunctionModel(borehole, INPUTS.names, ("flow",), slopes)
    parts = [borehole(INPUTS.points(sobol_points(1, r, 0, KNOWN, 8)).T) for r in SEEDS]
    exact = {"mean": np.mean(parts), "std": np.std(parts)}
    print(f"mean {exact['mean']:.5g}, standard deviation {exact['std']:.5g} (m³/yr)\n")
    print("| method | samples | mean: error | intervals | standard deviation: error | largest | claimed | intervals |")
    print("|" + "---|" * 8)
    for samples in (64, 256):
        controls = ("none", "tangent", "quadratic", "chaos")
        methods = {
            "chaos": [Chaos(samples=samples, seed=s) for s in SEEDS],
            "chaos, values only": [Chaos(samples=samples, seed=s, gradients=False) for s in SEEDS],
            **{
                f"quasi-monte-carlo, {c}": [QuasiMonteCarlo(samples=samples, control=c, seed=s) for s in SEEDS]
                for c in controls
            },
            "sensitivity-monte-carlo": [SensitivityMonteCarlo(samples=samples, seed=s) for s in SEEDS],
        }
        for name, runs in methods.items():
            cells = [name, str(samples)]
            data = [run.run(INPUTS, SerialEvaluate(model)) for run in runs]
            for moment, value in exact.items():
                errors = np.array([d[moment].item() - value for d in data])
                claims = np.array([d[f"{moment}_error"].item() for d in data])
                holds = sum(np.abs(errors) <= [half_width(d) for d in data] * claims)
                relative = errors / exact["std"]
                cells.append(f"{np.sqrt((relative**2).mean()):.1e}")
                if moment == "std":
                    cells += [f"{np.abs(relative).max():.1e}", f"{np.median(claims) / exact['std']:.1e}"]
                cells.append(f"{holds} of {len(runs)}")
            print("| " + " | ".join(cells) + " |", flush=True)
