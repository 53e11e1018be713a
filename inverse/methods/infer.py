"""The way from a model and data to a posterior of few parameters, the same for inversions and for comparisons.

Start, mode, errors that data share, error of the mesh, evidence: in this order, since each stands on the one before.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from forward.model import FloatArray, ForwardModel, SolveError
from inverse.criticism.assessment import Assessment, Kind, When, assess
from inverse.criticism.finer import Finer, MeshFound
from inverse.data.measurements import Measurements
from inverse.data.shared_motion import Shared
from inverse.low_dimensional.laplace import Laplace, laplace
from inverse.low_dimensional.posterior import Posterior
from inverse.low_dimensional.residual_process import Process, with_process
from inverse.methods.mesh_correction import Treatment, before_few, corrected_few
from inverse.methods.model_error import Truth, over_posterior, over_prior
from uq.evaluation.evaluate import ALL_AGAIN, Steps
from uq.evaluation.request import Evaluate, Start
from uq.inputs.random_parameters import Inputs
from uq.surrogates.linearisation import linearise

# What data share is found anew at most so often, until the mode moves less, in deviations: the next move is a tenth.
ROUNDS, SETTLED = 4, 0.5

Starts = Callable[[FloatArray], "Start | None"]  # parameters (d,) → what predicts states near there; None if nothing


@dataclass(frozen=True, eq=False)
class Looked:
    """How the error of the mesh is looked at: on finer meshes, of which data, and what is done about it.

    Without a treatment it is not looked at before the search, and only reported.
    """

    finer: Finer
    data: Measurements
    treatment: Treatment | None


@dataclass(frozen=True, eq=False)
class Inferred:
    """A posterior, and what was found of it.

    Attributes
    ----------
    posterior
        As it was corrected, with solves that start from its mode.
    searched
        Laplace's Gaussian as it was first found, with all starts of the search.
    assessment
        That of the corrected posterior, weighted points, chains.
    mesh, before
        What finer meshes have said, and the error of the mesh at the mean of the prior, in deviations of the noise;
        None where they were not asked.
    process
        What no parameters explain, where that was asked for.
    """

    posterior: Posterior
    searched: Laplace
    assessment: Assessment
    mesh: MeshFound | None
    before: float | None
    process: Process | None = None


def infer(
    posterior: Posterior,
    start: Starts,
    samples: int,
    *,
    starts: int,
    seed: int,
    look: Looked | None = None,
    shared: Shared | None = None,
    unexplained: Measurements | None = None,
    truth: Truth | None = None,
    chains: Kind | None = None,
    when: When = "always",
    model: ForwardModel | None = None,
    say: Callable[[str], None] = lambda line: None,
    steps: Steps = ALL_AGAIN,
) -> Inferred:
    """Find the mode of a posterior, and what stands for it around there.

    Parameters
    ----------
    posterior
        Of a model and data. Where solves start from something already, that is not sought again.
    start
        Makes what predicts states from a solution at parameters (d,), at the mean and at the mode.
    samples, chains, when, model
        As of `assess`.
    starts, seed
        Of the search for the mode.
    look
        How the error of the mesh is looked at; None where there is no mesh.
    shared
        What errors the data share, at parameters (d,); None if they are independent.
    unexplained
        The data, if what the model does not explain of them is a process among their errors.
    truth
        What the errors of the model are learnt from; None where they are not, and always with finer meshes.
    say
        Shows the user a line before the search.
    steps
        What keeps the mode, weighted points and chains; by default they are found again after an interruption.

    Raises
    ------
    SolveError
        If the model has no answer where the search needs one.
    """
    d = len(posterior.inputs.names)
    if shared is not None:
        posterior = _sharing(posterior, shared(posterior.inputs.mean))
    if posterior.start is None:
        with suppress(SolveError):  # or else every solve begins at zero
            posterior = replace(posterior, start=start(posterior.inputs.mean))
    if truth is not None:
        posterior = over_prior(posterior, truth, steps)
    before = None if look is None or look.treatment is None else before_few(posterior, look.finer, say)
    searched = gaussian = steps("mode", partial(laplace, posterior, starts=starts, seed=seed))
    if shared is not None:
        posterior, gaussian = _settled(posterior, gaussian, shared)
    if truth is not None:
        posterior, gaussian = over_posterior(posterior, gaussian, truth, steps)
    posterior, mesh = replace(posterior, start=start(posterior.physical(gaussian.mode[None])[0, :d])), None
    process = None
    if look is not None:
        treatment = look.treatment or "report"
        posterior, gaussian, mesh = corrected_few(posterior, gaussian, look.finer, look.data, treatment)
    if unexplained is not None:
        posterior, gaussian, process = with_process(posterior, gaussian, unexplained)
    one = assess(posterior, gaussian, samples, chains=chains, when=when, model=model, seed=seed, steps=steps)
    return Inferred(posterior, searched, one, mesh, before, process)


def _settled(posterior: Posterior, gaussian: Laplace, shared: Shared) -> tuple[Posterior, Laplace]:
    """Search on with what data share at the mode, until that stays."""
    d = len(posterior.inputs.names)
    for _ in range(ROUNDS):
        point, best = gaussian.mode, posterior.physical(gaussian.mode[None])[0]
        posterior = _sharing(posterior, shared(best[:d]), *best[d:])
        gaussian = laplace(posterior, starts=1, first=point)
        move = gaussian.mode - point
        if move @ gaussian.hessian @ move < SETTLED**2:
            break
    return posterior, gaussian


def _sharing(posterior: Posterior, shared: Mapping[str, Any], size: float = 1.0) -> Posterior:
    """Return a posterior of errors that data share, which the size of the others says nothing of."""
    noise = {name: rows / size for name, rows in shared.items()}
    return replace(posterior, noise=replace(posterior.noise, **noise))


def by_tangents(inputs: Inputs, evaluate: Evaluate) -> Starts:
    """Return what predicts states by tangents at a point.

    A model without states, or without an answer at the first point, the mean of the prior, is not asked again.
    """
    known: list[bool] = []

    def start(point: FloatArray) -> Start | None:
        if known == [False]:
            return None
        found = None
        try:
            found = linearise(inputs, evaluate, point).prediction
        finally:
            known[:] = known or [found is not None]
        return found

    return start
