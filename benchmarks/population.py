"""Coverage of populations: synthetic specimens of a known one, by draws of their own posteriors.

Each population has 8 specimens of two numbers, normal with standard deviations 0.3 and 0.2 and correlation 0.5, which
are measured with normal errors between 0.05 and 0.3 under a prior N(0, 1), and known by 100 draws each.
"""

from __future__ import annotations

import time

import numpy as np

from forward.model import FloatArray
from inverse.low_dimensional.population import Hyperprior, Specimen, fitted

COUNT, SPECIMENS, DRAWS, STEPS = 200, 8, 100, 300
TYPICAL, SPREAD = np.array([1.0, -0.5]), np.array([0.3, 0.2])
COVARIANCE = np.array([[0.09, 0.03], [0.03, 0.04]])
PRIOR = Hyperprior(np.zeros(2), np.ones(2))


def population(seed: int) -> tuple[list[Specimen], FloatArray]:
    """Return specimens, and the truths (n + 1, 2): those of the specimens, and of a new one."""
    rng = np.random.default_rng(seed)
    truth = rng.multivariate_normal(TYPICAL, COVARIANCE, SPECIMENS + 1)
    specimens = []
    for one in truth[:-1]:
        error = np.diag(rng.uniform(0.05, 0.3, 2) ** 2)
        measured = rng.multivariate_normal(one, error)
        posterior = np.linalg.inv(np.linalg.inv(error) + np.eye(2))
        z = rng.multivariate_normal(posterior @ np.linalg.solve(error, measured), posterior, DRAWS)
        specimens.append(Specimen(z, np.full(DRAWS, 1 / DRAWS), -(z**2).sum(axis=1) / 2, float(DRAWS)))
    return specimens, truth


def inside(draws: FloatArray, truth: FloatArray) -> FloatArray:
    """Whether 95 % intervals of draws (A, d) hold the truth (d,)."""
    lower, upper = np.quantile(draws, (0.025, 0.975), axis=0)
    return ((lower <= truth) & (truth <= upper)).astype(float)


def coverage(seeds: range, steps: int = STEPS, draws: int = 1000) -> dict[str, FloatArray]:
    """Return the shares (2,) of 95 % intervals that hold the truth, for each number."""
    held: dict[str, list[FloatArray]] = {"typical": [], "spread": [], "new specimen": [], "specimens": []}
    for seed in seeds:
        specimens, truth = population(seed)
        fit = fitted(specimens, PRIOR, draws, seed, steps)
        held["typical"].append(inside(fit.mean, TYPICAL))
        held["spread"].append(inside(fit.std, SPREAD))
        held["new specimen"].append(inside(fit.predictive(seed), truth[-1]))
        held["specimens"] += [inside(fit.estimates(i, seed)[0], truth[i]) for i in range(SPECIMENS)]
    return {name: np.mean(values, axis=0) for name, values in held.items()}


def main() -> None:
    """Print the coverage of 95 % intervals."""
    begin = time.process_time()
    for name, shares in coverage(range(COUNT)).items():
        print(f"{name:14} {' '.join(f'{100 * share:5.1f} %' for share in shares)}", flush=True)
    print(f"{COUNT} populations of {SPECIMENS} specimens, {time.process_time() - begin:.0f} s of CPU")
