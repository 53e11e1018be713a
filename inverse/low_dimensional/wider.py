"""A posterior with further unknowns that are standard normal beforehand, such as strengths or standard deviations.

What is missed where these are integrated out to first order, three points of each tell (Gauss and Hermite), along the
Cholesky factor of their covariance, with the parameters on their regression on them. Given the further unknowns there,
the posterior of the parameters is nearly a Gaussian, one Newton step away; their moments are those of the mixture, each
weighted by what its Gaussian holds of the density.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from forward.model import FloatArray
from inverse.low_dimensional.posterior import Density, Posterior
from uq.evaluation.request import Evaluate
from uq.surrogates.linearisation import linearise


class Wider(NamedTuple):
    """A posterior with further unknowns.

    Attributes
    ----------
    posterior
        The posterior.
    first
        Coordinates (c,) where the search for its mode begins.
    own, new
        Places of the parameters (d,) that it had, and of the others (k,).
    """

    posterior: Posterior
    first: FloatArray
    own: list[int]
    new: list[int]


def widened(
    posterior: Posterior,
    mode: FloatArray,
    names: Sequence[str],
    values: FloatArray,
    evaluate: Callable[[Sequence[str]], Evaluate],
    means: FloatArray | None = None,
) -> Wider:
    """Return a posterior with unknowns of further names, near its mode (c,) and most probable values (k,) of these.

    These have the standard deviation 1 beforehand, and means that are zero by default.

    Names of parameters → the model of these. What the model misses is taken to be the same whatever the others are.
    Raises `SolveError` if the model has no answer there.
    """
    before, d = posterior.inputs, len(posterior.inputs.names)
    means = np.zeros(len(names)) if means is None else means
    inputs = before.beside(names, means)
    own, new = ([inputs.names.index(name) for name in some] for some in (before.names, names))

    def wider(rows: FloatArray) -> FloatArray:
        found = np.zeros((len(rows), len(inputs.names)))
        found[:, own] = rows
        return found

    x = wider(mode[None, :d])
    x[0, new] = values - means
    noise, model = posterior.noise, evaluate(inputs.names)
    if noise.model is not None and noise.model.slopes.size:
        more = {"point": wider(noise.model.point[None])[0], "slopes": wider(noise.model.slopes)}
        noise = replace(noise, model=replace(noise.model, **more))
    start = linearise(inputs, model, inputs.from_normals(x)[0][0]).prediction
    found = replace(posterior, inputs=inputs, evaluate=model, noise=noise, start=start)
    return Wider(found, np.append(x[0], mode[d:]), own, new)


def missed(wider: Wider, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return what first order misses of the d parameters: of their means, in deviations, and of ln deviation.

    `covariance` (c, c) is that of the posterior to first order. NaN where the model has no answer.
    """
    posterior, new = wider.posterior, wider.new
    rest = np.setdiff1d(np.arange(len(wider.first)), new)
    own = np.searchsorted(rest, wider.own)
    here = posterior.at(wider.first[None], derivatives=True)
    joint = np.linalg.inv(here.curvature[0])
    lines = np.sqrt(3) * np.linalg.solve(np.linalg.cholesky(joint[np.ix_(new, new)]), joint[new])

    def given(at: Density) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Means and variances of the rest, given the further unknowns, and what the Gaussian holds of the density."""
        gradient, inverse = at.gradient[:, rest], np.linalg.inv(at.curvature[:, rest[:, None], rest])
        step = -np.einsum("zce,ze->zc", inverse, gradient)
        held = at.log_posterior - ((gradient * step).sum(axis=1) - np.linalg.slogdet(inverse)[1]) / 2
        return at.x[:, rest] + step, np.diagonal(inverse, axis1=1, axis2=2), held

    mean, variance, middle = given(here)
    far, wide, held = given(posterior.at(np.vstack([wider.first + lines, wider.first - lines]), derivatives=True))
    weights = np.exp(held - middle + 1.5).reshape(2, -1, 1) / 6  # e^(3/2): beside the density of the normal there
    weights /= 2 / 3 + weights.sum(axis=0)
    apart, wider_by = ((x - y).reshape(2, len(new), -1) for x, y in ((far, mean), (wide, variance)))
    moves = (weights * apart).sum(axis=0)
    widths = variance[0] + ((weights * (wider_by + apart**2)).sum(axis=0) - moves**2).sum(axis=0)
    moved = moves.sum(axis=0) - (joint @ here.gradient[0])[rest]
    before = np.diag(covariance)[: len(own)]
    return (moved / np.sqrt(np.diag(joint)[rest]))[own], np.log(widths[own] / before) / 2
