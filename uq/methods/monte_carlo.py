"""Monte Carlo, plain and with sensitivity derivatives, for outputs and for the whole displacement field."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from forward.model import FloatArray, ForwardModel, ModelError, Solution, SolveError, scattered
from uq.estimators.doubts import of_control, of_field_tails, of_tails
from uq.estimators.estimate import Variables, of_samples
from uq.estimators.moments import (
    POWERS,
    Coefficient,
    Estimates,
    Moments,
    SecondMoment,
    estimate,
    estimate_from_samples,
    monomials,
    plain_moments,
)
from uq.estimators.quantiles import quantiles
from uq.estimators.tails import counted, influences
from uq.evaluation.block import merge
from uq.evaluation.evaluate import Recorder
from uq.evaluation.request import Evaluate, Evaluations, FieldSum, Request
from uq.findings import add
from uq.inputs.coordinates import Coordinates
from uq.inputs.random_parameters import Inputs
from uq.methods.method import Amount, Probability
from uq.surrogates.linearisation import Linearisation, linearise, local_dataset

if TYPE_CHECKING:
    import xarray as xr

    from uq.accuracy.goal import Goal

FIRST_ROUND = 64  # samples before a tolerance or a budget is first checked
MOST_GROWTH = 4.0  # growth of the number of samples between checks
FEW = 512  # samples, for fewer of which no better prediction is worth its making
UNLIMITED = 100_000  # samples that a tolerance or a budget may take if no limit is given


class MonteCarlo(Amount):
    """Plain Monte Carlo.

    Parameters
    ----------
    samples, budget_seconds
        As in `Amount`.
    tolerance
        Stop when the standard error of every mean is below this fraction of the mean (of the standard deviation,
        where the mean is smaller than that).
    seed
        Seed of the random points; sample z of a seed is the same in every study.
    quantiles
        Probabilities of the quantiles of the outputs. One with less than one sample beyond it has no end there.
    fields
        Whether mean and standard deviation of the displacement field are computed at each node.
    """

    in_turn: ClassVar[bool] = True
    kind: Literal["monte-carlo"] = "monte-carlo"
    seed: Annotated[int, Field(ge=0)] = 0
    quantiles: tuple[Probability, ...] = (0.05, 0.5, 0.95)
    fields: bool = True

    @property
    def limit(self) -> int:
        """Number of samples; the largest, if a tolerance may end the study earlier."""
        return self.samples or UNLIMITED

    def planned(self, dimension: int) -> int:
        return 1 + self.limit

    def stream(self) -> tuple[Any, ...] | None:
        return ("random",)

    def run(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        """Sample and estimate.

        Returns
        -------
        xarray.Dataset
            Estimates by output (`mean`, `mean_error`, `std`, `std_error`, `quantiles`, …) and, with `fields`, by node
            and component (`field_mean`, …); samples (`points`, `values`, `ok`); see docs/results.md.
        """
        return self.until(inputs, evaluate, None)

    @property
    def _control(self) -> tuple[Coefficient, SecondMoment] | None:
        """How the tangent at the mean parameters controls both moments, if it does."""
        return None

    def until(self, inputs: Inputs, evaluate: Evaluate, goal: Goal | None) -> xr.Dataset:
        """Sample until errors are those of a goal, or as much as is asked for; results and errors as in `run`."""
        control = self._control
        if control is not None and not evaluate.differentiable:
            raise ModelError(f"the model has no derivatives, expected one that has for method.kind = '{self.kind}'")
        evaluate = Recorder(evaluate)
        centre = linearise(inputs, evaluate)
        slopes = centre.state_slopes if control and len(centre.slopes) else None
        state = centre.state if slopes is None else centre.state_middle
        fields = _JointMoments(centre.coordinates, state, slopes) if self.fields and centre.state.size else None
        rounds: list[Evaluations] = []
        growing = grown(inputs, evaluate, centre, self.limit) if fields is not None else evaluate
        limit = self.limit if goal is None else min(self.limit, goal.most - 1)
        tolerance = self.tolerance if goal is None else 1.0
        target = min(limit, FIRST_ROUND) if self.open_ended or goal is not None else limit
        count = 0
        while True:
            points = inputs.random(self.seed, count, target)
            rounds.append(growing(Request(points, fields=fields, start=centre.prediction)))
            count = target
            evaluations = merge(rounds)
            scalars = _scalar_moments(evaluations, inputs, centre, control)
            reached = float(scalars.relative_error.max()) if goal is None else goal.reached(scalars.named)
            growth = MOST_GROWTH
            if tolerance is not None:
                growth = min(MOST_GROWTH, max(1.5 if goal is None else 1.1, 1.1 * (reached / tolerance) ** 2))
            paid = count + self.affordable(evaluate.solves, evaluate.seconds)
            target = int(min(limit, int(count * growth) + 1, paid))
            if (tolerance is not None and reached <= tolerance) or target <= count:
                break
        amount, error = f"{count} samples", f"relative error {float(scalars.relative_error.max()):.3g}"
        stopped = f"{amount}: {error}" if goal else self.why_stopped(reached, error, count, limit, amount)
        return self._results(inputs, evaluate, centre, evaluations, scalars, stopped)

    def _field_moments(self, evaluations: Evaluations, inputs: Inputs, centre: Linearisation) -> Moments:
        n, control = int(evaluations.ok.sum()), self._control
        if control is None or len(centre.slopes) == 0:
            return estimate(evaluations.fields, n, centre.state)
        slopes = centre.state_slopes
        variance = np.einsum("iu,ij,ju->u", slopes, inputs.correlation, slopes)
        return estimate(evaluations.fields, n, centre.state_middle, variance, *control)

    def _results(
        self,
        inputs: Inputs,
        evaluate: Evaluate,
        centre: Linearisation,
        evaluations: Evaluations,
        scalars: Moments,
        stopped: str,
    ) -> xr.Dataset:
        control, ok = self._control, evaluations.ok
        of_quantiles = quantiles(evaluations.outputs[ok], self.quantiles)
        dataset = local_dataset(inputs, evaluate, centre, fields=self.fields)
        dataset = of_quantiles.on(dataset, self.quantiles).assign(
            {
                **scalars.variables(),
                **of_samples(evaluations.points, evaluations.outputs, ok),
            }
        )
        if control is not None:
            plain = _scalar_moments(evaluations, inputs, centre, None)
            dataset = dataset.assign(
                {
                    **scalars.variables("variance_ratio", "std_variance_ratio", "coefficient"),
                    **{f"plain_{name}": found for name, found in plain.variables().items()},
                }
            )
        if evaluations.fields.size:
            field, count = self._field_moments(evaluations, inputs, centre), evaluate.displacements
            dataset = dataset.assign(by_node(field, count))
            powers = evaluations.fields if len(evaluations.fields) == len(POWERS) else evaluations.fields[POWERS]
            relative, volumes = field.relative_std_error[:count], evaluate.node_volumes
            add(dataset, *of_field_tails(powers[:, :count], int(ok.sum()), relative, volumes))
        dataset.attrs["stopped"] = stopped
        values, moved = evaluations.outputs[ok], None
        if control is not None:
            if control[1] == "quadratic":
                add(dataset, *of_control(evaluate.outputs, "tangent", scalars))
            moved = influences(*_controlled(evaluations, centre, scalars))
        add(dataset, *of_tails(evaluate.outputs, values, scalars.relative_std_error, moved))
        if not ok.all():
            which = "plain estimates" if control else "all estimates"
            dataset.attrs["note"] = failure_note(ok, which, "the tangent" if control else None)
        return dataset


class SensitivityMonteCarlo(MonteCarlo):
    """Monte Carlo with sensitivity derivatives: the tangent at the mean parameters is the control variate.

    Results are those of `MonteCarlo`, and `variance_ratio`.

    Parameters
    ----------
    coefficient
        "one", or "optimal": β = Cov(ψ, L)/Var L estimated on the samples that it corrects, which has a bias of order
        1/n. Errors of outputs count what the fit hides: on a product of three functions 95 % intervals of the standard
        deviation cover 90, 93, 94 and 96 % with 32, 64, 128 and 256 samples. Those of fields do not (83 to 94 %).
    second_moment
        "quadratic" controls it by the square of the tangent, "linear" is the published form.
    """

    in_turn: ClassVar[bool] = False  # the mean of the control is that of all draws
    kind: Literal["sensitivity-monte-carlo"] = "sensitivity-monte-carlo"  # type: ignore[assignment]
    coefficient: Coefficient = "one"
    second_moment: SecondMoment = "quadratic"

    @property
    def _control(self) -> tuple[Coefficient, SecondMoment]:
        return self.coefficient, self.second_moment


@dataclass(frozen=True)
class _JointMoments(FieldSum):
    """Sum of the monomials of the state's deviation and of its tangent prediction, which is linear in coordinates."""

    coordinates: Coordinates
    state: FloatArray
    slopes: FloatArray | None

    def on(self, model: ForwardModel) -> Callable[[Solution, FloatArray], FloatArray]:
        state = scattered(model, self.state[None, :])[0]
        slopes = None if self.slopes is None else scattered(model, self.slopes)

        def rows(solution: Solution, parameters: FloatArray) -> FloatArray:
            prediction = None if slopes is None else self.coordinates.of(parameters) @ slopes
            return monomials(solution.state - state, prediction)

        return rows


