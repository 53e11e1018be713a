"""The way from a model and data to a posterior of few parameters, the same for inversions and for comparisons.

Start, mode, errors that data share, error of the mesh, evidence: in this order, since each stands on the one before.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, Generic, TypeVar

import numpy as np

from forward.model import FloatArray, ForwardModel, SolveError
from inverse.criticism.assessment import Assessment, assess
from inverse.criticism.assumptions import BENT, Assumptions, Moves, moved_by
from inverse.criticism.finer import NOT_LOOKED, Finer, MeshFound
from inverse.criticism.questions import Questions
from inverse.data.measurements import Measurements
from inverse.data.noise import NORMAL, NormalErrors, StudentErrors
from inverse.data.shared_motion import Shared
from inverse.low_dimensional.laplace import Laplace, laplace
from inverse.low_dimensional.posterior import Density, Posterior, Wider, missed, widened
from inverse.low_dimensional.residual_process import Process, with_process
from inverse.methods.invert import Inference
from inverse.methods.mesh_correction import before_few, corrected_few
from inverse.methods.model_error import Truth, over_posterior, over_prior
from uq.evaluation.evaluate import ALL_AGAIN, Recorder, Steps
from uq.evaluation.request import Evaluate, Start
from uq.inputs.random_parameters import Inputs
from uq.surrogates.linearisation import linearise

# What data share is found anew at most so often, until the mode moves less, in deviations: the next move is a tenth.
ROUNDS, SETTLED = 4, 0.5
WIDE = 0.15  # ln of how much narrower or wider an answer may be than to first order in what is uncertain

Starts = Callable[[FloatArray], "Start | None"]  # parameters (d,) → what predicts states near there; None if nothing


@dataclass(frozen=True, eq=False)
class Sampled:
    """A model with further unknowns: what is uncertain beside the parameters, in its deviations.

    Attributes
    ----------
    names
        Of these (s,), among the groups of what is taken for granted.
    make, evaluate
        Makes the model of the parameters and these, as `Inputs.beside` puts them, and its evaluation.
    """

    names: tuple[str, ...]
    make: Callable[[], ForwardModel]
    evaluate: Evaluate


M = TypeVar("M", bound=Inference)


@dataclass(frozen=True, eq=False)
class Problem(Generic[M]):
    """A data set, and how it is inverted.

    Attributes
    ----------
    data, method, errors
        What was measured, the method, and the distribution of the errors.
    finer
        The model on finer meshes; None where it has no mesh.
    shared
        What errors the data share, at parameters (d,) or values of a field (N,); None if they are independent.
    start
        Makes what predicts states from a solution at parameters (d,), at the mean and at the mode; by default tangents.
    model
        The model itself, whose gradients chains by "hmc" follow.
    say
        Shows the user a line before the search.
    steps
        What keeps what is found of few parameters; by default it is found again after an interruption.
    assumed, sampled
        What is taken for granted, None if it is not looked at; and what samples those of it that are uncertain, where
        first order is not enough, None where nothing can be.
    questions
        What the body does not have, to be asked about; None if nothing is asked.
    truth
        What the errors of the model are learnt from; None where they are not, and always with finer meshes.
    elsewhere
        Displacements that are predicted, in the parts of the data, where what no parameters explain is there too.
    """

    data: Measurements
    method: M
    errors: NormalErrors | StudentErrors = NORMAL
    finer: Finer | None = NOT_LOOKED
    shared: Shared | None = None
    start: Starts | None = None
    model: ForwardModel | None = None
    say: Callable[[str], None] = field(default=lambda line: None)
    steps: Steps = ALL_AGAIN
    assumed: Assumptions | None = None
    sampled: Sampled | None = None
    questions: Questions | None = None
    truth: Truth | None = None
    elsewhere: Measurements | None = None


@dataclass(frozen=True, eq=False)
class AtMode:
    """A posterior, and Laplace's Gaussian of it."""

    posterior: Posterior
    gaussian: Laplace

    @cached_property
    def at(self) -> Density:
        """The posterior at its mode, with derivatives."""
        return self.posterior.at(self.gaussian.mode[None], derivatives=True)


@dataclass(frozen=True, eq=False)
class Inferred:
    """A posterior, and what was found of it.

    Attributes
    ----------
    found
        The posterior as it was corrected, with solves that start from its mode.
    first
        The same, with what is uncertain beside the parameters to first order only.
    searched
        Laplace's Gaussian as it was first found, with all starts of the search.
    assessment
        That of the corrected posterior, weighted points, chains.
    mesh, before
        What finer meshes have said, and the error of the mesh at the mean of the prior, in deviations of the noise;
        None where they were not asked.
    process
        What no parameters explain, where that was asked for.
    moves
        How far what is taken for granted moves the first of them, if it is looked at.
    sampled, solves
        What first order was not enough of, by name, which are unknowns too; and solves for these.
    """

    found: AtMode
    first: AtMode
    searched: Laplace
    assessment: Assessment
    mesh: MeshFound | None
    before: float | None
    process: Process | None = None
    moves: Moves | None = None
    sampled: tuple[str, ...] = ()
    solves: int = 0

    @property
    def posterior(self) -> Posterior:
        """The posterior as it was corrected."""
        return self.found.posterior

    @property
    def asked(self) -> list[int]:
        """Places, among the unknowns, of those that are asked for: the parameters, and the size of the errors."""
        return [k for k, name in enumerate(self.posterior.names) if name not in self.sampled]


