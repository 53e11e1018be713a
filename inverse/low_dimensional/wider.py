"""A posterior with further unknowns that are standard normal beforehand, such as strengths or standard deviations.

With the gradient g and the second derivatives C⁻¹ of −ln of the posterior at its mode x̂, the mean is near

    x̂ − ½ C Σ_k (g(x̂ + v_k) − 2 g(x̂) + g(x̂ − v_k)),   Σ_k v_k v_kᵀ = C,

by third derivatives (L. Tierney, J. B. Kadane, J. Am. Stat. Assoc. 81 (1986) 82–86). Of these v, those of a Cholesky
factor with the further unknowns first hold all that these are otherwise by; along the others they stay.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from forward.model import FloatArray
from inverse.low_dimensional.posterior import Posterior
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

    Raises
    ------
    SolveError
        If the model has no answer there.
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


def missed(wider: Wider) -> FloatArray:
    """Return how far the means of the d parameters are moved, in deviations, by third derivatives along the others.

    That is what is missed where the others are integrated out to first order. NaN where the model has no answer.
    """
    posterior, new = wider.posterior, wider.new
    here = posterior.at(wider.first[None], derivatives=True)
    covariance = np.linalg.inv(here.curvature[0])
    lines = np.linalg.solve(np.linalg.cholesky(covariance[np.ix_(new, new)]), covariance[new])
    ends = posterior.at(np.vstack([wider.first + lines, wider.first - lines]), derivatives=True)
    bent = ends.gradient.sum(axis=0) - 2 * len(new) * here.gradient[0]
    return np.asarray(-(covariance @ bent)[wider.own] / np.sqrt(np.diag(covariance)[wider.own]) / 2)
