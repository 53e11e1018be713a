"""What a cheap model misses, learnt from pairs of solves: of the model, and of one that stands for the truth.

The errors G(ω) − g(ω) of a cheap model g are taken for independent of its parameters, with a mean and a covariance that
N pairs tell (`inverse.data.noise`): first over the prior, then over the posterior that is found with these (J. Kaipio,
E. Somersalo, J. Comput. Appl. Math. 198 (2007) 493–504).
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
from inverse.data.noise import ModelError
from inverse.low_dimensional.laplace import Laplace, laplace
from inverse.low_dimensional.posterior import Posterior
from uq.evaluation.evaluate import Steps
from uq.evaluation.request import Evaluate, Request
from uq.surrogates.linearisation import linearise

LEAST = 8  # pairs


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
        start = None
        with suppress(SolveError):  # or else every solve begins at zero
            if self.evaluate.differentiable:
                start = linearise(posterior.inputs, self.evaluate, points.mean(axis=0)).prediction
        there = self.evaluate(Request(points, start=start))
        here = posterior.evaluate(Request(points, start=posterior.start))
        both = there.ok & here.ok
        if both.sum() < LEAST:
            message = f"{both.sum()} of {len(points)} pairs have an answer, expected at least {LEAST}"
            raise SolveError(f"model_error: {message}")
        measured = np.array(posterior.evaluate.outputs)[posterior.which]
        columns = [self.evaluate.outputs.index(name) for name in measured]
        errors = there.outputs[both][:, columns] - here.outputs[both][:, posterior.which]
        return ModelError.of_pairs(errors, factor * posterior.noise.sigma, points[both].mean(axis=0), factor)


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
