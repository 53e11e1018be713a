"""What a study asks of a method: the base of every block `[method]` that solves at points, and the list of kinds.

Your own kind is a subclass in a module beside the study or in an installed package (`forward.registry`).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Self

from forward.registry import Kinds
from forward.scalars import Mistake
from forward.settings import Settings
from uq.evaluation.request import OWN

if TYPE_CHECKING:
    import xarray as xr

    from forward.spec import ModelSpec, Times
    from uq.accuracy.goal import Goal
    from uq.evaluation.request import Evaluate
    from uq.inputs.random_parameters import Inputs

MESH = "mesh "  # how the names of models begin that are the same on finer meshes, of which a report has a table


class Method(Settings):
    """A method: random parameters and an evaluation of models in, a dataset out."""

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
        """Whether it can stop as soon as errors are those of a goal (`until`)."""
        return False

    def until(self, inputs: Inputs, evaluate: Evaluate, goal: Goal) -> xr.Dataset:
        """Solve and estimate as `run` does, until the errors of means and standard deviations are those of a goal.

        Where that takes more solves than the goal allows, or than the method, the results say what was reached.

        Raises
        ------
        ValueError
            If the method cannot stop at a goal; otherwise as `run`.
        """
        message = f"method.kind = '{self.kind}' does not stop at a tolerance of all errors"
        raise ValueError(message)

    @abstractmethod
    def planned(self, dimension: int) -> int:
        """Number of solves for so many parameters, with that at the mean; the largest, if it may end earlier."""

    @property
    def open_ended(self) -> bool:
        """Whether fewer solves than planned may be enough."""
        return False

    @property
    def undecided(self) -> str:
        """What the planned solves are for, if they decide how many more there are; otherwise empty."""
        return ""

    @property
    def in_turn(self) -> bool:
        """Whether it takes draws of equal weight in turn (`Inputs.random`)."""
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