def infer(posterior: Posterior, problem: Problem[Any]) -> Inferred:
    """Find the mode of a posterior, and what stands for it around there.

    Where solves start from something already, that is not sought again. Raises `SolveError` if the model has no answer
    where the search needs one.
    """
    method: Inference = problem.method
    shared, truth, assumed = problem.shared, problem.truth, problem.assumed
    start = problem.start or by_tangents(posterior.inputs, posterior.evaluate)
    steps, model = problem.steps, problem.model
    samples = method.solves(len(posterior.names), field=False)
    d = len(posterior.inputs.names)
    if shared is not None:
        posterior = _sharing(posterior, shared(posterior.inputs.mean))
    if posterior.start is None:
        with suppress(SolveError):  # or else every solve begins at zero
            posterior = replace(posterior, start=start(posterior.inputs.mean))
    if truth is not None:
        posterior = over_prior(posterior, truth, steps)
    before = None
    if problem.finer is not None and method.treatment is not None:
        before = before_few(posterior, problem.finer, problem.say)
    searched = gaussian = steps("mode", partial(laplace, posterior, starts=method.starts, seed=method.seed))
    if shared is not None:
        posterior, gaussian = _settled(posterior, gaussian, shared)
    if truth is not None:
        posterior, gaussian = over_posterior(posterior, gaussian, truth, steps)
    posterior, mesh = replace(posterior, start=start(posterior.physical(gaussian.mode[None])[0, :d])), None
    process = None
    if problem.finer is not None:
        treatment = method.treatment or "report"
        posterior, gaussian, mesh = corrected_few(posterior, gaussian, problem.finer, problem.data, treatment)
    if problem.errors.process:
        posterior, gaussian, process = with_process(posterior, gaussian, problem.data, problem.elsewhere)
    found = first = AtMode(posterior, gaussian)
    moves = None if assumed is None else moved_by(posterior, gaussian, first.at, assumed)
    unknown: tuple[str, ...] = ()
    recorder, sampled = None, problem.sampled
    if sampled is not None and assumed is not None:
        recorder = Recorder(sampled.evaluate)
        heavy = problem.errors.dof is not None  # then nothing is known to first order
        with nullcontext() if heavy else suppress(SolveError):  # there is no answer to any of them at the mode
            wider, parts = _sampling(first, assumed, sampled, recorder), replace(steps.of("sampled"), recorder=recorder)
            if heavy or _bent(wider, gaussian):
                gaussian = parts("mode", partial(laplace, wider.posterior, starts=1, first=wider.first))
                problem.say(f"first order is not enough of what is uncertain: {', '.join(sampled.names)} sampled")
                found, unknown = AtMode(wider.posterior, gaussian), sampled.names
                model, steps = sampled.make() if method.chains == "hmc" else None, parts
    one = assess(
        found.posterior,
        gaussian.knowing(searched, [k for k, name in enumerate(found.posterior.names) if name not in unknown]),
        samples,
        chains=method.chains,
        when=method.chains_when,
        model=model,
        seed=method.seed,
        steps=steps,
    )
    solves = 0 if recorder is None else recorder.solves
    return Inferred(found, first, searched, one, mesh, before, process, moves, unknown, solves)


def _bent(wider: Wider, gaussian: Laplace) -> bool:
    """Whether first order misses much of the parameters, or what it misses is not known."""
    means, widths = np.abs(missed(wider, np.linalg.inv(gaussian.hessian)))
    return not (means <= BENT).all() or not (widths <= WIDE).all()


def _sampling(first: AtMode, assumed: Assumptions, sampled: Sampled, evaluate: Evaluate) -> Wider:
    """Return a posterior with unknowns for what is uncertain, which is no error any more."""
    posterior, mode = first.posterior, first.gaussian.mode
    noise, which = posterior.noise, [list(assumed.groups).index(name) for name in sampled.names]
    assert noise.uncertain is not None
    likely = -noise.pull @ posterior.residuals(first.at.outputs, mode[None])[0]
    others = np.delete(noise.uncertain, which, axis=0)
    fewer = replace(posterior, noise=replace(noise, uncertain=others if len(others) else None))
    return widened(fewer, mode, sampled.names, likely[which], lambda names: evaluate)


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
