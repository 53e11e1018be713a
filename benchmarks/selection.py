"""Are the probabilities of models worth what they say, and is it found when no candidate is right.

Data of each of five materials, with constants drawn from its prior and 20 draws of the noise, are given to all five.
Events that are said to have probability P should happen in a share P of the cases, and the residuals of the most
probable model should be in conflict with the data as rarely as the test says (1 in 100). Data of Ogden's rubber, which
is none of the five, are given to them too: there residuals should be in conflict.
"""

from __future__ import annotations

import time
from itertools import pairwise

import numpy as np

from benchmarks.beams import CONFIG
from forward.materials.material_point import HomogeneousModel, MaterialTest
from forward.model import FloatArray
from inverse.criticism.comparison import Candidate
from inverse.data.measurements import Measurements
from inverse.methods.selection import Select, StatedNoise
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import Distribution, LogNormal, LogUniform, Normal, Uniform
from uq.inputs.random_parameters import Inputs
from workflows.results.comparison import conflicts, ranking

STRETCHES = (1.2, 1.5, 1.9, 2.4, 2.9, 3.3)
TESTS = [MaterialTest(mode=mode, at=STRETCHES) for mode in ("uniaxial", "equibiaxial", "pure-shear")]
NOISE = 0.15
DRAWS = 20
PRIORS: dict[str, dict[str, Distribution]] = {
    "neo-hookean": {"C1": LogNormal(mean=2e5, std=1e5)},
    "mooney-rivlin": {"C1": LogNormal(mean=2e5, std=1e5), "C2": Uniform(lower=0.0, upper=5e4)},
    "yeoh": {
        "C10": LogNormal(mean=2e5, std=1e5),
        "C20": Normal(mean=0.0, std=5e3),
        "C30": LogUniform(lower=1.0, upper=1e3),
    },
    "gent": {"mu": LogNormal(mean=4e5, std=2e5), "Jm": LogUniform(lower=30.0, upper=300.0)},
    "demiray": {"a": LogNormal(mean=4e5, std=2e5), "b": LogUniform(lower=0.002, upper=0.05)},
}
OGDEN = {"mu1": 6.3e5, "alpha1": 1.3, "mu2": 1.2e3, "alpha2": 5.0, "mu3": -1e4, "alpha3": -2.0}
SMALLER = (0.15, 0.05, 0.02)  # errors of these data, of the stress
PICTURE = CONFIG.parent.parent / "docs" / "gallery" / "reliability.png"
BINS = (0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 0.95, 1.0)


def main() -> None:
    """Print and draw how reliable probabilities are, and print how often the discrepancy test fires."""
    begin = time.process_time()
    rng = np.random.default_rng(7)
    names = list(PRIORS)
    models = {name: HomogeneousModel(name, {}, TESTS, tuple(PRIORS[name])) for name in names}
    candidates = {name: Candidate(Inputs(PRIORS[name])) for name in names}
    labels = tuple(test.label for test in TESTS for _ in test.at)
    at = np.concatenate([test.at for test in TESTS])
    # The standard deviations stand with the data: they are those that made them, not a part of what was measured.
    method = Select(samples=64, noise=StatedNoise())

    def compared(stress: FloatArray, noise: float) -> tuple[FloatArray, bool]:
        """Probabilities given stresses with errors, and whether the most probable model is in conflict with them."""
        sigma = np.maximum(noise * np.abs(stress), 5e3 * noise / NOISE)
        data = Measurements.of_tests(stress + sigma * rng.standard_normal(stress.size), sigma, labels, at)
        found = method.run(candidates, {"all": data}, lambda name, _: SerialEvaluate(models[name]))
        best = ranking(found["log_evidence"])[0]
        return found["probability"].to_numpy(), bool(conflicts(found, best))

    said, happened, alarms = [], [], []
    for k, truth in enumerate(names):
        for _ in range(DRAWS):
            point = candidates[truth].inputs.from_normals(rng.standard_normal((1, len(PRIORS[truth]))))[0]
            P, alarm = compared(models[truth].stresses(point)[0], NOISE)
            said.append(P)
            happened.append(np.arange(len(names)) == k)
            alarms.append(alarm)
    P, true = np.concatenate(said), np.concatenate(happened)
    bars = []
    print(f"{DRAWS} draws from each of five models, {len(labels)} stresses with errors of {100 * NOISE:.0f} %\n")
    print("| stated probability | cases | its mean | observed frequency | ± |")
    print("|---|---|---|---|---|")
    for low, high in pairwise(BINS):
        members = (low <= P) & ((high > P) | (high == 1.0))
        n = int(members.sum())
        if n:
            spread = np.sqrt((P[members] * (1 - P[members])).sum()) / n
            bars.append((P[members].mean(), true[members].mean(), spread))
            print(f"| {low:g} to {high:g} | {n} | {bars[-1][0]:.3f} | {bars[-1][1]:.3f} | {spread:.3f} |")
    draw(np.array(bars))
    score = -np.log(P[true])
    logs = np.log(np.maximum(np.array(said), 1e-300))
    entropy = -(np.array(said) * logs).sum(axis=1)
    spread = (np.array(said) * logs**2).sum(axis=1) - entropy**2
    error = np.sqrt(spread.sum()) / len(said)
    print(f"\n−ln P(truth): {score.mean():.3f} on average, said to be {entropy.mean():.3f} ± {error:.3f}")
    print(f"in conflict although the truth is a candidate: {sum(alarms)} of {len(alarms)}\n")
    print("| Ogden's rubber with errors of | in conflict |")
    print("|---|---|")
    other = HomogeneousModel("ogden", OGDEN, TESTS, ()).stresses(np.zeros((1, 0)))[0]
    for noise in SMALLER:
        found = sum(compared(other, noise)[1] for _ in range(DRAWS))
        print(f"| {100 * noise:.0f} % | {found} of {DRAWS} |")
    print(f"\n{time.process_time() - begin:.0f} s")


def draw(bars: FloatArray) -> None:
    """Draw what happened against what was said: rows of mean probability, share and its standard error."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.4, 4.2), layout="constrained")
    axis = figure.subplots()
    axis.plot([0, 1], [0, 1], color="0.6", linewidth=0.8, label="as said")
    axis.errorbar(*bars.T[:2], yerr=2 * bars[:, 2], fmt="o", capsize=3, label="found, ± 2 standard errors")
    axis.set(
        xlabel="stated probability", ylabel="observed frequency", xlim=(-0.02, 1.02), ylim=(-0.02, 1.02), aspect="equal"
    )
    axis.legend(loc="lower right")
    figure.savefig(PICTURE, dpi=110)
