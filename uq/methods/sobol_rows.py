"""Rows of exchanged samples, and what is estimated from them: Sobol' indices and moments.

Rows have d + 2 solves (A. Saltelli et al., Comput. Phys. Commun. 181 (2010) 259–270); A and B are the halves of
scrambled Sobol' points in 2d dimensions. A row in which a solve failed is left out as a whole: with only some of its
points, the differences that the estimators average would be incomplete.

The rows belong to one scrambled Sobol' sequence: independent scrambles of a sixteenth of the rows each have two to four
times the error at a thousand rows. Errors come from resampling its R parts of consecutive rows, each a net by itself.
This ignores that the parts complement each other: it claims the error of R independent parts, which is no smaller.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from forward.findings import Finding
from forward.model import FloatArray, ForwardModel, SolveError, scattered
from uq.estimators.doubts import of_field_tails, of_tails
from uq.estimators.estimate import Variables, of_samples
from uq.estimators.indices import (
    ExchangedVariances,
    RowProducts,
    bootstrap,
    bootstrap_error,
    exchanged,
    field_indices,
    jackknife_error,
    partial_variances,
    shares,
)
from uq.estimators.moments import Estimates, estimate_from_replicates, running, student
from uq.estimators.quantiles import quantiles_from_replicates
from uq.estimators.tails import counted, of_squares
from uq.evaluation.request import Evaluate, Request
from uq.findings import add
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.methods.monte_carlo import by_node
from uq.surrogates.least_squares import NOTHING
from uq.surrogates.linearisation import Linearisation, local_dataset

if TYPE_CHECKING:
    import xarray as xr

DIMENSIONS = {
    "sobol_first": ("output", "parameter"),
    "sobol_total": ("output", "parameter"),
    "sobol_group_first": ("output", "group"),
    "sobol_group_total": ("output", "group"),
    "sobol_second": ("output", "parameter", "partner"),
}
RUNNING = ("sobol_first", "sobol_total")


def by_output(found: dict[str, FloatArray]) -> Variables:
    """Return indices and their errors as variables."""
    return {
        f"{name}{end}": (dimensions, found[f"{name}{end}"])
        for name, dimensions in DIMENSIONS.items()
        for end in ("", "_error")
        if name in found
    }


def by_round(rounds: dict[int, dict[str, FloatArray]]) -> Variables:
    """Return the indices of first order and total of several rounds as variables."""
    return {
        f"running_{name}{end}": (
            ("index_round", "output", "parameter"),
            np.array([found[f"{name}{end}"] for found in rounds.values()]),
        )
        for name in RUNNING
        for end in ("", "_error")
    }


def with_maps(dataset: xr.Dataset, volumes: FloatArray | None) -> xr.Dataset:
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
    return dataset.assign({f"field_{name}": dataset[f"field_{name}"].where(not nothing) for name in RUNNING})


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


class Rows:
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
        inputs: Inputs,
        evaluate: Evaluate,
        centre: Linearisation,
        members: NDArray[np.bool_],
        seed: int,
        parts: int,
        *,
        pairs: bool,
        fields: bool,
    ) -> None:
        self._inputs, self._evaluate, self._centre = inputs, evaluate, centre
        self._members, self._seed, self._parts, self._fields = members, seed, parts, fields
        d, m = len(inputs.names), len(evaluate.outputs)
        self.products = RowProducts(len(members), d if pairs else 0)
        self._of_fields = RowProducts(len(members))
        R, K = parts, self.products.size
        self.each = 0
        self.points = np.empty((0, K, d))
        self.outputs = np.empty((0, K, m))
        self.ok = np.empty(0, dtype=bool)
        self._sums: list[FloatArray | None] = [None] * R
        self._reasons: set[str] = set()

    def extend(self, each: int) -> None:
        """Extend every part to `each` rows: to all from none, or to twice as many."""
        centre, K = self._centre, self.products.size
        d, before, after = len(self._inputs.names), len(self.ok), self._parts * each
        cubes = sobol_points(self._seed, 0, before, after, 2 * d)
        first, second = (self._inputs.points(half) for half in (cubes[:, :d], cubes[:, d:]))
        points = exchanged(first, second, self._members, pairs=self.products.pairs > 0)
        joint = _FieldProducts(self._of_fields, K, centre.state) if self._fields and centre.state.size else None
        parts = points.reshape(1, -1, d) if joint is None else points.reshape(-1, each * K, d)
        found = [self._evaluate(Request(part, start=centre.prediction, joint=joint)) for part in parts]
        self._reasons |= {failure.reason for part in found for failure in part.failures}
        if joint is not None:
            joined = [_added(*pair) for pair in zip(self._sums[::2], self._sums[1::2], strict=True)] if before else []
            self._sums = [*joined, *(part.fields if part.fields.size else None for part in found)]
        outputs = np.concatenate([part.outputs for part in found]).reshape(after - before, K, -1)
        ok = np.concatenate([part.ok for part in found]).reshape(after - before, K).all(axis=1)
        self.each = each
        self.points = np.concatenate([self.points, points])
        self.outputs = np.concatenate([self.outputs, outputs])
        self.ok = np.concatenate([self.ok, ok])

    def _cut(self, values: NDArray[Any], each: int) -> NDArray[Any]:
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
            raise SolveError(f"{some.sum()} of {len(some)} parts have a row of answers, expected more: {reasons}")
        ok = self._cut(self.ok, each)[some]
        deviations = self._cut(self.outputs, each)[some] - self._centre.outputs
        values = np.where(ok[..., None, None], deviations, 0.0)
        products = self.products.of(np.moveaxis(values, 2, 0))  # (J, R', n, m)
        return np.swapaxes(products.sum(axis=2), 0, 1), ok.sum(axis=1).astype(float)

    def indices(self, each: int) -> dict[str, FloatArray]:
        """Estimate the indices from the first R parts of `each` rows, with standard errors."""
        sums, counts = self._of_outputs(each)
        found = self._indices(self.products.variances(sums.sum(axis=0) / counts.sum()))
        drawn = self._indices(self.products.variances(bootstrap(sums, counts, self._seed)))
        for name, values in drawn.items():
            found[f"{name}_error"] = bootstrap_error(values, len(counts), axis=0)
        d = len(self._inputs.names)
        moved = self._influences(each)
        for name, these in (("sobol_total", moved[:, :d]), ("sobol_group_total", moved[:, d:-1])):
            if name in found:
                total, error = found[name].T, found[f"{name}_error"].T
                further = (these - total * moved[:, -1:]).reshape(len(moved), -1)
                counted = of_squares(total.ravel(), error.ravel(), further, student(len(counts) - 1))
                found[f"{name}_error"] = counted.reshape(total.shape).T
        return found

    def _influences(self, each: int) -> FloatArray:
        """Squares (n, G + 1, m) of what rows have of V_g^T over the variance, and last of the variance itself."""
        rows = self._parts * each
        values = self.outputs[:rows][self.ok[:rows]]
        A, B, AB = values[:, :1], values[:, 1:2], values[:, 2 : 2 + self.products.groups]
        middle = values[:, :2].mean(axis=(0, 1))
        varied = ((A - middle) ** 2 + (B - middle) ** 2) / 2
        return shares(np.concatenate([(A - AB) ** 2 / 2, varied], axis=1), varied.mean(axis=0))

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

    def dataset(self, found: dict[str, FloatArray], probabilities: tuple[float, ...]) -> xr.Dataset:
        """Return all estimates as labelled arrays, with quantiles of these probabilities."""
        centre, K = self._centre, self.products.size
        part = np.repeat(np.arange(self._parts), self.each * K)
        answered = ~np.isnan(self.outputs).any(axis=2).ravel()
        whole = np.repeat(self.ok, K)
        independent = whole & (np.arange(whole.size) % K < 2)  # A and B
        values = self.outputs.reshape(whole.size, -1)
        of_quantiles = quantiles_from_replicates(values[independent], part[independent], probabilities)
        rounds = [1 << k for k in range(self.each.bit_length()) if self._usable(1 << k).sum() > 1]
        moments = {each: self._moments(each) for each in rounds}
        indices = {each * self._parts * K: self.indices(each) for each in rounds}
        of_field, doubts = self.field()
        dataset = local_dataset(self._inputs, self._evaluate, centre, fields=self._fields)
        dataset = dataset.assign_coords(round=list(indices), index_round=list(indices))
        dataset = of_quantiles.on(dataset, probabilities).assign(
            {
                **moments[self.each].variables(),
                **by_output(found),
                **of_samples(self.points.reshape(whole.size, -1), values, answered, part),
                **running(moments.values()),
                **by_round(indices),
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


def _added(one: FloatArray | None, other: FloatArray | None) -> FloatArray | None:
    """Add what there is of two sums."""
    if one is None or other is None:
        return other if one is None else one
    return one + other
