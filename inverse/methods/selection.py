"""Model selection as a method: the evidences that are found, and their variants.

The probability of model k given the data is P_k ∝ π_k Z_k (R. E. Kass, A. E. Raftery, J. Am. Stat. Assoc. 90 (1995)
773–795). Groups of data (specimens, regions) each have their own constants under one law: the ln Z of the groups add.
Variants show what it depends on: other noise, other data, and priors half and twice as wide, which reweight the points
that were solved already (in standard normal coordinates, N(0, s²I) instead of N(0, I)).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from forward.model import FloatArray, SolveError
from forward.phases import phase
from forward.settings import Settings
from inverse.criticism.assessment import solves_of
from inverse.criticism.comparison import Candidate, Compared, Pair, comparison
from inverse.criticism.verdict import spectrum_of
from inverse.data.measurements import Measurements
from inverse.data.noise import Noise
from inverse.data.shared_motion import determined
from inverse.low_dimensional.evidence import LEAST, nested
from inverse.low_dimensional.posterior import Posterior
from inverse.methods.infer import Inferred, Problem, by_tangents, infer
from inverse.methods.invert import Inference
from inverse.methods.model_error import Truth
from inverse.methods.record import of_learnt
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.request import Evaluate
from uq.inputs.distributions import Distribution
from uq.inputs.random_parameters import Inputs

if TYPE_CHECKING:
    import xarray as xr

WIDTHS = (0.5, 2.0)  # of the priors, in the variants
STATED = "as stated"
NonNegative = Annotated[float, Field(ge=0)]


class StatedNoise(Settings):
    """Errors of the data: independent and normal, with standard deviation s σ_i, σ_i = max(relative |y_i|, absolute).

    Parameters
    ----------
    absolute, relative
        In the units of the data, and relative to them; without both, σ_i is given with the data.
    factor
        Prior of s; without it s = 1.
    """

    absolute: NonNegative = 0.0
    relative: NonNegative = 0.0
    factor: Distribution | None = None

    @property
    def given(self) -> bool:
        """Whether σ is given with the data."""
        return self.absolute == 0 and self.relative == 0

    def sigma_of(self, data: Measurements) -> FloatArray:
        """Return σ (m,) for data (m,); raises `ValueError` if one of them is not positive."""
        if self.given:
            if not np.isfinite(data.sigma).all():
                message = "neither absolute nor relative noise, and no sigma with the data: expected one of them"
                raise ValueError(message)
            return data.sigma
        sigma = np.maximum(self.relative * np.abs(data.values), self.absolute)
        if not (sigma > 0).all():
            raise ValueError("relative noise vanishes where a datum is zero, expected a floor: absolute = ...")
        return sigma

    def of(self, data: Measurements, other: Noise | None = None) -> Noise:
        """Return the errors of data (m,), with what they share and a model misses as in others; errors as above."""
        sigma = self.sigma_of(data)
        return replace(other or Noise(sigma), sigma=sigma, factor=self.factor)


class Select(Inference):
    """Bayesian model selection: evidence and probability of every candidate, and how far they can be trusted.

    Parameters
    ----------
    samples
        Solves for each evidence, in addition to those of the search for the mode.
    noise
        Errors of the data.
    other_noises
        Other assumptions on the errors, by name; all evidences are computed again with each.
    subsets
        Tests whose data are used alone, by name; all evidences are computed again with each.
    held_out
        Predict every test from the others too: all evidences are computed again without each of them.
    seed
        Of all draws.
    starts
        Starts of each search for the mode.
    chains
        Run Markov chains for each candidate too, as an inversion does: "pcn", "emcee" or "hmc". If they have mixed,
        constants and predictions are theirs; those by "hmc" tell the evidence too, where weighted points cannot.
    chains_when
        "needed": only where weighted points cannot be trusted.
    assumptions
        Tell how far what is taken for granted moves the constants and the evidence, as an inversion does.
    check
        "dynesty": compute the evidences by nested sampling too.
    mesh_error
        What the error of each candidate's mesh, if it has one, does to the data, to the evidence and to the unknowns,
        by solves on finer meshes with thinner cells at the faces that are held: "correct" the candidate by it where it
        exceeds a fifth of the noise or of an unknown's deviation; "report" it only; false: not at all, and no evidence
        is said to be trusted.
    mesh_check
        An older name: false is mesh_error = false.
    """

    kind: Literal["select"] = "select"
    samples: Annotated[int, Field(ge=LEAST)] = 256
    noise: StatedNoise
    other_noises: dict[str, StatedNoise] = Field(default={})
    subsets: dict[str, Annotated[tuple[str, ...], Field(min_length=1)]] = Field(default={})
    held_out: bool = False
    check: Literal["dynesty"] | None = None

    @model_validator(mode="after")
    def _check(self) -> Select:
        names = [STATED, *self.other_noises, *self.subsets]
        if len(set(names)) < len(names):
            raise ValueError(f"other_noises and subsets: names {', '.join(names)}, expected different ones")
        return self

    @property
    def variants(self) -> int:
        """Number of times that all evidences are computed, not counting held-out tests."""
        return 1 + len(self.other_noises) + len(self.subsets)

    def solves(self, size: int, *, field: bool) -> int:
        return self.samples

    def chain_solves(self, size: int) -> int:
        """Most solves of the chains of a candidate with so many unknown constants."""
        return solves_of(self.chains, size)

    def run(
        self,
        candidates: Mapping[str, Candidate],
        data_groups: Mapping[str, Measurements],
        evaluate: Callable[[str, str], Evaluate],
        problem: Callable[[str, str], Problem[Select]] | None = None,
        free: Callable[[str, str], Evaluate] | None = None,
    ) -> xr.Dataset:
        """Compare candidates.

        Parameters
        ----------
        candidates
            By name.
        data_groups
            Data by the name of the group.
        evaluate
            The model of a candidate for a group; its first outputs are the data of the group, others are predicted.
        problem
            The measured data of a group, and what is known besides for a candidate; asked after the model. By default
            the data alone.
        free
            The same as `evaluate` without cost, for nested sampling.

        Returns
        -------
        xarray.Dataset
            See docs/results.md.

        Raises
        ------
        SolveError
            If a model has no answer at any start or any point.
        """
        pairs = [(name, group) for name in candidates for group in data_groups]
        found: dict[Pair, Inferred] = {}
        problems: dict[Pair, Problem[Select]] = {}
        for name, group in pairs:
            one = posterior(candidates[name], data_groups[group], self.noise, evaluate(name, group))
            asked = Problem(data_groups[group].seen(), self, finer=None) if problem is None else problem(name, group)
            problems[name, group] = asked = replace(asked, start=by_tangents(one.inputs, one.evaluate))
            with _of((name, group)):
                found[name, group] = infer(one, replace(asked, steps=asked.steps.of(STATED)))
        posteriors = {pair: one.posterior for pair, one in found.items()}
        stated = {pair: one.assessment for pair, one in found.items()}
        quick = self.model_copy(update={"chains": None})

        def value(changed: Posterior, pair: Pair, label: str) -> tuple[float, float]:
            def again() -> tuple[float, float]:
                other = Problem(one.data, quick, finer=None, start=start, steps=parts)
                return infer(changed, other).assessment.log_evidence

            one = problems[pair]
            start = None if found[pair].sampled else one.start  # which is of the parameters alone
            parts = one.steps.of(label)
            with _of(pair):
                return parts("evidence", again)

        def checked(pair: Pair) -> tuple[float, float]:
            parts, wider = problems[pair].steps, problems[pair].sampled if found[pair].sampled else None
            cheap = (free or evaluate)(*pair) if wider is None else SerialEvaluate(wider.make())
            one = replace(posteriors[pair], evaluate=cheap)
            return parts("nested", lambda: nested(one, seed=self.seed, kept=parts.rows("likelihoods")))

        variants: dict[str, dict[Pair, tuple[float, float]]] = {
            STATED: {pair: one.log_evidence for pair, one in stated.items()}
        }
        for width in WIDTHS:
            label = f"priors × {width:g}"
            variants[label] = {
                pair: one.reweighted(partial(_rescaled, candidates[pair[0]].inputs, found[pair].asked, width))
                for pair, one in stated.items()
            }
        for label, noise in self.other_noises.items():
            variants[label] = {
                pair: value(replace(one, noise=noise.of(data_groups[pair[1]].seen(), one.noise)), pair, label)
                for pair, one in posteriors.items()
            }

        def some(label: str, wanted: Callable[[tuple[str, ...]], set[str]]) -> dict[Pair, tuple[float, float]]:
            """Return ln Z and errors by the data of wanted ones of the tests of a group, in groups that have any."""
            tests = {pair: wanted(data_groups[pair[1]].measured_tests) for pair in pairs}
            return {
                pair: value(_only(posteriors[pair], data_groups[pair[1]], those), pair, label)
                for pair, those in tests.items()
                if those
            }

        for label, tests in self.subsets.items():
            variants[label] = some(label, set(tests).intersection)
        checks = {} if self.check is None else {pair: checked(pair) for pair in pairs}
        tests_of = [test for data in data_groups.values() for test in data.measured_tests] if self.held_out else []
        left_out = {
            test: some(f"without {test}", lambda those, test=test: {*those} - {test} if test in those else set())  # type: ignore[misc]
            for test in dict.fromkeys(tests_of)
        }
        compared = {}
        for pair, it in found.items():
            taken = problems[pair].assumed
            moves = None if taken is None or it.moves is None else (taken, it.moves)
            known = it.posterior, data_groups[pair[1]], it.assessment
            compared[pair] = Compared(*known, it.asked, it.mesh, moves, it.sampled)
        result = comparison(candidates, data_groups, compared, variants, checks, left_out)
        result = result.assign(_learnt(posteriors, {pair: one.truth for pair, one in problems.items()}, data_groups))
        if any(one.noise.shared is None for one in posteriors.values()):
            return result
        seen = [_motions(found[pair]) for pair in pairs]
        return result.assign(motion_eigenvalue=(("model", "motion"), np.array(seen)))


def posterior(candidate: Candidate, data: Measurements, noise: StatedNoise, evaluate: Evaluate) -> Posterior:
    """Return the posterior of a candidate."""
    seen = data.seen()
    which = np.arange(len(seen))  # what is only predicted follows
    return Posterior(candidate.inputs, evaluate, seen.values, noise.of(seen), which)


def _learnt(
    posteriors: Mapping[Pair, Posterior], truths: Mapping[Pair, Truth | None], data_groups: Mapping[str, Measurements]
) -> dict[str, Any]:
    """Mean and standard deviation of learnt errors, as `of_learnt`; NaN of others, empty without any."""
    if not any(truths.values()):
        return {}
    names = list(dict.fromkeys(name for name, _ in posteriors))
    sizes, solves = [len(data) for data in data_groups.values()], np.zeros(len(names))
    follows = np.ones(len(names))
    found = [np.full((2, len(names), size), np.nan) for size in sizes]
    for k, name in enumerate(names):
        for rows, group in zip(found, data_groups, strict=True):
            noise, truth = posteriors[name, group].noise, truths[name, group]
            if truth is not None and noise.model is not None:
                of = of_learnt(noise, truth)
                rows[:, k, : len(noise.sigma)] = [of["model_error"], of["model_error_std"]]
                solves[k] += of["model_error_solves"]
                follows[k] *= of["model_error_follows"]
    both, dims = np.concatenate(found, axis=2), ("model", "output")
    return {
        "model_error": (dims, both[0]),
        "model_error_std": (dims, both[1]),
        "model_error_solves": ("model", solves),
        "model_error_follows": ("model", np.where(solves > 0, follows, np.nan)),
    }


def _motions(one: Inferred) -> FloatArray:
    """What the data say about rigid motions that are uncertain, at the mode, as `determined`."""
    posterior = one.posterior
    return determined(spectrum_of(posterior, one.found.at), posterior.noise, np.ones(posterior.data.size))


def _only(posterior: Posterior, data: Measurements, tests: Collection[str]) -> Posterior:
    """The same with the data of some tests only."""
    which = np.flatnonzero(np.isin(data.seen().tests, list(tests)))
    return replace(posterior, data=posterior.data[which], noise=posterior.noise.of(which), which=which)


def _rescaled(inputs: Inputs, asked: Sequence[int], width: float, points: FloatArray) -> FloatArray:
    """Return what priors of another width add to ln of the prior density at points (n, c).

    These hold the d parameters first among those places that are asked for; what is uncertain beside stays.
    """
    x = points[:, asked[: len(inputs.names)]]
    change = -(x**2).sum(axis=1) / 2 * (1 / width**2 - 1) - x.shape[1] * np.log(width)
    return np.asarray(change + np.log(inputs.admitted / inputs.admitted_at(width)))


@contextmanager
def _of(pair: Pair) -> Iterator[None]:
    """Say which candidate is looked at, and of which one a model has no answer."""
    try:
        with phase(pair[0]):
            yield
    except SolveError as error:
        raise SolveError(f"candidate '{pair[0]}': {error.reason}", error.history) from None
