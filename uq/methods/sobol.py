"""Sobol' indices of outputs and of the displacement field: from an expansion, exchanged samples or given data.

The formulas, and where they are from, are in `uq.estimators.indices`; exchanged samples come in the rows of
`uq.methods.sobol_rows`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from pydantic.json_schema import SkipJsonSchema

from forward.model import FloatArray, SolveError
from forward.settings import nearest
from uq.estimators.doubts import of_indices
from uq.estimators.indices import RowProducts, sobol_indices
from uq.evaluation.evaluate import Recorder
from uq.evaluation.request import Evaluate
from uq.findings import add
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import check_scrambles, power_of_two
from uq.methods.chaos import LARGEST, Chaos
from uq.methods.method import Amount, Probability, refuse
from uq.methods.monte_carlo import FIRST_ROUND, UNLIMITED
from uq.methods.sobol_rows import DIMENSIONS, RUNNING, Rows, by_output, by_round, with_maps
from uq.surrogates.least_squares import NOTHING
from uq.surrogates.linearisation import linearise
from uq.surrogates.regression import HIGHEST, Regression

if TYPE_CHECKING:
    import xarray as xr

    from forward.scalars import Mistake
    from forward.spec import ModelSpec

SAME = 1e-6  # largest relative difference of outputs of the same model at its mean parameters


class Sobol(Amount):
    """Sobol' indices: shares of the variance due to parameters alone, and with their interactions.

    Parameters
    ----------
    design
        "chaos": from an expansion fitted to values and gradients at few points. "saltelli": from exchanged scrambled
        Sobol' points, without assumptions on the model. "given-data": from the results of another study of the same
        model and parameters: from its expansion, or one fitted to its samples; no sample is solved.
    samples
        Number of solves ("chaos"), or of rows of solves ("saltelli"): `scrambles` times a power of two, each of d + 2
        solves, of one more for every group, and of d more for the second order; with a tolerance or a budget, the
        largest number.
    tolerance
        Stop when the leave-one-out error of every output is below this fraction of its standard deviation ("chaos"),
        or when the standard error of every index of first order and total is below it ("saltelli").
    budget_seconds
        As in `Amount`.
    second_order
        Whether second-order indices, of pairs of parameters, are estimated too.
    groups
        Named groups of parameters, whose indices are estimated too.
    source
        Directory of the results to take ("given-data"), beside the study or else in the working directory.
    scrambles
        Number of parts of one scrambled sequence ("saltelli"), whose scatter gives the claimed error, with R − 1
        degrees of freedom.
    max_order, gradients
        As in `Chaos`.
    seed
        Seed of the design; sample z of a seed is the same in every study with as many parameters.
    quantiles
        Probabilities of the quantiles of the outputs.
    fields
        Whether indices of the displacement field are computed: for the whole (weighted by the variance) and by node.
    """

    kind: Literal["sobol"] = "sobol"
    design: Literal["chaos", "saltelli", "given-data"] = "chaos"
    second_order: bool = False
    groups: dict[str, Annotated[tuple[str, ...], Field(min_length=1)]] = Field(default={})
    source: str | None = None
    scrambles: Annotated[int, Field(ge=4)] = 16
    max_order: Annotated[int, Field(ge=1, le=HIGHEST)] | None = None
    gradients: bool = True
    seed: Annotated[int, Field(ge=0)] = 0
    quantiles: tuple[Probability, ...] = (0.05, 0.5, 0.95)
    fields: bool = True
    results: SkipJsonSchema[Any] = Field(default=None, exclude=True, repr=False)  # those of `source`

    def check_amount(self) -> None:
        if self.design == "given-data":
            if self.source is None or self.asked:
                raise ValueError(
                    "expected source, the results to take, and neither samples nor tolerance nor budget_seconds with "
                    "design = 'given-data'"
                )
            return
        super().check_amount()
        if self.source is not None:
            raise ValueError(f"source = '{self.source}', expected design = 'given-data' with it")
        if self.design == "saltelli":
            check_scrambles(self.samples, self.scrambles)

    def with_sources(self, read: Callable[[str], xr.Dataset]) -> Self:
        return self if self.source is None else self.model_copy(update={"results": read(self.source)})

    def planned(self, dimension: int) -> int:
        if self.design == "given-data":
            return 1
        if self.design == "chaos":
            return 1 + (self.samples or LARGEST)
        size = RowProducts(dimension + len(self.groups), dimension if self.second_order else 0).size
        return 1 + size * (self.samples or self.scrambles * power_of_two(UNLIMITED // size // self.scrambles))

    def objection(self, inputs: Inputs) -> str | None:
        if len(inputs.joint) > 1:
            return (
                "parameters given by the same draws depend on each other and have no Sobol' indices, expected "
                "method.kind = 'chaos', which gives their Shapley effects"
            )
        if not inputs.independent:
            return "Sobol' indices need independent parameters, expected no correlations for method.kind = 'sobol'"
        return None

    def mistakes(self, inputs: Inputs, spec: ModelSpec) -> Iterator[Mistake]:
        yield from super().mistakes(inputs, spec)
        stranger = self.unknown(inputs)
        if stranger is not None:
            yield ("method", "groups"), stranger, self.model_dump()["groups"]

    def unknown(self, inputs: Inputs) -> str | None:
        """Say which member of a group is not a parameter, or None."""
        for group, names in self.groups.items():
            for name in names:
                if name not in inputs.names:
                    return f"'{name}' of group '{group}' is not a parameter of the study; {nearest(name, inputs.names)}"
        return None

    def run(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        """Solve at the points of the design, or take what is given, and estimate.

        Returns
        -------
        xarray.Dataset
            Indices by output with standard errors and, with `fields`, of the displacement field and by node; how they
            converged; moments; see docs/results.md.

        Raises
        ------
        FileNotFoundError
            If the source holds no results of this model and these parameters; otherwise as every method.
        """
        refuse(self.objection(inputs) or self.unknown(inputs))
        estimate = {"chaos": self._expand, "saltelli": self._exchange, "given-data": self._take}[self.design]
        dataset = estimate(inputs, evaluate)
        if self.groups:
            dataset = dataset.assign_coords(group=list(self.groups))
            dataset["group_members"] = (("group", "parameter"), self._members(inputs))
        if self.second_order:
            dataset = dataset.assign_coords(partner=list(inputs.names))
        return dataset

    def _members(self, inputs: Inputs) -> NDArray[np.bool_]:
        """Which parameters (groups, d) each group has."""
        found = [[p in names for p in inputs.names] for names in self.groups.values()]
        return np.array(found, dtype=bool).reshape(len(found), len(inputs.names))

    # --- from an expansion ---------------------------------------------------------------------------------------

    def _expand(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        method = Chaos.model_validate(self.model_dump(include=Chaos.model_fields.keys() - {"kind"}))
        expanded = method.expand(inputs, evaluate)
        dataset = method.reported(evaluate, expanded)
        return self._with_indices(dataset, inputs, expanded.regression, evaluate.node_volumes)

    def _with_indices(
        self, dataset: xr.Dataset, inputs: Inputs, regression: Regression, volumes: FloatArray | None
    ) -> xr.Dataset:
        """Add the indices from a regression, and from its first samples."""
        asked = partial(sobol_indices, members=self._members(inputs), pairs=self.second_order)
        found = regression.estimates(asked)
        dataset = dataset.assign(by_output(found))
        running = {}
        n = len(regression.data.points)
        for count in sorted({n // 8, n // 4, n // 2, n} - {0, 1}):
            try:
                running[count] = regression.first(count).estimates()
            except SolveError:
                continue  # too few for an expansion
        dataset = dataset.assign(by_round(running)).assign_coords(index_round=list(running))
        add(dataset, *regression.doubts(dataset["output"].to_numpy().tolist()), *of_indices(dataset))
        return with_maps(dataset, volumes) if self.fields else dataset

    # --- from given data -----------------------------------------------------------------------------------------

    def _take(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        if self.results is None:
            message = f"the results of {self.source} were not read, expected them in `results`: see `with_sources`"
            raise ValueError(message)
        source = checked(self.results, str(self.source), inputs, evaluate)
        centre = linearise(inputs, evaluate)
        theirs = source["nominal"].to_numpy()
        if not np.allclose(theirs, centre.outputs, rtol=SAME, atol=SAME * np.abs(theirs).max()):
            raise FileNotFoundError(
                f"{self.source}: holds results of another model (at the mean parameters {theirs.tolist()}, here "
                f"{centre.outputs.tolist()}), expected those of the model of this study"
            )
        dataset = source.drop_vars([name for name in ("node_position", "cell_nodes", "unit") if name in source])
        stopped = f"from the results of {Path(str(self.source)).name}: {source.attrs.get('stopped', 'samples')}"
        kept = {name: source.attrs[name] for name in ("note", "findings") if name in source.attrs}
        dataset.attrs = {"stopped": stopped, **kept}
        if not self.fields:
            dataset = dataset.drop_dims([dim for dim in ("node",) if dim in dataset.dims])
        if "multi_index" not in source:
            ok = source["ok"].to_numpy()
            points, values = source["points"].to_numpy()[ok], source["values"].to_numpy()[ok]
            regression = Regression.of(inputs, points, values, None, self.max_order)
            dataset = dataset.assign(loo_error=(("output",), regression.fit.relative))
            dataset.attrs["stopped"] += (
                f"; expanded to order {regression.fit.chosen.order}, {regression.fit.chosen.which.size} terms, "
                f"leave-one-out error {regression.fit.relative.max():.3g}"
            )
            return self._with_indices(dataset, inputs, regression, evaluate.node_volumes)
        coefficients, indices = source["coefficients"].to_numpy().T, source["multi_index"].to_numpy()
        found = sobol_indices(coefficients, indices, self._members(inputs), pairs=self.second_order)
        nothing = source["loo_error"].to_numpy() > NOTHING
        for name in set(found) & set(DIMENSIONS):
            # The samples' derivatives, which errors of other indices would need, are not kept.
            error = f"{name}_error"
            found[error] = source[error].to_numpy() if error in source else np.full_like(found[name], np.nan)
            found[name][nothing] = np.nan
        dataset = dataset.assign(by_output(found))
        return with_maps(dataset, evaluate.node_volumes) if self.fields else dataset

    # --- from exchanged samples ----------------------------------------------------------------------------------

    def _exchange(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        evaluate = Recorder(evaluate)
        centre = linearise(inputs, evaluate)
        members = np.vstack([np.eye(len(inputs.names), dtype=bool), self._members(inputs)])
        about = {"pairs": self.second_order, "fields": self.fields}
        rows = Rows(inputs, evaluate, centre, members, self.seed, self.scrambles, **about)
        K, R = rows.products.size, self.scrambles
        last = (self.planned(len(inputs.names)) - 1) // K // R
        rows.extend(min(last, power_of_two(FIRST_ROUND // R)) if self.open_ended else last)
        while True:
            found = rows.indices(rows.each)
            reached = max(float(found[f"{name}_error"].max()) for name in RUNNING)
            solves = K * R * rows.each
            if self.met(reached) or rows.each >= last or solves > self.affordable(evaluate.solves, evaluate.seconds):
                break
            rows.extend(2 * rows.each)
        dataset = rows.dataset(found, self.quantiles)
        add(dataset, *of_indices(dataset))
        amount = f"{R * rows.each} rows of {K} solves of Sobol' points"
        error = f"errors of the indices up to {reached:.2g}"
        dataset.attrs["stopped"] = self.why_stopped(reached, error, rows.each, last, amount)
        return dataset


def checked(source: xr.Dataset, directory: str, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
    """Return the results of another study, which must have the same parameters and outputs.

    Raises `FileNotFoundError` if they are of others.
    """
    import tomllib

    for what, expected in (("parameter", inputs.names), ("output", evaluate.outputs)):
        theirs = tuple(source[what].values)
        if theirs != expected:
            message = f"{directory}: holds results of {what}s {', '.join(theirs)}, expected {', '.join(expected)}"
            raise FileNotFoundError(message)
    if not ("multi_index" in source or "values" in source):
        message = f"{directory}: holds neither samples nor an expansion, expected results of chaos or of sampling"
        raise FileNotFoundError(message)
    ours = {name: marginal.model_dump(mode="json", exclude_none=True) for name, marginal in inputs.marginals.items()}
    written = tomllib.loads(source.attrs.get("config") or "").get("parameters", {})
    if not (
        np.allclose(source["parameter_mean"], inputs.mean, rtol=1e-10, atol=0)
        and np.allclose(source["parameter_std"], inputs.std, rtol=1e-10, atol=0)
        and all(ours[name] == value for name, value in written.items())  # coefficients of fields are not written
    ):
        raise FileNotFoundError(f"{directory}: holds results of other distributions, expected those of this study")
    return source
