"""The method `design`: which observations to make, of those that could be made."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from forward.findings import Finding
from forward.model import FloatArray, ModelError, SolveError
from forward.settings import Settings
from inverse.criticism.assumptions import Assumptions
from inverse.data.measurements import Measurements
from inverse.designs.criteria import (
    Criterion,
    Discrimination,
    Information,
    IntArray,
    Variance,
    grouped,
    left_out,
    predicted,
    scaled,
    told_along,
)
from inverse.designs.greedy import Candidates, Choice, Each, choose, compared, kinds, matching, with_values
from inverse.methods.synthesize import SyntheticNoise
from uq.evaluation.request import Evaluate, Request
from uq.findings import add
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points

if TYPE_CHECKING:
    import xarray as xr

LEAST = 4  # draws of a model whose predictions have moments
LITTLE = 0.02  # of what all chosen ones tell: then the next ones repeat what is known
ALIKE = 0.8  # of what is best for a draw alone, that observations for all draws should tell
MISSED = 0.05  # of what chosen ones tell: what may be left out without a word


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
        predictions, as the sum of their variances over the prior ones (A-optimal); or which of several models is true
        (`candidates` of the study), by the expected ln Bayes factor against the others.
    goals
        Names of values that are not measured but predicted, such as ``"surgery.force"``; * stands for any letters.
    noise
        Errors of all values. Relative ones are so to the root mean square of the displacements of the load case, or of
        an output, over the draws.
    noises
        Errors of some values by their names, where * stands for any letters; the last that fits counts.
    costs
        Costs of candidates by their names, in the same way.
    mesh_error
        What the error of the mesh, estimated at the medians or for a field at the first draw, does: "report" says where
        it exceeds the noise; "noise" counts it as noise too; false: it is not looked at.
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
    criterion: Literal["information", "parameters", "predictions", "models"] = "information"
    goals: tuple[str, ...] = ()
    noise: SyntheticNoise
    noises: dict[str, SyntheticNoise] = Field(default={})
    costs: dict[str, Annotated[float, Field(gt=0)]] = Field(default={})
    mesh_error: Literal["report", "noise", False] = "report"
    draws: Annotated[int, Field(ge=1)] = 16
    random: Annotated[int, Field(ge=2)] = 64
    rank: Annotated[int, Field(ge=1)] = 200
    seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _check(self) -> Design:
        if self.number is None and self.budget is None:
            raise ValueError("expected number, how many observations, or budget, what they may cost")
        if (self.criterion == "predictions") != bool(self.goals):
            wanted = "the names of values that are predicted" if not self.goals else "criterion = 'predictions'"
            raise ValueError(f"criterion = '{self.criterion}' with goals = {list(self.goals)}, expected {wanted}")
        return self

    @property
    def wanted(self) -> str:
        """How much is chosen, in words."""
        limits = [f"{self.number} observations"] if self.number is not None else []
        limits += [f"a budget of {self.budget:g}"] if self.budget is not None else []
        return f"{', '.join(limits)}; one is a {self.each}"

    def run(
        self,
        inputs: Inputs,
        evaluate: Evaluate,
        values: Measurements,
        of_mesh: Evaluate | None = None,
        assumed: Assumptions | None = None,
    ) -> xr.Dataset:
        """Linearise the model, which must have derivatives, at draws of the unknowns, and choose among its outputs.

        The same model estimates the error of its mesh; None if it has none. What is uncertain of what is taken for
        granted is unknown too, but nothing is asked of it. Raises `ModelError` if there are fewer candidates than asked
        for, or names that fit none, and `SolveError` if the model has an answer at none of the draws.
        """
        candidates, goals = self.candidates(values)
        points, slopes = inputs.whitened(self.uniforms(len(inputs.names)))
        found = evaluate(Request(points, tangents=True))
        ok = found.ok
        if not ok.any():
            raise SolveError(f"the model has no answer at any of the {len(ok)} draws: {found.failures[0].reason}")
        assert found.tangents is not None
        mesh = self._mesh_errors(inputs, of_mesh) if self.mesh_error and of_mesh is not None else None
        sigma = self._with_mesh(self.sigma(values, found.outputs[ok]), mesh)
        errors = np.zeros((ok.sum(), 0, len(values))) if assumed is None else assumed.errors(points[ok], None, ~goals)
        beside, slopes = errors.shape[1], slopes[ok]
        whitened = np.concatenate([found.tangents[ok] @ slopes, errors.swapaxes(1, 2)], axis=2)  # (draws, m, d + g)
        slopes = np.pad(slopes, ((0, 0), (0, 0), (0, beside)))
        rows = [grouped(one / sigma[:, None], candidates.which, len(candidates.names)) for one in whitened]
        asked = scaled(whitened[:, goals] if goals.any() else slopes)
        result = self.chosen(rows, asked, candidates, beside)
        spread, after = np.linalg.norm(slopes, axis=2), Information(rows)  # prior standard deviations (draws, d)
        for one in result["chosen"].to_numpy().tolist():
            after.take(one)
        left = [np.linalg.norm(slope @ root, axis=1) for slope, root in zip(slopes, after.roots, strict=True)]
        result = result.assign(
            prior_std=("parameter", spread.mean(axis=0)),
            posterior_std=("parameter", np.mean(left, axis=0)),
            draw=(("draw_number", "parameter"), points[ok]),
        ).assign_coords(parameter=list(inputs.names))
        return with_values(result, values, sigma, candidates, mesh, noise=self.mesh_error == "noise")

    def _mesh_errors(self, inputs: Inputs, of_mesh: Evaluate) -> FloatArray | None:
        """Estimate what the mesh takes away from all values (m,) at the medians; None where nothing tells."""
        middle = inputs.points(np.full((1, len(inputs.names)), 0.5))
        found = of_mesh(Request(middle, mesh_errors=True))
        return None if found.failures or found.mesh_errors is None else found.mesh_errors[0]

    def _with_mesh(self, sigma: FloatArray, mesh: FloatArray | None) -> FloatArray:
        """Count errors of the mesh (m,) as noise too, if that is asked for."""
        return sigma if mesh is None or self.mesh_error != "noise" else np.hypot(sigma, np.nan_to_num(mesh))

    def of_fields(self, draws: Sequence[xr.Dataset], values: Measurements, beside: int) -> xr.Dataset:
        """Choose, for a field of many values that was linearised at draws (`inverse.designs.criteria`).

        The last directions, as many as are `beside`, are none of the field. Raises `ModelError` as `run`.
        """
        candidates, _ = self.candidates(values)
        mesh = next((one["mesh_error"].to_numpy() for one in draws if "mesh_error" in one), None)
        sigma = self._with_mesh(self.sigma(values, np.array([one["output"].to_numpy() for one in draws])), mesh)
        rows = [one["row"].to_numpy() * (one["sigma"].to_numpy() / sigma)[:, None] for one in draws]
        goals = of_field = [one["field_goal"].to_numpy() for one in draws]
        if self.criterion == "predictions":
            goals = [row.T @ row / len(row) for row in (one["goal_row"].to_numpy() for one in draws)]
        told = [grouped(one, candidates.which, len(candidates.names)) for one in rows]
        result = self.chosen(told, goals, candidates, beside)
        taken = Variance(told, of_field)
        share = list(taken.along(result["chosen"].to_numpy().tolist()))
        chosen = np.isin(candidates.which, result["chosen"].to_numpy())
        scale = [one["sigma"].to_numpy()[chosen] / sigma[chosen] for one in draws]
        beyond = [one["beyond"].to_numpy()[:, chosen] * factor for one, factor in zip(draws, scale, strict=True)]
        missed = float(np.mean([left_out(row[chosen], more) for row, more in zip(rows, beyond, strict=True)]))
        result = result.assign(field_variance_told=("choice", share), left_out=missed)
        known = float(result["information"][-1])
        if missed > MISSED * known:
            add(result, Finding("design-rank", "warning", {"missed": missed, "rank": self.rank, "known": known}))
        return with_values(result, values, sigma, candidates, mesh, noise=self.mesh_error == "noise")

    def whitened(self, number: int, size: int) -> FloatArray:
        """Draw `number` (size,) of standard normal numbers, for a field; a single one is at the median."""
        if self.draws == 1:
            return np.zeros(size)
        return np.random.default_rng([self.seed, 1, number]).standard_normal(size)

    def uniforms(self, d: int) -> FloatArray:
        """Points (draws, d) of the unit cube."""
        return np.full((1, d), 0.5) if self.draws == 1 else sobol_points(self.seed, 0, 0, self.draws, d)

    def candidates(self, values: Measurements) -> tuple[Candidates, NDArray[np.bool_]]:
        """Return the candidates, and which values (m,) are goals; raises `ModelError` as `run`."""
        for name, message, _ in self.mistakes(values):
            raise ModelError(f"method.{name}: {message}")
        goals = self._goals(values)
        return Candidates.of(values, self.each, goals).costing(self.costs), goals

    def mistakes(self, values: Measurements) -> Iterator[tuple[str, str, object]]:
        """Find what asks for more than values (m,) have, or for names that fit none: the key, why, what is given."""
        for key, patterns in (("goals", self.goals), ("noises", tuple(self.noises))):
            for pattern in patterns:
                if not matching(values.labels, pattern).any():
                    known = ", ".join(values.labels[:3])
                    yield key, f"'{pattern}' is the name of no value of the model, such as {known}", pattern
        found = Candidates.of(values, self.each, self._goals(values))
        most = len(found.names)
        if self.number is not None and self.number > most:
            yield "number", f"more than there are candidates, expected at most {most}", self.number
        elif not most:
            yield "goals", "nothing is left to be measured, expected values that are not predicted", list(self.goals)
        try:
            costs = found.costing(self.costs).costs
        except ValueError as error:
            yield "costs", str(error), self.costs
            return
        if self.budget is not None and most and costs.min() > self.budget:
            yield "budget", f"expected at least the cost of the cheapest candidate, {costs.min():g}", self.budget

    def _goals(self, values: Measurements) -> NDArray[np.bool_]:
        """Which values (m,) are predicted."""
        some = [matching(values.labels, pattern) for pattern in self.goals]
        return np.asarray(np.any([np.zeros(len(values), dtype=bool), *some], axis=0))

    def sigma(self, values: Measurements, outputs: FloatArray) -> FloatArray:
        """Return standard deviations (m,) of errors, given outputs (draws, m).

        Raises `ModelError` if errors are relative to values that are all zero.
        """
        noises = [self.noise] * len(values)
        for pattern, noise in self.noises.items():
            for k in np.flatnonzero(matching(values.labels, pattern)):
                noises[k] = noise
        which = np.unique([str(kind) for kind in kinds(values)], return_inverse=True)[1].ravel()
        squares = (outputs**2).mean(axis=0)
        sizes = np.sqrt((np.bincount(which, squares) / np.bincount(which))[which])
        pairs = zip(noises, sizes, strict=True)
        found = np.array([size * one.relative if one.relative is not None else one.absolute for one, size in pairs])
        if not (found > 0).all():
            name = values.labels[int(np.argmin(found))]
            raise ModelError(f"errors relative to {name}, which is zero at all draws, expected absolute ones")
        return found

    def run_models(
        self,
        inputs: Mapping[str, Inputs],
        weights: Mapping[str, float],
        models: Mapping[str, Evaluate],
        values: Measurements,
        assumed: Mapping[str, Assumptions],
    ) -> xr.Dataset:
        """Choose the observations, of values that are the outputs of all models, that tell these apart.

        By the name of each model are given its unknowns, its probability before, up to a common factor, and what it
        takes for granted, of those of which something is uncertain. Raises `ModelError` or `SolveError` as `run`.
        """
        candidates, _ = self.candidates(values)
        outputs, errors, lost = {}, dict[str, FloatArray](), []
        for name, one in inputs.items():
            uniforms = sobol_points(self.seed, 0, 0, self.draws, len(one.names))
            points = one.points(uniforms)
            found = models[name](Request(points))
            if found.ok.sum() < LEAST:
                reason = f": {found.failures[0].reason}" if found.failures else ""
                message = f"{name} has an answer at {found.ok.sum()} of {self.draws} draws, expected {LEAST}{reason}"
                raise SolveError(message)
            lost += [f"{len(found.failures)} of {name}"] if found.failures else []
            outputs[name] = found.outputs[found.ok]
            if name in assumed:
                errors[name] = assumed[name].errors(points[found.ok], None)
        sigma = self.sigma(values, np.concatenate(list(outputs.values())))
        each = (predicted(one, sigma, errors.get(name)) for name, one in outputs.items())
        means, roots = zip(*each, strict=True)
        parts = (means, roots, [weights[name] for name in inputs], candidates.which, len(candidates.names))
        choice, result = self._compared(lambda: Discrimination(*parts), candidates)
        after = Discrimination(*parts)
        for number in choice.order:
            after.take(number)
        result = result.assign(
            gain=("choice", np.array(choice.gains)),
            information=result["worth"],
            candidate_information=("candidate", Discrimination(*parts).gains(np.arange(len(candidates.costs)))),
            log_bayes_factor=(("model", "other"), after.pairs()),
        ).assign_coords(model=list(inputs), other=list(inputs))
        if lost:
            told = {"draws": self.draws, "lost": ", ".join(lost)}
            add(result, Finding("design-no-answer-of-models", "warning", told))
        few = [name for name, one in inputs.items() if len(outputs[name]) < 4 * (len(one.names) + 1)]
        if few:
            least = 4 * (max(len(inputs[name].names) for name in few) + 1)
            add(result, Finding("design-few-draws", "warning", {"models": ", ".join(few), "least": least}))
        return with_values(result, values, sigma, candidates)

    def chosen(
        self, rows: Sequence[FloatArray], goals: Sequence[FloatArray], candidates: Candidates, beside: int
    ) -> xr.Dataset:
        """Choose among c candidates, and compare with random choices.

        Of each draw are given rows (c, k, r) over the standard deviations of the errors, and GᵀG (r, r) of goals with
        prior variances that add up to one; the last unknowns, as many as are `beside`, do not count.
        """

        def told(order: IntArray) -> FloatArray:
            return np.array([told_along(one[order], beside) for one in rows])

        make = partial(Information, beside=beside)
        if self.criterion == "information":
            choice, found = self._compared(partial(make, rows), candidates, lambda order: told(order).mean(axis=0))
        else:
            choice, found = self._compared(partial(Variance, rows, goals), candidates)
        known = told(np.array(choice.order))
        alone = make(rows).gains(np.arange(len(candidates.costs)))
        found = found.assign(
            gain=("choice", np.diff(np.concatenate([[0.0], known.mean(axis=0)]))),
            information=("choice", known.mean(axis=0)),
            information_of_draw=(("draw_number", "choice"), known),
            candidate_information=("candidate", alone),
        )
        add(found, *self._doubts([partial(make, [one]) for one in rows], choice, found))
        return found

    def _compared(
        self,
        make: Callable[[], Criterion],
        candidates: Candidates,
        worth_along: Callable[[IntArray], FloatArray] | None = None,
    ) -> tuple[Choice, xr.Dataset]:
        """Choose by a criterion, and compare with random choices as `inverse.designs.greedy` does."""
        choice = choose(make, candidates.costs, number=self.number, budget=self.budget)
        short = worth_along or (lambda order: np.array(list(make().along(order.tolist()))))
        return choice, compared(choice, candidates, short, self.random, self.seed)

    def _doubts(self, alone: Sequence[Callable[[], Criterion]], choice: Choice, found: xr.Dataset) -> list[Finding]:
        """Say where draws, each with its own criterion, disagree, and where observations add little."""
        doubts = []
        lost = self.draws - len(alone)
        if lost:
            doubts.append(Finding("design-no-answer", "warning", {"lost": lost, "draws": self.draws}))
        gain, n = found["gain"].to_numpy(), len(choice.order)
        little = np.flatnonzero(gain < LITTLE * gain.sum() / n)
        if len(little) and n > 1:
            values = {"first": little[0] + 1, "n": n, "least": LITTLE * gain.sum() / n}
            doubts.append(Finding("design-repeats", "note", values))
        if self.criterion == "information" and len(alone) > 1:
            shared = found["information_of_draw"].to_numpy()[:, -1]
            costs = found["candidate_cost"].to_numpy()
            own = [choose(make, costs, number=self.number, budget=self.budget).worth for make in alone]
            shares = shared / np.maximum(own, shared)
            worst = int(shares.argmin())
            if shares[worst] < ALIKE:
                values = {"draws": len(own), "shared": shared[worst], "own": own[worst]}
                doubts.append(Finding("design-depends", "warning", values))
        return doubts
