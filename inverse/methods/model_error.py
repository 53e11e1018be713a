"""What a cheap model misses, learnt from pairs of solves: of the model, and of one that stands for the truth.

The errors G(ω) − g(ω) of a cheap model g have a mean and a covariance that N pairs tell (`inverse.data.noise`): first
over the prior, then over the posterior that is found with these (J. Kaipio, E. Somersalo, J. Comput. Appl. Math. 198
(2007) 493–504). Where both models have derivatives, these tell to first order how errors follow the parameters or the
predictions of g (`Trend`), and pairs tell what is left: of these ways and of none, that which leaves least.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from forward.model import FloatArray, SolveError
from forward.phases import phase
from forward.settings import Settings
from inverse.data.noise import ModelError, Trend
from inverse.low_dimensional.laplace import Laplace, laplace
from inverse.low_dimensional.posterior import Posterior
from uq.evaluation.evaluate import Steps
from uq.evaluation.request import Evaluate, Request
from uq.surrogates.linearisation import Linearisation, linearise

LEAST = 8  # pairs
# Weights of predictions over those of the prior, by which errors follow parameters: these themselves, or predictions
# wherever a deviation of a parameter moves these by more than a thousandth of the noise.
FOLLOWED = (0.0, 1e6)


class LearntError(Settings):
    """The error of the model against another one, which stands for the truth.

    Parameters
    ----------
    against
        What the other model has other than that of the study: blocks and values that replace those there; with a kind,
        it is a whole model. It has the unknown numbers, and what was measured.
    solves
        Its solves over the prior, and as many over the posterior.
    """

    against: dict[str, Any]
    solves: Annotated[int, Field(ge=LEAST)] = 16


@dataclass(frozen=True)
class Truth:
    """A model that stands for the truth, with outputs of the names of the model's.

    Attributes
    ----------
    evaluate
        The model.
    solves
        Pairs over the prior, and over the posterior.
    seed
        Of their parameters.
    """

    evaluate: Evaluate
    solves: int
    seed: int = 0

    def error(self, posterior: Posterior, points: FloatArray, factor: float = 1.0) -> ModelError:
        """Return what pairs at parameters (N, d) tell; `factor` on the noise is that at which it counts.

        Raises `SolveError` if fewer than `LEAST` pairs have an answer.
        """
        middle: list[Linearisation] = []
        with suppress(SolveError):  # or else every solve begins at zero
            if self.evaluate.differentiable and posterior.evaluate.differentiable:
                both = (self.evaluate, posterior.evaluate)
                middle = [linearise(posterior.inputs, one, points.mean(axis=0)) for one in both]
        there = self.evaluate(Request(points, start=middle[0].prediction if middle else None))
        here = posterior.evaluate(Request(points, start=posterior.start))
        ok = there.ok & here.ok
        if ok.sum() < LEAST:
            message = f"{ok.sum()} of {len(points)} pairs have an answer, expected at least {LEAST}"
            raise SolveError(f"model_error: {message}")
        which, sigma = posterior.which, posterior.noise.sigma
        columns = [self.evaluate.outputs.index(name) for name in np.array(posterior.evaluate.outputs)[which]]
        predicted = here.outputs[ok][:, which]
        errors = there.outputs[ok][:, columns] - predicted
        known = partial(ModelError.of_pairs, sigma=factor * sigma, scale=factor)
        ways = [known(errors)]
        if middle:
            outputs, tangents = middle[1].outputs[which], middle[1].tangents[which]
            slopes = middle[0].tangents[columns] - tangents
            for weight in FOLLOWED:
                trend = Trend(middle[0].point, outputs, tangents, slopes, weight / sigma**2, posterior.inputs.std)
                ways.append(replace(known(errors - trend.at(points[ok], predicted)), trend=trend))
        return min(ways, key=lambda one: ((one.std / sigma) ** 2).sum())


@phase("learning the error of the model")
def over_prior(posterior: Posterior, truth: Truth, steps: Steps) -> Posterior:
    """Return a posterior that knows the errors of its model over the prior; errors as of `Truth.error`."""
    points = posterior.inputs.drawn(np.random.default_rng([truth.seed, 0]), truth.solves)
    return _knowing(posterior, steps("errors over the prior", partial(truth.error, posterior, points)))


@phase("learning the error of the model")
def over_posterior(posterior: Posterior, gaussian: Laplace, truth: Truth, steps: Steps) -> tuple[Posterior, Laplace]:
    """Return a posterior that knows the errors over its Gaussian, and its own Gaussian; errors as of `Truth.error`."""
    inputs, d = posterior.inputs, len(posterior.inputs.names)
    rng, points = np.random.default_rng([truth.seed, 1]), np.zeros((0, d))
    while len(points) < truth.solves:
        normals = gaussian.mode + rng.standard_normal((truth.solves, len(gaussian.mode))) @ gaussian.root.T
        more = inputs.from_normals(normals[:, :d])[0]
        points = np.concatenate([points, more[inputs.allowed(more)]])
    factor = 1.0 if posterior.noise.factor is None else float(posterior.physical(gaussian.mode[None])[0, -1])
    error = partial(truth.error, posterior, points[: truth.solves], factor)
    there = _knowing(posterior, steps("errors over the posterior", error))
    return there, laplace(there, starts=1, first=gaussian.mode)


def _knowing(posterior: Posterior, error: ModelError) -> Posterior:
    return replace(posterior, noise=replace(posterior.noise, model=error))
