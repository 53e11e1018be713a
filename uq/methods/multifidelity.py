"""Several models of one body: most samples from cheap ones, and no bias from any of them.

E[ψ_0] is a sum of what groups of models tell (`uq.estimators.blue`): every group gets its own random parameters, which
all its models share. A pilot of all models tells their covariances, from which the numbers of samples of all possible
groups follow, by predicted costs: those that make the largest relative error of a mean least. The tangent of each model
at the mean parameters, whose expectation is known, is taken off first (`uq.estimators.fidelities`).

The pilot also tells, with derivatives, how well an expansion does. Where that is predicted to be better than any
combination of models, it takes their place: the pilot is spent on the fit, and the samples of the model of the study
correct what it leaves.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, model_validator

from forward.findings import Finding
from forward.model import FloatArray, ModelError
from forward.registry import OfKind
from uq.estimators.fidelities import Found, correlations
from uq.evaluation.evaluate import Recorder
from uq.evaluation.request import OWN, Evaluate
from uq.findings import add
from uq.inputs.random_parameters import Inputs
from uq.methods.fidelity_choice import ByChoice
from uq.methods.fidelity_team import OWN_LABEL, PILOT, Fidelities
from uq.methods.fidelity_ways import ByExpansion, ByModels
from uq.methods.low_fidelity import CHEAP, CheapModel
from uq.methods.method import MESH, Amount, Probability
from uq.methods.monte_carlo import MOST_GROWTH, UNLIMITED
from uq.surrogates.linearisation import local_dataset

if TYPE_CHECKING:
    import xarray as xr

    from forward.scalars import Mistake
    from forward.spec import ModelSpec, Times

MOST_MODELS = 6  # cheap ones: 127 groups
FEWEST = 8  # samples of a pilot
SAMPLES, PER_MODEL = 16, 4  # samples of a pilot, and how many more for each cheap model
BETTER = 0.8  # predicted variance, over that of the models, from which an expansion takes their place
LITTLE = 0.01  # of what was spent: not worth another round
MORE = 0.1  # of what was spent: least that a tolerance that was missed is worth
KNOWN = 10  # failures at samples of the study's model that tell how much they matter
UNRELATED = 0.1  # squared correlation of remainders up to which a cheap model is of no use


class Multifidelity(Amount):
    """Approximate control variates: mean and standard deviation from a model and cheap ones, without bias.

    Of displacement fields only that at the mean parameters is there: models may live on different meshes.

    Parameters
    ----------
    cheap
        The cheap models, one to six.
    samples
        What may be spent, in solves of the study's model by predicted costs: with pilot and linearisations of all
        models, so that it compares with as many samples of other methods. With a tolerance or a budget, the most.
    tolerance
        Stop when the standard error of every mean is below this fraction of the mean (of the standard deviation,
        where the mean is smaller than that).
    budget_seconds
        As in `Amount`.
    pilot
        Number of samples of all models before anything is known of them; by default 16, and 4 more for each cheap one.
        They count in the estimates: each is weighted by what the others tell.
    reuse
        Whether they do. Without, the pilot decides on numbers and weights only and the estimates are unbiased to the
        letter; with, the numbers of samples depend on some of them, which has a bias of the order of 1/n.
    control
        What is taken off every model first: "tangent", its tangent at the mean parameters, or "none". "auto": its
        tangent, and where an expansion is predicted to be better than all models, that in their place.
    full_solves
        Which points the study's model is solved at: "differences", with probabilities that grow with the difference of
        the two cheap models that follow it best, so that it is asked where they are least to be trusted; "evenly", as
        any point. "auto": "differences", unless the pilot predicts for them four times the variance, since it has seen
        no tails (without tails: more times than they may save); with a single cheap model, evenly.
    quantiles
        Probabilities of the quantiles of the outputs.
    seed
        Seed of the random points; every group of models has its own stream.
    """

    undecided: ClassVar[str] = "linearisations and the pilot"
    kind: Literal["multifidelity"] = "multifidelity"
    cheap: Annotated[tuple[Annotated[CheapModel, OfKind(CHEAP)], ...], Field(min_length=1, max_length=MOST_MODELS)]
    pilot: Annotated[int, Field(ge=FEWEST)] | None = None
    reuse: bool = True
    control: Literal["auto", "tangent", "none"] = "auto"
    full_solves: Literal["auto", "evenly", "differences"] = "auto"
    quantiles: tuple[Probability, ...] = (0.05, 0.5, 0.95)
    seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _check(self) -> Multifidelity:
        labels = [one.label for one in self.cheap]
        for label in dict.fromkeys(labels):
            if labels.count(label) > 1:
                raise ValueError(f"{labels.count(label)} cheap models are called '{label}', expected different names")
            if label == OWN_LABEL or label.startswith(MESH):
                raise ValueError(f"a cheap model is called '{label}', expected another name")
        if self.full_solves == "differences" and len(self.cheap) < 2:
            raise ValueError("full_solves = 'differences' with a single cheap model, expected two or more")
        if self.samples is not None and self.samples <= self.first:
            raise ValueError(f"samples = {self.samples}, expected more than the {self.first} of the pilot")
        return self

    @property
    def first(self) -> int:
        """Number of samples of the pilot."""
        return self.pilot or SAMPLES + PER_MODEL * len(self.cheap)

    @property
    def limit(self) -> float:
        """What may be spent, in solves of the study's model."""
        return float(self.samples or UNLIMITED)

    def planned(self, dimension: int) -> int:
        """Number of solves of linearisations and pilot on all models, which decide how many more are needed."""
        return len(self._separate) + 1 + self.first * (1 + len(self.cheap))

    @property
    def _separate(self) -> list[CheapModel]:
        """The cheap models that are not the study's own."""
        return [one for one in self.cheap if one.stopped_after is None]

    def models(self, spec: ModelSpec) -> dict[str, ModelSpec]:
        found = {one.label: one.of(spec) for one in self._separate}
        return {label: model for label, model in found.items() if model is not None}

    def unfit(self, spec: ModelSpec) -> Iterator[Mistake]:
        """Find cheap models that cannot be, or do not fit the study's."""
        for i, one in enumerate(self.cheap):
            try:
                wrong = list(one.mistakes(spec))
            except ValidationError as error:
                wrong = [((), error.errors()[0]["msg"], one.kind)]
            except ModelError as error:
                wrong = [((), str(error), one.kind)]
            for place, message, given in wrong:
                yield ("method", "cheap", i, *place), message, given

    def mistakes(self, inputs: Inputs, spec: ModelSpec) -> Iterator[Mistake]:
        """Find cheap models that do not have the random parameters."""
        yield from super().mistakes(inputs, spec)
        for i, one in enumerate(self.cheap if not list(self.unfit(spec)) else ()):
            other = one.of(spec)
            known = () if other is None else (*other.scalars, *other.coefficients)
            missing = [] if other is None else [name for name in inputs.names if name not in known]
            if missing:
                message = f"has no {', '.join(missing[:3])}, expected all random parameters of the study"
                yield ("method", "cheap", i, "model", "parameters"), message, list(known)[:8]

    def seconds(self, dimension: int, costs: Mapping[str, Times]) -> float:
        """Predict the processor time (s) of what may be spent; of the pilot, if a tolerance or a budget decides."""
        if self.samples is not None:
            return self.samples * costs[OWN].sample
        known = [costs[one.label].sample for one in self._separate if one.label in costs]
        return self.first * (costs[OWN].sample + sum(known))

    def run(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        """Sample and estimate.

        Returns
        -------
        xarray.Dataset
            Estimates by output (`mean`, `mean_error`, `std`, `std_error`, `quantiles`, …), the `gain` over plain Monte
            Carlo, what each model costs and how it is correlated (`fidelity_…`), what was taken of each group
            (`group_…`), and what other methods are predicted to need (`alternative_solves`); see docs/results.md.
        """
        recorder = Recorder(evaluate)
        team = Fidelities(self.cheap, inputs, recorder, self.seed, controlled=self.control != "none")
        tangents = self.control == "auto" and evaluate.differentiable
        team.take(0 if self.reuse else PILOT, self.first, tangents=tangents)
        models = ByModels(team)
        told = list(useless(team, models.pilot))
        expansion = ByExpansion.of(team, models.pilot) if self.control == "auto" else None
        cost = self._left(team) if self.tolerance is None else models.needed(self.tolerance**2)
        cost = max(min(cost, self._left(team)), FEWEST)
        way: ByModels | ByExpansion | ByChoice = self._full_solves(team, models, cost)
        if expansion is not None and expansion.expected(cost) < BETTER * way.expected(cost):
            by_models, better = way.expected(cost), expansion.expected(cost)
            times = f"{by_models / better:.3g} times" if better > 0 else "infinitely"
            told.append(Finding("expansion-instead", "note", {"times": times}))
            way = expansion
            way.spend(max(FEWEST, min(cost, MOST_GROWTH * team.spent)))
        elif not self.reuse:
            way.spend(max(FEWEST, min(self._left(team), team.spent)))
        while True:
            reached, left = float(way.estimates.relative_error.max()), self._left(team)
            if self.met(reached) or left < max(1.0, LITTLE * team.spent):
                break
            cost = left
            if self.tolerance is not None:
                cost = min(left, max(way.needed(self.tolerance**2), MORE * team.spent))
            before = team.spent
            way.spend(min(cost, MOST_GROWTH * team.spent))
            if team.spent == before:  # what is left pays for no further sample
                break
        poor = self.budget_seconds is not None and self._left(team) < self.limit - team.spent
        count = sum(len(one.taken.points) for one in way.blocks())
        amount = f"{count} samples that cost {team.spent:.3g} solves"
        stopped = self.why_stopped(reached, f"relative error {reached:.3g}", 1 - int(poor), 1, amount)
        dataset = described(team, way, models, expansion)
        if self.quantiles:
            dataset = way.quantiles(self.quantiles).on(dataset, self.quantiles)
        add(dataset, *told, *way.doubts())
        dataset.attrs["stopped"] = stopped
        return dataset

    def _full_solves(self, team: Fidelities, models: ByModels, cost: float) -> ByModels | ByChoice:
        """Return how the study's model is asked: at even samples, or where two cheap models differ."""
        if len(self.cheap) == 1 or self.full_solves == "evenly":
            return models
        choice = ByChoice(team, models.pilot, known=self.control != "none")
        worth = choice.unseen * models.expected(cost)
        return choice if self.full_solves == "differences" or choice.expected(cost) <= worth else models

    def _left(self, team: Fidelities) -> float:
        """What may still be spent, in solves of the study's model."""
        return min(self.limit - team.spent, self.affordable(team.spent, team.evaluate.seconds))


def described(
    team: Fidelities, way: ByModels | ByExpansion | ByChoice, models: ByModels, expanded: ByExpansion | None
) -> xr.Dataset:
    """Return estimates, what was spent on what, and what other methods are predicted to need, as labelled arrays."""
    by_output, fidelity, group = ("output",), ("fidelity",), ("group",)
    estimates, pilot, blocks = way.estimates, models.pilot, way.blocks()
    dataset = local_dataset(team.inputs, team.evaluate, team.members[0].centre, fields=True)
    K, together = len(team.members), team.samples(PILOT if PILOT in team.taken else 0)
    centred = together.deviations[together.answered] - together.deviations[together.answered].mean(axis=0)
    inside = np.array([np.isin(np.arange(K), one.group) for one in blocks])
    sizes_of = np.array([len(one.taken.points) for one in blocks])
    dataset = dataset.assign_coords(fidelity=[one.label for one in team.members], group=np.arange(len(blocks)))
    dataset = dataset.assign(
        {
            **estimates.variables(),
            "fidelity_cost": (fidelity, np.array([one.cost for one in team.members])),
            "fidelity_samples": (fidelity, sizes_of @ inside),
            "fidelity_nominal": (("output", "fidelity"), np.array([m.centre.outputs for m in team.members]).T),
            "fidelity_correlation": (("output", "fidelity"), correlations(np.einsum("nkm,nlm->mkl", centred, centred))),
            "fidelity_remainder_correlation": (("output", "fidelity"), correlations(pilot.covariance)),
            "group_models": (("group", "fidelity"), inside),
            "group_pilot": (group, np.array([one.pilot for one in blocks])),
            "group_chosen": (group, np.array([one.chosen for one in blocks])),
            "group_samples": (group, sizes_of),
            "group_failed": (group, np.array([int((~one.ok).sum()) for one in blocks])),
            "group_cost": (group, inside @ np.array([one.cost for one in team.members])),
            "spent": ((), team.spent),
            "points": (("sample", "parameter"), np.concatenate([one.taken.points for one in blocks])),
            "sample_group": (("sample",), np.repeat(np.arange(len(blocks)), sizes_of)),
            "fidelity_values": (("sample", "fidelity", "output"), np.concatenate([one.taken.values for one in blocks])),
            "ok": (("sample",), np.concatenate([one.ok for one in blocks])),
        }
    )
    for name, (worth, error) in zip(("gain", "std_gain"), way.gains(team.spent), strict=False):
        dataset = dataset.assign({name: (by_output, worth), f"{name}_error": (by_output, error)})
    squares = np.where(estimates.mean_error > 0, estimates.mean_error, np.nan) ** 2
    plain, with_tangent = way.plain
    others = {"monte-carlo": plain / squares}
    if team.controlled:
        others["sensitivity-monte-carlo"] = with_tangent / squares
    if expanded is not None:
        others["expansion"] = expanded.left**2 / squares + sizes_of[0]
    dataset = dataset.assign_coords(alternative=list(others))
    dataset = dataset.assign(alternative_solves=(("alternative", "output"), np.array(list(others.values()))))
    add(dataset, compared(others, team.spent, expanded_used=way is expanded))
    values = np.isfinite(dataset["fidelity_values"].to_numpy()).all(axis=2)
    asked = np.repeat(inside, sizes_of, axis=0)
    lost, filled = int((asked & ~values)[:, 0].sum()), int((asked & ~values)[:, 1:].any(axis=1).sum())
    told = []
    if lost:
        told.append(
            f"{lost} of {int(asked[:, 0].sum())} samples of the study's model have no answer; estimates are over "
            "the others, that is, conditional on it having one"
        )
    if filled:
        told.append(
            f"at {filled} samples a cheap model has no answer; its tangent stands for it, which causes no bias"
            if team.controlled
            else f"at {filled} samples a cheap model has no answer; its value at the mean stands for it, without bias"
        )
    if told:
        dataset.attrs["note"] = "; ".join(told)
    add(dataset, *rarely_failing(team, asked, values))
    return dataset


def rarely_failing(team: Fidelities, asked: NDArray[np.bool_], answered: NDArray[np.bool_]) -> Iterator[Finding]:
    """Find cheap models that fail at few of the samples of the study's model, which tell what is missed there.

    Parameters
    ----------
    team
        The models.
    asked, answered
        Which models were asked at each sample (n, K), and have an answer there.
    """
    for k, one in enumerate(team.members[1:], 1):
        failed = asked[:, k] & ~answered[:, k]
        few = int((failed & asked[:, 0]).sum())
        if failed.any() and few < KNOWN:
            lost, of = int(failed.sum()), int(asked[:, k].sum())
            yield Finding("cheap-model-fails", "warning", {"model": one.label, "lost": lost, "asked": of, "few": few})


def compared(others: dict[str, FloatArray], spent: float, *, expanded_used: bool) -> Finding:
    """Say what other methods are predicted to need for the errors that were reached."""
    words = {
        "monte-carlo": "plain Monte Carlo {} solves",
        "sensitivity-monte-carlo": "the tangent alone {}",
        "expansion": "an expansion of the pilot, corrected by further solves, {}",
    }
    needed = {name: float(np.nanmax(found, initial=0.0)) for name, found in others.items()}
    told = ", ".join(words[name].format(f"{number:,.0f}") for name, number in needed.items())
    values = {"spent": spent, "needed": told}
    least = min(needed, key=lambda name: needed[name])
    if needed[least] < spent and not expanded_used:
        instead = "quasi-monte-carlo with control = 'chaos'" if least == "expansion" else least
        return Finding("fidelities-not-worth", "note", values | {"instead": instead})
    return Finding("fidelities-expansion-taken" if expanded_used else "fidelities-compared", "note", values)


def useless(team: Fidelities, found: Found) -> Iterator[Finding]:
    """Find cheap models that do not follow the model of the study."""
    squares = correlations(found.covariance) ** 2
    for k, one in enumerate(team.members[1:], 1):
        if (squares[:, k] <= UNRELATED).all():
            beside = "what the tangents leave of it" if team.controlled else "it"
            values = {"model": one.label, "beside": beside, "square": squares[:, k].max()}
            yield Finding("cheap-model-useless", "note", values)
