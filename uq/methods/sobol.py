"""Sobol' indices of outputs and of the displacement field: from an expansion, exchanged samples or given data.

The formulas, and where they are from, are in `uq.estimators.indices`. Exchanged samples (A. Saltelli et al., Comput.
Phys. Commun. 181 (2010) 259–270) come in rows of d + 2 solves; A and B are the halves of scrambled Sobol' points in 2d
dimensions. A row in which a solve failed is left out as a whole: with only some of its points, the differences that the
estimators average would be incomplete.

The rows belong to one scrambled Sobol' sequence: independent scrambles of a sixteenth of the rows each have two to four
times the error at a thousand rows. Errors come from resampling its R parts of consecutive rows, each a net by itself.
This ignores that the parts complement each other: it claims the error of R independent parts, which is no smaller.

The three designs share groups, fields and intervals, hence one file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from pydantic.json_schema import SkipJsonSchema

from forward.model import Finding, FloatArray, ForwardModel, SolveError, scattered
from forward.settings import nearest
from uq.estimators.doubts import of_field_tails, of_indices, of_tails
from uq.estimators.indices import (
    Analysis,
    ExchangedVariances,
    RowProducts,
    bootstrap,
    bootstrap_error,
    coefficient_moments,
    exchanged,
    field_indices,
    jackknife_error,
    pair_variances,
    partial_variances,
    shares,
)
from uq.estimators.moments import ESTIMATES, Estimates, estimate_from_replicates, quantiles_from_replicates
from uq.estimators.tails import counted
from uq.evaluation.evaluate import Evaluate, Evaluations, Recorder, Request
from uq.findings import add
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import check_scrambles, power_of_two, sobol_points
from uq.methods.chaos import LARGEST, Chaos, expansion_dataset
from uq.methods.monte_carlo import FIRST_ROUND, UNLIMITED, Probability, by_node
from uq.methods.stopping import Amount
from uq.surrogates.least_squares import NOTHING
from uq.surrogates.linearisation import Linearisation, linearise, local_dataset
from uq.surrogates.regression import Regression

if TYPE_CHECKING:
    import xarray as xr

    from forward.scalars import Mistake
    from forward.spec import ModelSpec

SAME = 1e-6  # largest relative difference of outputs of the same model at its mean parameters
DIMENSIONS = {
    "sobol_first": ("output", "parameter"),
    "sobol_total": ("output", "parameter"),
    "sobol_group_first": ("output", "group"),
    "sobol_group_total": ("output", "group"),
    "sobol_second": ("output", "parameter", "partner"),
}
RUNNING = ("sobol_first", "sobol_total")
Variables = dict[str, tuple[tuple[str, ...], Any]]


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
    max_order: Annotated[int, Field(ge=1, le=20)] = 6
    gradients: bool = True
    seed: Annotated[int, Field(ge=0)] = 0
    quantiles: tuple[Probability, ...] = (0.05, 0.5, 0.95)
    fields: bool = True
    results: SkipJsonSchema[Any] = Field(default=None, exclude=True, repr=False)  # those of `source`

    def check_amount(self) -> None:
        """Raise a ValueError if design, amount and source are inconsistent."""
        if self.design == "given-data":
            if self.source is None or self.asked:
                message = (
                    "expected source, the results to take, and neither samples nor tolerance nor budget_seconds with "
                    "design = 'given-data'"
                )
                raise ValueError(message)
            return
        super().check_amount()
        if self.source is not None:
            message = f"source = '{self.source}', expected design = 'given-data' with it"
            raise ValueError(message)
        if self.design == "saltelli":
            check_scrambles(self.samples, self.scrambles)

    def with_sources(self, read: Callable[[str], xr.Dataset]) -> Self:
        """Return the same with the results that it uses."""
        return self if self.source is None else self.model_copy(update={"results": read(self.source)})

    def planned(self, dimension: int) -> int:
        """Number of solves for so many parameters; the largest, if a tolerance may end the study earlier."""
        if self.design == "given-data":
            return 1
        if self.design == "chaos":
            return 1 + (self.samples or LARGEST)
        size = self.products(dimension).size
        return 1 + size * (self.samples or self.scrambles * power_of_two(UNLIMITED // size // self.scrambles))

    def products(self, dimension: int) -> RowProducts:
        """What is averaged over the rows of exchanged points."""
        return RowProducts(dimension + len(self.groups), dimension if self.second_order else 0)

    def objection(self, inputs: Inputs) -> str | None:
        """Say why these parameters have no Sobol' indices, or None."""
        if len(inputs.joint) > 1:
            return (
                "parameters given by the same draws depend on each other and have no Sobol' indices, expected "
                "method.kind = 'chaos', which gives their Shapley effects"
            )
        if not inputs.independent:
            return "Sobol' indices need independent parameters, expected no correlations for method.kind = 'sobol'"
        return None

    def mistakes(self, inputs: Inputs, spec: ModelSpec) -> Iterator[Mistake]:
        """Also find groups with unknown parameters."""
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
        SolveError
            If the model has no answer at the mean parameters, or at too many samples.
        FileNotFoundError
            If the source holds no results of this model and these parameters.
        ValueError
            If the parameters are correlated, or a group has unknown ones.
        """
        objection = self.objection(inputs) or self.unknown(inputs)
        if objection is not None:
            raise ValueError(objection)
        dataset = {"chaos": self._expand, "saltelli": self._exchange, "given-data": self._take}[self.design](
            inputs, evaluate
        )
        if self.groups:
            dataset = dataset.assign_coords(group=list(self.groups))
            dataset["group_members"] = (("group", "parameter"), self._members(inputs))
        if self.second_order:
            dataset = dataset.assign_coords(partner=list(inputs.names))
        return dataset

    def _members(self, inputs: Inputs) -> NDArray[np.bool_]:
        """Which parameters (groups, d) each group has."""
        return np.array([[p in names for p in inputs.names] for names in self.groups.values()], dtype=bool).reshape(
            len(self.groups), len(inputs.names)
        )

    # --- from an expansion ---------------------------------------------------------------------------------------

    def _analysis(self, inputs: Inputs) -> Analysis:
        """What is asked of an expansion."""
        members = self._members(inputs)

        def of(coefficients: FloatArray, indices: NDArray[np.int64]) -> dict[str, FloatArray]:
            found = coefficient_moments(coefficients, indices)
            squares = coefficients**2
            variance, first, total = partial_variances(squares, indices, members)
            if len(members):
                found["sobol_group_first"] = shares(first, variance[..., None])
                found["sobol_group_total"] = shares(total, variance[..., None])
            if self.second_order:
                found["sobol_second"] = shares(pair_variances(squares, indices), variance[..., None, None])
            return found

        return of

    def _expand(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        method = Chaos(
            samples=self.samples,
            tolerance=self.tolerance,
            budget_seconds=self.budget_seconds,
            max_order=self.max_order,
            gradients=self.gradients,
            seed=self.seed,
            quantiles=self.quantiles,
            fields=self.fields,
        )
        expanded = method.expand(inputs, evaluate)
        dataset = expansion_dataset(method, evaluate, expanded)
        return self._with_indices(dataset, inputs, expanded.regression, evaluate.node_volumes)

    def _with_indices(
        self, dataset: xr.Dataset, inputs: Inputs, regression: Regression, volumes: FloatArray | None
    ) -> xr.Dataset:
        """Add the indices from a regression, and from its first samples."""
        found = regression.estimates(self._analysis(inputs))
        dataset = dataset.assign(_by_output(found))
        running = {}
        n = len(regression.data.points)
        for count in sorted({n // 8, n // 4, n // 2, n} - {0, 1}):
            try:
                running[count] = regression.first(count).estimates()
            except SolveError:
                continue  # too few for an expansion
        dataset = dataset.assign(_running(running)).assign_coords(index_round=list(running))
        add(dataset, *regression.doubts(dataset["output"].to_numpy().tolist()), *of_indices(dataset))
        return _with_maps(dataset, volumes) if self.fields else dataset

    # --- from given data -----------------------------------------------------------------------------------------

    def _take(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        if self.results is None:
            message = f"the results of {self.source} were not read, expected them in `results`: see `with_sources`"
            raise ValueError(message)
        source = _fitting(self.results, str(self.source), inputs, evaluate)
        centre = linearise(inputs, evaluate)
        theirs = source["nominal"].to_numpy()
        if not np.allclose(theirs, centre.outputs, rtol=SAME, atol=SAME * np.abs(theirs).max()):
            message = (
                f"{self.source}: holds results of another model (at the mean parameters {theirs.tolist()}, here "
                f"{centre.outputs.tolist()}), expected those of the model of this study"
            )
            raise FileNotFoundError(message)
        dataset = source.drop_vars([name for name in ("node_position", "cell_nodes", "unit") if name in source])
        dataset.attrs = {
            "stopped": f"from the results of {Path(str(self.source)).name}: {source.attrs.get('stopped', 'samples')}"
        }
        dataset.attrs |= {name: source.attrs[name] for name in ("note", "findings") if name in source.attrs}
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
        found = self._analysis(inputs)(coefficients, indices)
        nothing = source["loo_error"].to_numpy() > NOTHING
        for name in set(found) & set(DIMENSIONS):
            # The samples' derivatives, which errors of other indices would need, are not kept.
            kept = f"{name}_error"
            found[kept] = source[kept].to_numpy() if kept in source else np.full_like(found[name], np.nan)
            found[name][nothing] = np.nan
        dataset = dataset.assign(_by_output(found))
        return _with_maps(dataset, evaluate.node_volumes) if self.fields else dataset

    # --- from exchanged samples ----------------------------------------------------------------------------------

    def _exchange(self, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
        evaluate = Recorder(evaluate)
        centre = linearise(inputs, evaluate)
        members = np.vstack([np.eye(len(inputs.names), dtype=bool), self._members(inputs)])
        rows = _Rows(self, inputs, evaluate, centre, members)
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
        dataset = rows.dataset(found)
        add(dataset, *of_indices(dataset))
        amount = f"{R * rows.each} rows of {K} solves of Sobol' points"
        error = f"errors of the indices up to {reached:.2g}"
        dataset.attrs["stopped"] = self.why_stopped(reached, error, rows.each, last, amount)
        return dataset


def _by_output(found: dict[str, FloatArray]) -> Variables:
    """Return indices and their errors as variables."""
    return {
        f"{name}{end}": (dimensions, found[f"{name}{end}"])
        for name, dimensions in DIMENSIONS.items()
        for end in ("", "_error")
        if name in found
    }


def _running(rounds: dict[int, dict[str, FloatArray]]) -> Variables:
    """Return the indices of first order and total of several rounds as variables."""
    return {
        f"running_{name}{end}": (
            ("index_round", "output", "parameter"),
            np.array([found[f"{name}{end}"] for found in rounds.values()]),
        )
        for name in RUNNING
        for end in ("", "_error")
    }


def _with_maps(dataset: xr.Dataset, volumes: FloatArray | None) -> xr.Dataset:
    """Add the indices of an expanded field.

    Errors of the whole field's indices come with the expansion; there are none if it explains nothing of the field.
    Maps are empty at nodes of which it explains nothing.
    """
    if "field_coefficients" not in dataset:
        return dataset
    squares = (dataset["field_coefficients"].to_numpy() ** 2).sum(axis=2).T
    indices = dataset["multi_index"].to_numpy()
    variance, first, total = partial_variances(squares, indices, np.eye(indices.shape[1], dtype=bool))
    nothing = "field_loo_error" in dataset and float(dataset["field_loo_error"]) > NOTHING
    dataset = dataset.assign(field_indices(variance, first.T, total.T, volumes))
    if "node_loo_error" in dataset:
        known = (dataset["node_loo_error"] <= NOTHING) & (not nothing)
        maps = {f"node_{name}": dataset[f"node_{name}"].where(known) for name in RUNNING}
        dataset = dataset.assign({**maps, "dominating": dataset["dominating"].where(known, -1)})
    for name in RUNNING:
        if nothing:
            dataset[f"field_{name}"] = dataset[f"field_{name}"] * np.nan
        if f"field_{name}_error" not in dataset:  # results of an earlier version
            dataset[f"field_{name}_error"] = dataset[f"field_{name}"] * np.nan
    return dataset


def _fitting(source: xr.Dataset, directory: str, inputs: Inputs, evaluate: Evaluate) -> xr.Dataset:
    """Return the results of another study, which must have the same parameters and outputs.

    Raises
    ------
    FileNotFoundError
        If they are of others.
    """
    for what, expected in (("parameter", inputs.names), ("output", evaluate.outputs)):
        theirs = tuple(source[what].values)
        if theirs != expected:
            message = f"{directory}: holds results of {what}s {', '.join(theirs)}, expected {', '.join(expected)}"
            raise FileNotFoundError(message)
    if not ("multi_index" in source or "values" in source):
        message = f"{directory}: holds neither samples nor an expansion, expected results of chaos or of sampling"
        raise FileNotFoundError(message)
    ours, written = _as_written(inputs), _distributions(source.attrs.get("config"))
    if not (
        np.allclose(source["parameter_mean"], inputs.mean, rtol=1e-10, atol=0)
        and np.allclose(source["parameter_std"], inputs.std, rtol=1e-10, atol=0)
        and all(ours[name] == value for name, value in written.items())  # coefficients of fields are not written
    ):
        message = f"{directory}: holds results of other distributions, expected those of this study"
        raise FileNotFoundError(message)
    return source


def _distributions(config: str | None) -> dict[str, Any]:
    """Return the distributions of a recorded study, if there is a record."""
    import tomllib

    return dict(tomllib.loads(config or "").get("parameters", {}))


def _as_written(inputs: Inputs) -> dict[str, Any]:
    return {name: marginal.model_dump(mode="json", exclude_none=True) for name, marginal in inputs.marginals.items()}


def _added(one: FloatArray | None, other: FloatArray | None) -> FloatArray | None:
    """Add what there is of two sums."""
    if one is None or other is None:
        return other if one is None else one
    return one + other


# --- exchanged samples ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _FieldProducts:
    """Sum of the products of the state's deviations in a row, and of third and fourth powers at the points A and B."""

    products: RowProducts
    size: int
    state: FloatArray

    def on(self, model: ForwardModel) -> Callable[[FloatArray], FloatArray]:
        state = scattered(model, self.state[None, :])[0]
        used = self.products.size

        def rows(states: FloatArray) -> FloatArray:
            deviations = states[:used] - state
            higher = [(deviations[:2] ** k).mean(axis=0) for k in (3, 4)]
            return np.concatenate([self.products.of(deviations), higher])

        return rows


