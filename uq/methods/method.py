"""What a study asks of a method: the base of every block `[method]` that solves at points, and the list of kinds.

Your own kind is a subclass in a module beside the study or in an installed package (`forward.registry`).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field, model_validator

from forward.registry import Kinds
from forward.scalars import Mistake
from forward.settings import Settings
from uq.evaluation.request import OWN, Evaluate

if TYPE_CHECKING:
    import xarray as xr

    from forward.spec import ModelSpec, Times
    from uq.accuracy.goal import Goal
    from uq.inputs.random_parameters import Inputs

MESH = "mesh "  # how the names of models begin that are the same on finer meshes, of which a report has a table
UNASKED = "method.kind = 'automatic' needs a tolerance, expected accuracy.tolerance, such as 1e-3"
Probability = Annotated[float, Field(gt=0, lt=1)]
TEXTBOOK = 15  # ratio of the times of a solve from zero and a predicted one, at 10⁴ unknowns


class Method(Settings):
    """A method: random parameters and an evaluation of models in, a dataset out.

    Attributes
    ----------
    undecided
        What the planned solves are for, if they decide how many more there are; otherwise empty.
    in_turn
        Whether it takes draws of equal weight in turn (`Inputs.random`), and its errors are those of the draws too.
    """

    undecided: ClassVar[str] = ""
    in_turn: ClassVar[bool] = False

    if TYPE_CHECKING:  # a field of every kind

        @property
        def kind(self) -> str:
            """Its kind, as in the study."""

    @abstractmethod
    def run(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        """Solve, and estimate.

        Returns
        -------
        xarray.Dataset
            The variables of docs/results.md that the method provides.

        Raises
        ------
        SolveError
            If the model has no answer where the method needs one.
        ValueError
            If the method cannot take the parameters, or needs derivatives that the model does not have.
        """

    @property
    def aims(self) -> bool:
        """Whether it can stop as soon as errors are those of a goal: methods that have an `until` of their own."""
        return type(self).until is not Method.until

    def until(self, inputs: Inputs, evaluate: Evaluate, goal: Goal) -> xr.Dataset:
        """Solve and estimate as `run` does, until the errors of means and standard deviations are those of a goal.

        Where that takes more solves than the goal allows, or than the method, the results say what was reached.

        Raises
        ------
        ValueError
            If the method cannot stop at a goal; otherwise as `run`.
        """
        raise ValueError(f"method.kind = '{self.kind}' does not stop at a tolerance of all errors")

    @abstractmethod
    def planned(self, dimension: int) -> int:
        """Number of solves for so many parameters, with that at the mean; the largest, if it may end earlier."""

    @property
    def open_ended(self) -> bool:
        """Whether fewer solves than planned may be enough."""
        return False

    def models(self, spec: ModelSpec) -> dict[str, ModelSpec]:
        """Return the models that it solves besides that of the study, by the names for `Evaluate.on`.

        Raises
        ------
        ModelError, pydantic.ValidationError
            If one of them is impossible.
        """
        return {}

    def objection(self, inputs: Inputs) -> str | None:
        """Say why these parameters do not allow it, or None if they do."""
        return None

    def unfit(self, spec: ModelSpec) -> Iterator[Mistake]:
        """Find what the method needs and the model lacks."""
        yield from ()

    def mistakes(self, inputs: Inputs, spec: ModelSpec) -> Iterator[Mistake]:
        """Find what in the method does not fit the parameters and the outputs."""
        objection = self.objection(inputs)
        if objection is not None:
            given = [{"between": (a, b), "value": value} for a, b, value in inputs.correlations]
            yield (("correlations",), objection, given) if given else (("method", "kind"), objection, self.kind)

    def with_sources(self, read: Callable[[str], xr.Dataset]) -> Self:
        """Return the method with the results of other studies that it names, once they are read."""
        return self

    def with_tangents(self, samples: int) -> int:
        """Of so many samples, the number whose derivatives are needed too."""
        return 0

    def seconds(self, dimension: int, costs: Mapping[str, Times]) -> float:
        """Predict the processor time (s) after the first solves, from the costs of the models by name."""
        own, samples = costs[OWN], self.planned(dimension) - 1
        return samples * own.sample + self.with_tangents(samples) * own.tangents_of_sample(dimension)

    def stream(self) -> tuple[Any, ...] | None:
        """Name the sequence of points that it uses, for methods that share it; None if the points are its own."""
        return None


def refuse(objection: str | None) -> None:
    """Raise a ValueError that says an objection, if there is one."""
    if objection is not None:
        raise ValueError(objection)


# Those that estimate moments from a number of samples.
SAMPLING = {
    "monte-carlo": "uq.methods.monte_carlo:MonteCarlo",
    "sensitivity-monte-carlo": "uq.methods.monte_carlo:SensitivityMonteCarlo",
    "quasi-monte-carlo": "uq.methods.quasi_monte_carlo:QuasiMonteCarlo",
    "chaos": "uq.methods.chaos:Chaos",
    "multilevel-chaos": "uq.methods.multilevel_chaos:MultilevelChaos",
    "multifidelity": "uq.methods.multifidelity:Multifidelity",
}


METHODS = Kinds(
    "method",
    {
        "automatic": "uq.methods.automatic:Automatic",
        **SAMPLING,
        "multilevel-monte-carlo": "uq.methods.multilevel:MultilevelMonteCarlo",
        "local-sensitivity": "uq.methods.local_sensitivity:LocalSensitivity",
        "sobol": "uq.methods.sobol:Sobol",
        "derivative-based": "uq.methods.derivative_based:DerivativeBased",
        "compare": "uq.methods.compare:Compare",
    },
    Method,
)


class Amount(Method):
    """The requested amount of sampling, at least one of the three.

    Parameters
    ----------
    samples
        Number of samples; with a tolerance or a budget, the largest number.
    tolerance
        Largest error, of a quantity that depends on the method.
    budget_seconds
        Processor time (s) of all solves together, on all ranks: no work is begun that would exceed it, judging by the
        solves so far. Solves that a restart finds on disk count with the time that they took.
    """

    samples: Annotated[int, Field(ge=2)] | None = None
    tolerance: Annotated[float, Field(gt=0)] | None = None
    budget_seconds: Annotated[float, Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _check_amount(self) -> Amount:
        self.check_amount()
        return self

    def check_amount(self) -> None:
        """Raise a ValueError if no amount is given."""
        if not self.asked:
            raise ValueError("gives neither samples nor tolerance nor budget_seconds, expected at least one of them")

    @property
    def asked(self) -> bool:
        """Whether any amount is given."""
        return self.samples is not None or self.open_ended

    @property
    def open_ended(self) -> bool:
        return self.tolerance is not None or self.budget_seconds is not None

    def met(self, reached: float) -> bool:
        """Whether a tolerance was requested and an error `reached` meets it."""
        return self.tolerance is not None and reached <= self.tolerance

    def affordable(self, solves: float, seconds: float) -> float:
        """Return the number of solves that the budget still allows, if they take as long as those `solves` did."""
        if self.budget_seconds is None or seconds == 0:
            return np.inf
        return max(0.0, solves * (self.budget_seconds / seconds - 1))

    def why_stopped(self, reached: float, error: str, count: int, limit: int, amount: str) -> str:
        """Say why sampling stopped.

        Parameters
        ----------
        reached, error
            The error that the tolerance is for, and the same in words.
        count, limit
            Number of samples, and the largest.
        amount
            The samples in words.
        """
        if self.met(reached):
            return f"tolerance {self.tolerance:g} met: {error} after {amount}"
        if count < limit:
            amount = f"{amount}, all that budget_seconds = {self.budget_seconds:g} pays for"
        elif self.tolerance is None:
            amount = f"{amount}, as asked"
        if self.tolerance is None:
            return f"{amount}: {error}"
        return f"tolerance {self.tolerance:g} not met: {error} after {'' if count < limit else 'all '}{amount}"


def seconds_per_solve(unknowns: int) -> float:
    """Weigh solves on nested meshes of so many unknowns against each other, in seconds.

    Methods choose numbers of samples by it: it depends only on the unknowns and stays fixed, so that results do too.
    The predictions of `check` are better (`forward.fem.cost`) and may improve further. Fitted to 0.011, 0.067 and 0.98
    s at 1 575, 9 963 and 70 227 unknowns (quadratic tetrahedra, a 2.8 GHz core; `python -m benchmarks realisation`).
    Inputs so wide that the prediction fails take several times as long.
    """
    return float(4e-3 + 1.2e-6 * unknowns**1.2)