def grown(inputs: Inputs, evaluate: Evaluate, centre: Linearisation, planned: int) -> Evaluate:
    """Return an evaluation of `planned` samples whose predictions of the state grow; the same one if they are few."""
    if planned < FEW:
        return evaluate
    from uq.surrogates.growing import Growing

    return Growing(inputs, evaluate, centre, planned)


def _scalar_moments(
    evaluations: Evaluations, inputs: Inputs, centre: Linearisation, control: tuple[Coefficient, SecondMoment] | None
) -> Moments:
    ok = evaluations.ok
    n = int(ok.sum())
    if n < 2:
        raise SolveError(f"{n} of {len(ok)} samples have an answer, expected at least 2: {evaluations.why}")
    values = evaluations.outputs[ok]
    if control is None:
        return counted(plain_moments(values, centre.outputs), inputs, values)
    predictions, variance = centre.predicted(evaluations.points[ok]), centre.predicted_variance(inputs.correlation)
    found = estimate_from_samples(values - centre.middle, predictions, centre.middle, variance, *control)
    return counted(found, inputs, values, _controlled(evaluations, centre, found))


def _controlled(evaluations: Evaluations, centre: Linearisation, found: Estimates) -> tuple[FloatArray, FloatArray]:
    """Samples (n, m) of the first two moments that have an answer, with the tangent as control."""
    ok = evaluations.ok
    first = evaluations.outputs[ok] - centre.middle
    predicted = centre.predicted(evaluations.points[ok])
    return first - found.coefficient * predicted, first**2 - found.second_coefficient * predicted**2


def by_node(field: Estimates, displacements: int) -> Variables:
    """Return estimates of a state, whose first entries are displacements, as arrays by node and component."""
    return {
        f"field_{name}": (("node", "component"), values[:displacements].reshape(-1, 3))
        for name, values in field.named.items()
    }


def failure_note(ok: NDArray[np.bool_], which: str, followed: str | None) -> str:
    """Say what estimates mean if some samples have no answer.

    Parameters
    ----------
    ok
        Which samples have an answer, not all of them.
    which
        The estimates that use only answers.
    followed
        What samples without an answer are assumed to follow in controlled estimates, if there are any.
    """
    failed = int((~ok).sum())
    note = f"{failed} of {len(ok)} samples have no answer; {which} are over the {len(ok) - failed} others, that is, "
    note += "conditional on the model having an answer"
    if followed is not None:
        # The mean of the control is known over all samples, also those that failed.
        note += f"; controlled estimates assume that the failed ones follow {followed}, which their errors do not cover"
    return note
