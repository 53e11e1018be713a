"""Errors of posteriors of many unknowns, exactly Gaussian and bent a little.

d unknowns are seen through u + c u², u = A x, by 2 d data with known errors. What is true follows by NumPy from plain
importance sampling about the mode; for c = 0 it is the closed form.

Then a curved one of 64 unknowns by chains that follow gradients (`tests.problems.bananas`), whose mean, widths and ln Z
are known in closed form, as a map with the Jacobian one makes it normal.

Ten seeds each, with what a study takes by default.
"""

from __future__ import annotations

import time

import numpy as np

from forward.model import FloatArray
from forward.pointwise import FunctionModel
from inverse.criticism.assessment import Assessment, answer, assess
from inverse.criticism.verdict import verdict_on_few
from inverse.data.noise import Noise
from inverse.low_dimensional.evidence import evidence
from inverse.low_dimensional.laplace import Laplace, laplace
from inverse.low_dimensional.posterior import Posterior
from inverse.methods.invert import Invert
from tests.problems import examine_few
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import Normal
from uq.inputs.random_parameters import Inputs

SIZES, CURVATURES, SEEDS = (10, 20, 30, 50, 100), (0.0, 0.25), 10
PAIRS = 32
NOISE = 0.25
DRAWS, AT_ONCE = 60_000, 20_000


def problem(size: int, curvature: float, seed: int) -> tuple[Posterior, FloatArray]:
    """Return a posterior, and A (2 d, d)."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(2 * size, size)) / np.sqrt(size) * np.exp(-2.5 * np.arange(size) / size)
    u = A @ rng.normal(size=size)
    data = u + curvature * u**2 + NOISE * rng.normal(size=2 * size)
    names, outputs = tuple(f"x{k}" for k in range(size)), tuple(f"y{k}" for k in range(2 * size))

    def values(x: FloatArray) -> FloatArray:
        return np.asarray(A @ x + curvature * (A @ x) ** 2)

    def slopes(x: FloatArray) -> FloatArray:
        return np.asarray(A * (1 + 2 * curvature * (A @ x))[:, None])

    model = FunctionModel(values, names, outputs, slopes)
    inputs = Inputs({name: Normal(mean=0.0, std=1.0) for name in names})
    return Posterior(inputs, SerialEvaluate(model), data, Noise(np.full(2 * size, NOISE))), A


def truth(posterior: Posterior, A: FloatArray, curvature: float, gaussian: Laplace) -> tuple[FloatArray, ...]:
    """Mean and standard deviation (d,), and ln Z."""
    size, rng, logs, points = A.shape[1], np.random.default_rng(1), [], []
    if curvature == 0:
        scatter = NOISE**2 * np.eye(2 * size) + A @ A.T
        y, H = posterior.data, np.eye(size) + A.T @ A / NOISE**2
        exact = -(y @ np.linalg.solve(scatter, y) + np.linalg.slogdet(2 * np.pi * scatter)[1]) / 2
        return np.linalg.solve(H, A.T @ y) / NOISE**2, np.sqrt(np.diag(np.linalg.inv(H))), exact
    for _ in range(DRAWS // AT_ONCE):
        z = rng.normal(size=(AT_ONCE, size))
        points.append(gaussian.mode + z @ gaussian.root.T)
        u = points[-1] @ A.T
        r = (u + curvature * u**2 - posterior.data) / NOISE
        logs.append(((z**2).sum(axis=1) - (r**2).sum(axis=1) - (points[-1] ** 2).sum(axis=1)) / 2)
    log, x = np.concatenate(logs), np.concatenate(points)
    w = np.exp(log - log.max())
    mean = w @ x / w.sum()
    constant = np.linalg.slogdet(gaussian.root)[1] - 2 * size * np.log(NOISE * np.sqrt(2 * np.pi))
    return mean, np.sqrt(w @ (x - mean) ** 2 / w.sum()), log.max() + np.log(w.mean()) + constant


def main() -> None:
    """Print the largest errors of means, widths and ln Z, and those of a curved posterior."""
    print("| unknowns | c | mean off by (sd) | width off by | ln Z off by | of its errors | refused |")
    print("|---|---|---|---|---|---|---|")
    for curvature in CURVATURES:
        for size in SIZES:
            means, widths, gaps, ratios, refused = [], [], [], [], 0
            for seed in range(SEEDS):
                posterior, A = problem(size, curvature, seed)
                gaussian = laplace(posterior)
                found = evidence(posterior, gaussian, Invert().solves(size, field=False))
                known = answer(posterior, Assessment(gaussian, found))
                mean, std, log_evidence = truth(posterior, A, curvature, gaussian)
                refused += verdict_on_few(gaussian, found, examine_few(posterior, gaussian)).trust == "neither"
                means.append(float(np.abs((known.mean - mean) / std).max()))
                widths.append(float(np.abs(known.std / std - 1).max()))
                gaps.append(abs(found.log_evidence - float(log_evidence)))
                ratios.append(gaps[-1] / found.error)
            within = f"{sum(ratio < 3 for ratio in ratios)} of {SEEDS} within 3" if curvature else "exact"
            errors = f"{max(means):.2g} | {100 * max(widths):.2g} % | {max(gaps):.2g}"
            print(f"| {size} | {curvature:g} | {errors} | {within} | {refused} of {SEEDS} |", flush=True)
    curved()


def curved() -> None:
    """Print errors, and what the chains took, of curved posteriors of 64 unknowns."""
    from tests.problems import bananas

    heads = ("seed", "Laplace's mode off by (sd)", f"worth of {16 * PAIRS} points", "mean off by (sd)", "rms", "widths")
    heads += ("ln Z off by", "its error", "gradients", "effective draws", "R̂", "printed", "s of CPU")
    print(f"\n| {' | '.join(heads)} |\n|{'---|' * len(heads)}")
    for seed in range(SEEDS):
        model, posterior, mean, std, log_evidence = bananas(PAIRS, seed=seed)
        begin = time.process_time()
        gaussian = laplace(posterior)
        one = assess(posterior, gaussian, 8 * len(std), chains="hmc", model=model, seed=seed)
        known = answer(posterior, one)
        seconds, chains = time.process_time() - begin, one.chains
        assert chains is not None
        gaps, ratios = (known.mean - mean) / std, known.std / std
        mode = np.abs((posterior.physical(gaussian.mode[None])[0] - mean) / std).max()
        errors = f"{np.abs(gaps).max():.2g} | {np.sqrt((gaps**2).mean()):.2g} | {ratios.min():.2f}–{ratios.max():.2f}"
        of_evidence = f"{one.log_evidence[0] - log_evidence:+.2f} | {one.log_evidence[1]:.2f}"
        of_chains = f"{chains.apart:,} | {chains.ess:.0f} | {chains.rhat.max():.3f} | {one.source} | {seconds:.0f}"
        print(f"| {seed} | {mode:.2f} | {one.evidence.ess:.0f} | {errors} | {of_evidence} | {of_chains} |", flush=True)


if __name__ == "__main__":
    main()