class _Rows:
    """All rows, in parts of as many rows each, and the sums of the fields over each part.

    The sums are kept for every part: R (3 (d + groups) + 5) fields on rank 0.

    Attributes
    ----------
    each
        Number n of rows of each of the R parts.
    points, outputs
        (R n, K, d) and (R n, K, m).
    ok
        Rows (R n,) of which all points have an answer.
    """

    def __init__(
        self,
        method: Sobol,
        inputs: Inputs,
        evaluate: Evaluate,
        centre: Linearisation,
        members: NDArray[np.bool_],
    ) -> None:
        self._method, self._inputs, self._evaluate, self._centre = method, inputs, evaluate, centre
        self._members = members
        self.products = method.products(len(inputs.names))
        self._of_fields = RowProducts(len(members))
        R, d, m = method.scrambles, len(inputs.names), len(evaluate.outputs)
        K = self.products.size
        self.each = 0
        self._parts = R
        self.points = np.empty((0, K, d))
        self.outputs = np.empty((0, K, m))
        self.ok = np.empty(0, dtype=bool)
        self._sums: list[FloatArray | None] = [None] * R
        self._reasons: set[str] = set()

    def extend(self, each: int) -> None:
        """Extend every part to `each` rows: to all from none, or to twice as many."""
        method, centre, K = self._method, self._centre, self.products.size
        d, before, after = len(self._inputs.names), len(self.ok), self._parts * each
        cubes = sobol_points(method.seed, 0, before, after, 2 * d)
        first, second = (self._inputs.points(half) for half in (cubes[:, :d], cubes[:, d:]))
        points = exchanged(first, second, self._members, pairs=method.second_order)
        if method.fields and centre.state.size:
            joint = _FieldProducts(self._of_fields, K, centre.state)
            parts = points.reshape(-1, each * K, d)
            found = [self._ask(Request(part, start=centre.prediction, joint=joint)) for part in parts]
            joined = [_added(*pair) for pair in zip(self._sums[::2], self._sums[1::2], strict=True)] if before else []
            self._sums = [*joined, *(part.fields if part.fields.size else None for part in found)]
        else:
            found = [self._ask(Request(points.reshape(-1, d), start=centre.prediction))]
        outputs = np.concatenate([part.outputs for part in found]).reshape(after - before, K, -1)
        ok = np.concatenate([part.ok for part in found]).reshape(after - before, K).all(axis=1)
        self.each = each
        self.points = np.concatenate([self.points, points])
        self.outputs = np.concatenate([self.outputs, outputs])
        self.ok = np.concatenate([self.ok, ok])

    def _ask(self, request: Request) -> Evaluations:
        found = self._evaluate(request)
        self._reasons |= {failure.reason for failure in found.failures}
        return found

    def _cut(self, values: NDArray, each: int) -> NDArray:  # type: ignore[type-arg]
        """Return the first rows in parts of `each` (R, each, …)."""
        return values[: self._parts * each].reshape(self._parts, each, *values.shape[1:])

    def _usable(self, each: int) -> NDArray[np.bool_]:
        """Which parts (R,) of `each` rows have a whole row."""
        return np.asarray(self._cut(self.ok, each).any(axis=1))

    def _of_outputs(self, each: int) -> tuple[FloatArray, FloatArray]:
        """Sums (R', J, m) over the whole rows of every part that has some, and their numbers (R',)."""
        some = self._usable(each)
        if some.sum() < 2:
            reasons = "; ".join(sorted(self._reasons)[:3])
            message = f"{some.sum()} of {len(some)} parts have a row of answers, expected more: {reasons}"
            raise SolveError(message)
        ok = self._cut(self.ok, each)[some]
        deviations = self._cut(self.outputs, each)[some] - self._centre.outputs
        values = np.where(ok[..., None, None], deviations, 0.0)
        products = self.products.of(np.moveaxis(values, 2, 0))  # (J, R', n, m)
        return np.swapaxes(products.sum(axis=2), 0, 1), ok.sum(axis=1).astype(float)

    def indices(self, each: int) -> dict[str, FloatArray]:
        """Estimate the indices from the first R parts of `each` rows, with standard errors."""
        sums, counts = self._of_outputs(each)
        found = self._indices(self.products.variances(sums.sum(axis=0) / counts.sum()))
        drawn = self._indices(self.products.variances(bootstrap(sums, counts, self._method.seed)))
        for name, values in drawn.items():
            found[f"{name}_error"] = bootstrap_error(values, len(counts), axis=0)
        return found

    def _indices(self, parts: ExchangedVariances) -> dict[str, FloatArray]:
        """Shares (…, m, d) of variances by parameter (d, …, m)."""
        d = len(self._inputs.names)
        first, total = (np.moveaxis(shares(part, parts.variance), 0, -1) for part in (parts.first, parts.total))
        found = {"sobol_first": first[..., :d], "sobol_total": total[..., :d]}
        if len(self._members) > d:
            found |= {"sobol_group_first": first[..., d:], "sobol_group_total": total[..., d:]}
        if parts.second is not None:
            found["sobol_second"] = np.moveaxis(shares(parts.second, parts.variance), (0, 1), (-2, -1))
        return found

    def field(self) -> tuple[Variables, list[Finding]]:
        """Moments and indices of the displacement field, errors by leaving a part out, and what speaks against them."""
        rows = self._cut(self.ok, self.each).sum(axis=1)
        kept = [(total, n) for total, n in zip(self._sums, rows, strict=True) if total is not None]
        if not kept:
            return {}, []
        count, d = self._evaluate.displacements, len(self._inputs.names)
        sums = [total[:-2, :count] for total, _ in kept]
        counts = [n for _, n in kept]
        whole, n = np.sum(sums, axis=0), sum(counts)
        volumes = self._evaluate.node_volumes

        def of(means: FloatArray) -> Variables:
            parts = self._of_fields.variances(means)
            variance, first, total = (
                part.reshape(*part.shape[:-1], -1, 3).sum(axis=-1)
                for part in (parts.variance, parts.first[:d], parts.total[:d])
            )
            return field_indices(variance, first, total, volumes)

        found = of(whole / n)
        without = [of((whole - s) / (n - c)) for s, c in zip(sums, counts, strict=True)]
        for name in RUNNING:
            errors = jackknife_error(np.array([some[f"field_{name}"][1] for some in without]))
            found[f"field_{name}_error"] = (("parameter",), errors)
        square = self._of_fields.size
        means = [[(s[0] + s[1]) / (2 * c), s[square] / c] for s, c in zip(sums, counts, strict=True)]
        moments = estimate_from_replicates(np.swapaxes(np.array(means), 0, 1), self._centre.state[:count])
        higher = np.sum([total[-2:, :count] for total, _ in kept], axis=0)
        powers = np.array([whole[0] + whole[1], 2 * whole[square], *(2 * higher)])
        doubts = of_field_tails(powers, 2 * n, moments.relative_std_error, volumes)
        return found | by_node(moments, count), list(doubts)

    def dataset(self, found: dict[str, FloatArray]) -> xr.Dataset:
        """Return all estimates as labelled arrays."""
        method, centre, K = self._method, self._centre, self.products.size
        part = np.repeat(np.arange(self._parts), self.each * K)
        answered = ~np.isnan(self.outputs).any(axis=2).ravel()
        whole = np.repeat(self.ok, K)
        independent = whole & (np.arange(whole.size) % K < 2)  # A and B
        values = self.outputs.reshape(whole.size, -1)
        of_quantiles = quantiles_from_replicates(values[independent], part[independent], method.quantiles)
        rounds = [1 << k for k in range(self.each.bit_length()) if self._usable(1 << k).sum() > 1]
        moments = {each: self._moments(each) for each in rounds}
        running = {each * self._parts * K: self.indices(each) for each in rounds}
        of_field, doubts = self.field()
        by_output = ("output",)
        dataset = local_dataset(self._inputs, self._evaluate, centre, fields=method.fields)
        dataset = dataset.assign_coords(
            quantile=list(method.quantiles), round=list(running), index_round=list(running)
        ).assign(
            {
                **{name: (by_output, getattr(moments[self.each], name)) for name in ESTIMATES},
                **of_quantiles.variables,
                **_by_output(found),
                "points": (("sample", "parameter"), self.points.reshape(whole.size, -1)),
                "values": (("sample", "output"), values),
                "ok": (("sample",), answered),
                "scramble": (("sample",), part),
                **{
                    f"running_{name}": (("round", "output"), np.array([getattr(e, name) for e in moments.values()]))
                    for name in ("mean", "mean_error")
                },
                **_running(running),
                **of_field,
            }
        )
        add(dataset, *doubts)
        last = moments[self.each].relative_std_error
        add(dataset, *of_tails(self._evaluate.outputs, values[independent], last))
        lost = int((~self.ok).sum())
        if lost:
            dataset.attrs["note"] = (
                f"{int((~answered).sum())} of {answered.size} samples have no answer; the {lost} of {self.ok.size} "
                "rows that they are in are left out as a whole: estimates are conditional on the model having an answer"
            )
        return dataset

    def _moments(self, each: int) -> Estimates:
        """Moments of the outputs from the points A and B."""
        sums, counts = self._of_outputs(each)
        means = sums / counts[:, None, None]
        K = self.products.size
        products = np.array([(means[:, 0] + means[:, 1]) / 2, means[:, K]])
        rows = self._parts * each
        drawn = self.outputs[:rows, :2][self.ok[:rows]].reshape(-1, self.outputs.shape[2])
        return counted(estimate_from_replicates(products, self._centre.outputs), self._inputs, drawn)
