"""The method `design`: which observations to make, of those that could be made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from forward.model import Finding, FloatArray, ModelError, SolveError
from forward.settings import Settings
from inverse.designs.candidates import Candidates, Each, Values
from inverse.designs.criteria import Criterion, Information, Variance, along, grouped, told_along
from inverse.designs.greedy import Choice, choose
from inverse.methods.synthesize import SyntheticNoise
from uq.evaluation.evaluate import Evaluate, Request
from uq.findings import add
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points

if TYPE_CHECKING:
    import xarray as xr

LITTLE = 0.02  # of what all chosen ones tell: then the next ones repeat what is known
FARTHER = 6  # times as many random observations as chosen ones
ALIKE = 0.8  # of what is best for a draw alone, that observations for all draws should tell
BAND = (0.05, 0.5, 0.95)
QUANTILES = ("lower", "median", "upper")


class Design(Settings):
    """Choose the observations that tell most, before they are made.

    The model is linearised at draws of the prior, or of a posterior that takes its place (`parameters.from`); what is
    chosen is best on average over them (`inverse.designs`).

    Parameters
    ----------
    number
        How many observations.
    budget
        What they may cost together; each costs 1 unless `costs` says otherwise.
    each
        What one observation is: all components at a point in a load case; a single value; a point in all load cases;
        all that is measured in a load case or at a step of a path; or an output, at all steps of a path.
    criterion
        What they should tell: as much as possible on all unknowns together (D-optimal, nat); the parameters, or
        predictions, as the sum of their variances over the prior ones (A-optimal).
    goals
        Names of values that are not measured but predicted, such as ``"surgery.force"``; * stands for any letters.
    noise
        Errors of all values. Relative ones are so to the root mean square of the displacements of the load case, or of
        an output, over the draws.
    noises
        Errors of some values by their names, where * stands for any letters; the last that fits counts.
    costs
        Costs of candidates by their names, in the same way.
    draws
        Draws at which the model is linearised; one is at the medians.
    random
        Random choices that the chosen ones are compared with.
    rank
        Largest number of directions of a field of nodal values that candidates tell.
    seed
        Of draws and random choices.
    """

    kind: Literal["design"] = "design"
    number: Annotated[int, Field(ge=1)] | None = None
    budget: Annotated[float, Field(gt=0)] | None = None
    each: Each = "point"
    criterion: Literal["information", "parameters", "predictions"] = "information"
    goals: tuple[str, ...] = ()
    noise: SyntheticNoise
    noises: dict[str, SyntheticNoise] = Field(default={})
    costs: dict[str, Annotated[float, Field(gt=0)]] = Field(default={})
    draws: Annotated[int, Field(ge=1)] = 16
    random: Annotated[int, Field(ge=2)] = 64
    rank: Annotated[int, Field(ge=1)] = 400
    seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _check(self) -> Design:
        if self.number is None and self.budget is None:
            raise ValueError("expected number, how many observations, or budget, what they may cost")
        if (self.criterion == "predictions") != bool(self.goals):
            wanted = "the names of values that are predicted" if not self.goals else "criterion = 'predictions'"
            message = f"criterion = '{self.criterion}' with goals = {list(self.goals)}, expected {wanted}"
            raise ValueError(message)
        return self

    def run(self, inputs: Inputs, evaluate: Evaluate, values: Values) -> xr.Dataset:
        """Linearise the model at draws, and choose.

        Parameters
        ----------
        inputs
            The unknowns, with their prior.
        evaluate
            The model; it must have derivatives.
        values
            What its outputs are.

        Raises
        ------
        ModelError
            If there are fewer candidates than asked for, or names that fit none.
        SolveError
            If the model has an answer at none of the draws.
        """
        candidates, goals, costs = self.candidates(values)
        points, slopes = inputs.whitened(self.uniforms(len(inputs.names)))
        found = evaluate(Request(points, tangents=True))
        ok = found.ok
        if not ok.any():
            message = f"the model has no answer at any of the {len(ok)} draws: {found.failures[0].reason}"
            raise SolveError(message)
        assert found.tangents is not None
        sigma = self.sigma(values, found.outputs[ok])
        whitened = found.tangents[ok] @ slopes[ok]  # (draws, m, d)
        told = Linearised(
            [grouped(one / sigma[:, None], candidates.which, len(candidates.names)) for one in whitened],
            _scaled(whitened[:, goals] if goals.any() else slopes[ok]),
        )
        result = self.chosen(told, candidates, costs)
        spread = np.linalg.norm(slopes[ok], axis=2)  # prior standard deviations (draws, d)
        pairs = zip(slopes[ok], told.roots(result), strict=True)
        left = [np.linalg.norm(slope @ root, axis=1) for slope, root in pairs]
        result = result.assign(
            prior_std=("parameter", spread.mean(axis=0)),
            posterior_std=("parameter", np.mean(left, axis=0)),
            draw=(("draw_number", "parameter"), points[ok]),
        ).assign_coords(parameter=list(inputs.names))
        return self.with_values(result, values, sigma, candidates)

    def of_fields(self, draws: Sequence[xr.Dataset], values: Values) -> xr.Dataset:
        """Choose, for a field of many values that was linearised at draws (`inverse.designs.fields`).

        Raises
        ------
        ModelError
            As `run`.
        """
        candidates, _, costs = self.candidates(values)
        sigma = self.sigma(values, np.array([one["output"].to_numpy() for one in draws]))
        rows = [one["row"].to_numpy() * (one["sigma"].to_numpy() / sigma)[:, None] for one in draws]
        goals = [one["field_goal"].to_numpy() for one in draws]
        if self.criterion == "predictions":
            goals = [row.T @ row / len(row) for row in (one["goal_row"].to_numpy() for one in draws)]
        told = Linearised([grouped(one, candidates.which, len(candidates.names)) for one in rows], goals)
        result = self.chosen(told, candidates, costs)
        taken = Variance(told.rows, [one["field_goal"].to_numpy() for one in draws])
        share = list(along(taken, result["chosen"].to_numpy().tolist()))
        neglected = max(float(one["neglected"]) for one in draws)
        result = result.assign(field_variance_told=("choice", share), neglected=neglected)
        if neglected > 1:
            text = (
                f"All candidates together tell more than the {self.rank} directions that are kept: of the next one the "
                f"data would be {np.sqrt(neglected):.2g} times as exact as the prior. Take a larger method.rank."
            )
            add(result, Finding("warning", text))
        return self.with_values(result, values, sigma, candidates)

    def whitened(self, number: int, size: int) -> FloatArray:
        """Draw `number` (size,) of standard normal numbers, for a field; a single one is at the median."""
        if self.draws == 1:
            return np.zeros(size)
        return np.random.default_rng([self.seed, 1, number]).standard_normal(size)

    def uniforms(self, d: int) -> FloatArray:
        """Points (draws, d) of the unit cube."""
        return np.full((1, d), 0.5) if self.draws == 1 else sobol_points(self.seed, 0, 0, self.draws, d)

    def candidates(self, values: Values) -> tuple[Candidates, NDArray[np.bool_], FloatArray]:
        """Return the candidates, which values (m,) are goals, and what candidates cost (c,).

        Raises
        ------
        ModelError
            As `run`.
        """
        goals = np.zeros(len(values.names), dtype=bool)
        for pattern in (*self.goals, *self.noises):
            mine = values.matching(pattern)
            if not mine.any():
                message = f"'{pattern}' is the name of no value of the model, such as {', '.join(values.names[:3])}"
                raise ModelError(message)
            goals |= mine & (pattern in self.goals)
        found = Candidates.of(values, self.each, goals)
        if len(found.names) < (self.number or 1):
            message = f"{len(found.names)} candidates, expected at least number = {self.number or 1}"
            raise ModelError(message)
        try:
            costs = found.numbers(self.costs)
        except ValueError as error:
            message = f"method.costs: {error}"
            raise ModelError(message) from None
        if self.budget is not None and costs.min() > self.budget:
            message = f"budget = {self.budget:g}, expected at least the cost of the cheapest candidate, {costs.min():g}"
            raise ModelError(message)
        return found, goals, costs

    def sigma(self, values: Values, outputs: FloatArray) -> FloatArray:
        """Return standard deviations (m,) of errors, given outputs (draws, m).

        Raises
        ------
        ModelError
            If errors are relative to values that are all zero.
        """
        noises = [self.noise] * len(values.names)
        for pattern, noise in self.noises.items():
            noises = [noise if mine else one for mine, one in zip(values.matching(pattern), noises, strict=True)]
        kinds = np.unique([str(kind) for kind in values.kinds], return_inverse=True)[1].ravel()
        squares = (outputs**2).mean(axis=0)
        sizes = np.sqrt((np.bincount(kinds, squares) / np.bincount(kinds))[kinds])
        pairs = zip(noises, sizes, strict=True)
        found = np.array([size * one.relative if one.relative is not None else one.absolute for one, size in pairs])
        if not (found > 0).all():
            name = values.names[int(np.argmin(found))]
            message = f"errors relative to {name}, which is zero at all draws, expected absolute ones"
            raise ModelError(message)
        return found

    def chosen(self, told: Linearised, candidates: Candidates, costs: FloatArray) -> xr.Dataset:
        """Choose among candidates (c,) with costs (c,), and compare with random choices."""
        import xarray as xr

        choice = choose(lambda: self._criterion(told), costs, number=self.number, budget=self.budget)
        order = np.array(choice.order)
        known = np.array([told_along(rows[order]) for rows in told.rows])  # (draws, n)
        gain = np.diff(np.concatenate([[0.0], known.mean(axis=0)]))
        worth = np.cumsum(choice.gains)
        random = self._random(told, len(order))
        alone = Information(told.rows).of_draws(np.arange(len(costs))).mean(axis=0)
        at_random = np.quantile(random, BAND, axis=0)
        counts = np.flatnonzero(at_random[1] >= worth[-1])
        found = xr.Dataset(
            {
                "chosen": ("choice", order),
                "gain": ("choice", gain),
                "information": ("choice", known.mean(axis=0)),
                "information_of_draw": (("draw_number", "choice"), known),
                "worth": ("choice", worth),
                "cost": ("choice", np.cumsum(costs[order])),
                **{f"random_{name}": ("random_number", line) for name, line in zip(QUANTILES, at_random, strict=True)},
                "random_equal": float(counts[0] + 1) if len(counts) else np.nan,
                "candidate_information": ("candidate", alone),
                "candidate_cost": ("candidate", costs),
                "candidate_place": (("candidate", "axis"), candidates.places),
                "candidate_case": ("candidate", list(candidates.cases)),
                "candidate_part": ("candidate", list(candidates.parts)),
                "looks": choice.looks,
            },
            {"candidate": list(candidates.names), "random_number": np.arange(1, at_random.shape[1] + 1)},
        )
        add(found, *self._doubts(told, choice, found))
        return found

    def _best(self, rows: FloatArray, costs: FloatArray) -> float:
        """What those observations tell that are best at one draw."""
        return choose(lambda: Information([rows]), costs, number=self.number, budget=self.budget).worth

    def _criterion(self, told: Linearised) -> Criterion:
        return Information(told.rows) if self.criterion == "information" else Variance(told.rows, told.goals)

    def _random(self, told: Linearised, n: int) -> FloatArray:
        """What random candidates are worth (random, most), the first, the first two, …, up to `FARTHER` times n."""
        count = len(told.rows[0])
        most = min(count, FARTHER * n)
        rng = np.random.default_rng([self.seed, 2])
        orders = [rng.permutation(count)[:most] for _ in range(self.random)]
        if self.criterion == "information":
            return np.array([np.mean([told_along(rows[order]) for rows in told.rows], axis=0) for order in orders])
        return np.array([list(along(self._criterion(told), order.tolist())) for order in orders])

    def with_values(self, found: xr.Dataset, values: Values, sigma: FloatArray, candidates: Candidates) -> xr.Dataset:
        """Add what the values of the candidates are."""
        return found.assign(
            value_candidate=("value", candidates.which),
            value_sigma=("value", sigma),
            value_place=(("value", "axis"), values.places),
            value_case=("value", list(values.case)),
            value_part=("value", list(values.part)),
        ).assign_coords(value=list(values.names))

    def _doubts(self, told: Linearised, choice: Choice, found: xr.Dataset) -> list[Finding]:
        """Say where draws disagree, and where observations add little."""
        doubts = []
        lost = self.draws - len(told.rows)
        if lost:
            text = f"The model has no answer at {lost} of {self.draws} draws, which are left out."
            doubts.append(Finding("warning", text))
        gain, n = found["gain"].to_numpy(), len(choice.order)
        little = np.flatnonzero(gain < LITTLE * gain.sum() / n)
        if len(little) and n > 1:
            text = (
                f"From observation {little[0] + 1} of {n} on, each adds less than "
                f"{LITTLE * gain.sum() / n:.2g} nat: they repeat what is known."
            )
            doubts.append(Finding("note", text))
        if self.criterion == "information" and len(told.rows) > 1:
            shared = found["information_of_draw"].to_numpy()[:, -1]
            costs = found["candidate_cost"].to_numpy()
            own = [self._best(rows, costs) for rows in told.rows]
            shares = shared / np.maximum(own, shared)
            worst = int(shares.argmin())
            if shares[worst] < ALIKE:
                text = (
                    f"What is best depends on the unknowns: at one of {len(own)} draws the chosen observations tell "
                    f"{shared[worst]:.3g} nat, those that are best there {own[worst]:.3g}. Measure some of them first, "
                    "and choose the others with that posterior (parameters.from)."
                )
                doubts.append(Finding("warning", text))
        return doubts


@dataclass(frozen=True, eq=False)
class Linearised:
    """Candidates and goals at draws.

    Attributes
    ----------
    rows
        (c, k, r) of each draw, over the standard deviations of the errors.
    goals
        GᵀG (r, r) of each draw, with prior variances that add up to one.
    """

    rows: Sequence[FloatArray]
    goals: Sequence[FloatArray]

    def roots(self, found: xr.Dataset) -> list[FloatArray]:
        """Return roots (r, r) of the covariances once all chosen observations were made, of each draw."""
        criterion = Information(self.rows)
        for one in found["chosen"].to_numpy():
            criterion.take(int(one))
        return criterion.roots


def _scaled(goals: FloatArray) -> list[FloatArray]:
    """Return GᵀG of goals (draws, q, d), each over its prior standard deviation and √q; constants count nothing."""
    size = np.linalg.norm(goals, axis=2, keepdims=True)
    scaled = np.divide(goals, size, out=np.zeros_like(goals), where=size > 0) / np.sqrt(goals.shape[1])
    return [one.T @ one for one in scaled]
