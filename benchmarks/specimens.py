"""Whether a comparison says that specimens are of two materials, and only then.

Each specimen has constants of its own, drawn from the priors of the candidates, and is tested in tension, shear and in
two directions, with errors of a share of the stress. Evidences are means of the likelihood over the same many points of
the priors: with these errors that is exact enough, and much faster than what `select` does for data of any kind. The
table says of sets of forty specimens, of one material and of two, in how many it is said that they disagree, how large
ln of the Bayes factor for two materials is, and in how many a probability above 99 % stands there all the same. In the
last rows all specimens of a set have the same constants, which is not what the priors say of specimens.

    python -m benchmarks.specimens [SETS [ERROR [POINTS]]]
"""

from __future__ import annotations

import sys
from itertools import combinations

import numpy as np
from scipy.special import logsumexp, ndtri

from forward.materials.material_point import HomogeneousModel, MaterialTest
from forward.model import FloatArray
from inverse.criticism.comparison import probabilities
from inverse.criticism.mixtures import DISAGREE, mixture
from uq.inputs.distributions import Distribution, LogNormal, LogUniform
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import even_points

SPECIMENS = 40
LEAST = 2e3  # Pa, of the errors
TESTS = tuple(
    MaterialTest(mode=mode, at=tuple(np.linspace(1.2, 2.6, 8))) for mode in ("uniaxial", "pure-shear", "equibiaxial")
)
KINDS: dict[str, dict[str, Distribution]] = {
    "neo-hookean": {"C1": LogNormal(mean=2e5, std=1e5)},
    "yeoh": {
        "C10": LogNormal(mean=2e5, std=1e5),
        "C20": LogUniform(lower=1e2, upper=3e4),
        "C30": LogUniform(lower=1.0, upper=3e3),
    },
    "gent": {"mu": LogNormal(mean=4e5, std=2e5), "Jm": LogUniform(lower=15.0, upper=100.0)},
}


def stresses(kind: str, normals: FloatArray) -> FloatArray:
    """Return the stresses (n, m) of a material with constants by standard normal numbers (n, d)."""
    model = HomogeneousModel(kind, {}, TESTS, tuple(KINDS[kind]))
    return model.stresses(Inputs(KINDS[kind]).from_normals(normals)[0])


def evidences(kind: str, sets: int, seed: int, error: float, points: int, *, alike: bool = False) -> FloatArray:
    """Return ln Z (K, count) of the candidates for specimens of one material, all alike in each set or not."""
    rng, count = np.random.default_rng(seed), sets * SPECIMENS
    normals = rng.standard_normal((sets if alike else count, len(KINDS[kind])))
    exact = stresses(kind, np.repeat(normals, count // len(normals), axis=0))
    sigma = np.maximum(error * np.abs(exact), LEAST)
    values = exact + sigma * rng.standard_normal(exact.shape)
    found = np.empty((len(KINDS), count))
    for k, (name, constants) in enumerate(KINDS.items()):
        there = stresses(name, ndtri(even_points(points, len(constants))))
        for g in range(count):
            misfit = (((there - values[g]) / sigma[g]) ** 2).sum(axis=1) / 2
            found[k, g] = logsumexp(-misfit[np.isfinite(misfit)]) - np.log(points)
    return found


def told(sets: list[FloatArray]) -> tuple[int, FloatArray, int]:
    """Return in how many sets of evidences specimens disagree, ln of the Bayes factors, and how many are sure."""
    weights = np.full(len(KINDS), 1 / len(KINDS))
    factors = np.array([mixture(one, weights).log_bayes_factor for one in sets])
    sure = sum(probabilities(one.sum(axis=1), weights).max() > 0.99 for one in sets)
    return int((factors > DISAGREE).sum()), factors, int(sure)


def main(sets: int = 20, error: float = 0.1, points: int = 16384) -> None:
    """Print the table."""
    of, alike = {}, {}
    for seed, kind in enumerate(KINDS):
        of[kind] = evidences(kind, sets, seed, error, points)
        alike[f"{kind}, alike"] = evidences(kind, sets, seed, error, points, alike=True)
    mixed = [(a, b, share) for a, b in combinations(KINDS, 2) for share in (0.5, 0.2, 0.1)]
    every = of | alike
    sys.stdout.write(f"{'specimens':34}  said      ln B: least, median, largest   above 99 %\n")
    for a, b, share in [*((kind, kind, 0.0) for kind in of), *mixed, *((kind, kind, 0.0) for kind in alike)]:
        second = round(share * SPECIMENS)
        rows = [
            np.hstack([every[a][:, start : start + SPECIMENS - second], every[b][:, start : start + second]])
            for start in range(0, sets * SPECIMENS, SPECIMENS)
        ]
        said, factors, sure = told(rows)
        words = f"{SPECIMENS - second} {a}" + (f", {second} {b}" if second else "")
        least, middle, most = np.quantile(factors, [0, 0.5, 1])
        sys.stdout.write(f"{words:34}  {said:2d} of {sets}  {least:8.1f} {middle:8.1f} {most:8.1f}  {sure:8d}\n")


if __name__ == "__main__":
    main(*(kind(word) for kind, word in zip((int, float, int), sys.argv[1:], strict=False)))
