"""Which points a reduced model has: few with weights ≥ 0, at which integrals of snapshots are what they are at all.

Weights that are not negative keep an energy an energy: the reduced stiffness is as positive as that of the points.
Sources: S. S. An, T. Kim, D. L. James, Optimizing cubature for efficient integration of subspace deformations, ACM
Trans. Graph. 27 (2008); C. Farhat et al., Int. J. Numer. Meth. Engng 98 (2014) 625–662.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cholesky, solve_triangular

from forward.fem.equations import Discretisation
from forward.model import FloatArray
from forward.observables.functionals import Integral
from forward.reduced.data import LevelData, Points
from forward.reduced.integrands import Integrand, Sampler
from forward.reduced.kernels import spread

CANDIDATES = 12_000  # points among which a rule is chosen, of more a random part
STATES = 160  # snapshots on which it is trained, of more an even part: each has as many works as there are modes
FINER = 10.0  # how many times less the points of the larger model miss
SHAKEN = 0.3  # energy of what is added to a snapshot, over its own
KEPT_WHOLE = 600  # points of a boundary that are all kept
SEED = 7
SHARE = 0.05  # of the points that are in, how many enter at once
TIMES = 2  # how often each row is taken in a mixture
LEAST = 1e-13  # by which diagonals of normal equations are raised, relative,
RAISED = (1e-10, 1e-7)  # and where points do the same


@dataclass(frozen=True, eq=False)
class Training:
    """What rules are trained on.

    Attributes
    ----------
    rows
        Coordinate fields (N, U_local).
    coordinates, parameters
        Coordinates (s, N) and parameters (s, d) of the snapshots.
    before, tests
        How many coordinates come before the modes, and how many of these are fields that only test.
    adjoints
        Coordinates (s, m, N − before) of the adjoints of the outputs there, over the spread of these; none of them
        where nobody knows them.
    """

    rows: FloatArray
    coordinates: FloatArray
    parameters: FloatArray
    before: int
    tests: int
    adjoints: FloatArray

    def some(self, most: int) -> Training:
        """Return an even part of the snapshots, at most so many."""
        count = len(self.parameters)
        few = np.linspace(0, count - 1, min(most, count)).round().astype(np.int64)
        some = self.coordinates[few], self.parameters[few], self.adjoints[few]
        return replace(self, coordinates=some[0], parameters=some[1], adjoints=some[2])

    def shaken(self, count: int) -> Training:
        """Return these snapshots and so many more, moved at random in all modes: these tell the whole stiffness."""
        which = np.arange(count) % len(self.parameters)
        moved = self.coordinates[which]
        random = np.random.default_rng(SEED).standard_normal((count, moved.shape[1] - self.before))
        size = np.linalg.norm(moved[:, self.before :], axis=1) / np.linalg.norm(random, axis=1)
        moved[:, self.before :] += np.sqrt(SHAKEN) * size[:, None] * random
        none = np.zeros_like(self.adjoints[which])  # those of other states are not known
        rows = (self.coordinates, moved), (self.parameters, self.parameters[which]), (self.adjoints, none)
        coordinates, parameters, adjoints = (np.concatenate(both) for both in rows)
        return replace(self, coordinates=coordinates, parameters=parameters, adjoints=adjoints)

    def projected(self, sizes: Sequence[int]) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
        """Return the snapshots on the first modes, so many each time: coordinates (N,), parameters (d,), adjoints."""
        for c, point, adjoints in zip(self.coordinates, self.parameters, self.adjoints, strict=True):
            for size in sizes:
                kept = np.zeros(len(self.rows))
                kept[: self.before + size] = c[: self.before + size]
                yield kept, point, adjoints


class Rules:
    """The points of a body, and the choice among them.

    Of integrands of virtual works, the first of which is that of the energy, whose rule integrates densities of outputs
    too; `whole` says which keep all their points. Integrands take numbers (p,) among the parameters.
    """

    def __init__(
        self,
        equations: Discretisation,
        works: Sequence[Integrand],
        whole: Sequence[bool],
        densities: Sequence[tuple[Sampler, Integral]],
        numbers: NDArray[np.int64],
    ) -> None:
        self._equations, self._densities, self._numbers = equations, densities, numbers
        self._samplers = [Sampler(equations, one) for one in works]
        self._whole = whole

    def levels(
        self,
        training: Training,
        counts: tuple[int, int],
        missed: float,
        shaken: int,
        kept: NDArray[np.bool_] | None,
    ) -> tuple[tuple[LevelData, ...], dict[str, Any]]:
        """Choose the points of a model with so many modes and of the larger one, and say how many they are.

        Parameters
        ----------
        training
            What they are trained on.
        counts
            Numbers of modes.
        missed
            What they may miss of the forces, relative.
        shaken
            How many states beside the snapshots those of the larger model are trained on.
        kept
            Which cells are kept in full, with all their points; None for none.
        """
        rows, before, training = training.rows, training.before, training.some(STATES)
        levels: list[LevelData] = []
        told: dict[str, Any] = {}
        in_full = [np.zeros(sampler.count, dtype=bool) for sampler in self._samplers]
        if kept is not None:
            in_full[0] = np.repeat(kept, self._samplers[0].count // len(kept))
        every = kept is not None and bool(kept.any())
        candidates = [np.arange(sampler.count) for sampler in self._samplers]
        candidates[0] = _candidates(self._samplers[0], in_full[0])
        known = [sampler.points(rows, some) for sampler, some in zip(self._samplers, candidates, strict=True)]
        of_densities = [sampler.points(rows, candidates[0]) for sampler, _ in self._densities]
        for level, n in enumerate(counts):
            works, integrals = [], []
            for number, points in enumerate(known):
                if number > 0 and (self._whole[number] or len(points.weights) <= KEPT_WHOLE or every):
                    works.append(points.of(before + n))
                    continue
                sizes = (counts[0],) if level == 0 else counts
                fixed = in_full[number][candidates[number]]
                least = missed / (1 if level == 0 else FINER)
                beside = of_densities if number == 0 else []
                # Estimates of errors are what forces do to outputs, and only the larger model makes them.
                trained = training if level else replace(training, adjoints=training.adjoints[:, :0])
                trained = trained.shaken(shaken) if level and shaken else trained
                rule = self._rule(number, points, beside, trained, sizes, least, fixed)
                works.append(points.some(rule.points, rule.weights, before + n))
                if number == 0:
                    integrals = [one.some(rule.points, rule.weights, before + n) for one in of_densities]
                    kind = "points" if level == 0 else "points of the larger model"
                    told |= {kind: len(rule.points), f"missed by the {kind}": rule.missed}
            levels.append(LevelData(n, tuple(works), tuple(integrals)))
        return tuple(levels), told

    def _rule(
        self,
        number: int,
        points: Points,
        densities: list[Points],
        training: Training,
        sizes: tuple[int, ...],
        missed: float,
        fixed: NDArray[np.bool_],
    ) -> Rule:
        """Choose points and weights that integrate the works of projected snapshots, densities of outputs, and volume.

        The works of each state on modes are scaled to its forces, those on adjoints, which are what forces that are
        missed do to an output, to its spread. Mixed at random, a few hundred sums stand for all of them.
        """
        equations, numbers, sampler = self._equations, self._numbers, self._samplers[number]
        kernel = sampler.kernel(len(numbers))
        of_densities = [one.kernel(len(numbers)) for one, _ in self._densities] if densities else []
        tests = training.tests
        tested = np.arange(training.before - tests, training.before + sizes[-1])  # tests and the first modes
        whole = len(points.weights) == sampler.count
        outputs = training.adjoints.shape[1]
        count, each = len(training.parameters) * len(sizes), len(tested) + outputs
        mixture = Mixture(min(count * each, 4 * each + 400), len(points.weights), SEED)
        rows: list[FloatArray] = []
        of_forces = of_outputs = 0.0  # sums of squares of integrals
        m, n = points.fields.shape[:2]
        fields = np.ascontiguousarray(points.fields[:, :, tested])
        for c, point, adjoints in training.projected(sizes):
            components = (points.fields.reshape(m * n, -1) @ c).reshape(m, n)
            T = kernel(sampler.inputs(components, points, point), point[numbers])
            values = np.ascontiguousarray(spread(T[None], fields)[0].T)
            targets = values @ points.weights
            if not whole:
                equations.set_parameters(point)
                equations.at_load(0.0)
                equations.set_state(c @ training.rows)
                targets = training.rows[tested] @ equations.imbalance()
            if not (np.isfinite(T).all() and np.isfinite(targets).all()):
                continue  # few modes have turned a cell of this state inside out
            for (of, functional), there, kernel_of in zip(self._densities, densities, of_densities, strict=False):
                density = kernel_of(of.inputs(there.fields @ c, there, point), point[numbers])[0]
                total = float(density @ there.weights) if whole else functional.value() * functional.size
                rows.append(density / (total or 1.0))
            scale = np.full(len(tested), float(np.linalg.norm(targets[tests:])) or 1.0)
            scale[:tests] = np.where(targets[:tests] == 0, scale[:tests], np.abs(targets[:tests]))
            adjoint = adjoints[:, : sizes[-1]]
            on_modes, on_adjoints = targets / scale, adjoint @ targets[tests:]
            both = values / scale[:, None], adjoint @ values[tests:]
            mixture.add(np.concatenate(both), np.concatenate([on_modes, on_adjoints]))
            of_forces += float(on_modes @ on_modes)
            of_outputs += float(on_adjoints @ on_adjoints)
        volume = np.ones((1, len(points.weights))) / sampler.weights.sum()
        every = np.vstack([mixture.values, *rows, volume])
        aims = np.concatenate([mixture.integrals, np.ones(len(rows) + 1)])
        # Works on adjoints may be far larger than spreads of outputs: what is missed is relative to all but these.
        share = float(np.sqrt(1 - of_outputs / (of_forces + of_outputs + len(rows) + 1)))
        rule = beside(every, aims, missed * share, np.where(fixed, points.weights, 0.0))
        if whole and rule.missed > missed * share:  # then all points are needed
            return Rule(np.arange(len(points.weights)), points.weights, 0.0)
        return rule._replace(missed=rule.missed / share)


def _candidates(sampler: Sampler, kept: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Number the points among which a rule is chosen, and those (n,) that are kept."""
    if sampler.count <= CANDIDATES:
        return np.arange(sampler.count)
    some = np.random.default_rng(SEED).choice(sampler.count, CANDIDATES, replace=False)
    return np.union1d(some, np.flatnonzero(kept))


class Rule(NamedTuple):
    """Chosen points (k,) by number, their weights (k,), and what of the integrals they miss, relative to them."""

    points: NDArray[np.int64]
    weights: FloatArray
    missed: float


def chosen(values: FloatArray, integrals: FloatArray, tolerance: float, most: int) -> Rule:
    """Choose points so that Σ w values = integrals, by non-negative least squares that ends at a tolerance.

    The active set method (C. L. Lawson, R. J. Hanson, Solving Least Squares Problems, 1974, chapter 23) with the normal
    equations of the points that are in; several points enter at once, a part of those that are in.

    Values (rows, n) are those of integrands at n points; the tolerance is relative to the integrals (rows,).
    """
    scale = np.linalg.norm(values, axis=0)
    scale[scale == 0] = 1.0
    of_points = np.ascontiguousarray((values / scale).T)
    right = of_points @ integrals
    goal = float(np.linalg.norm(integrals))
    inside, x, equations = np.zeros(0, dtype=np.int64), np.zeros(0), _Normal()
    residual = integrals.copy()
    barred = np.zeros(len(of_points), dtype=bool)  # points that have just proved of no use
    while goal > 0 and np.linalg.norm(residual) > tolerance * goal and len(inside) < most:
        gains = of_points @ residual
        gains[inside] = -np.inf
        gains[barred] = -np.inf
        best = np.argsort(-gains)[: max(1, round(SHARE * len(inside)))]
        best = best[gains[best] > max(1e-13 * goal, 0.5 * gains[best[0]])]
        if not len(best):
            break
        equations.enter(of_points[inside] @ of_points[best].T, of_points[best] @ of_points[best].T)
        inside, x = np.concatenate([inside, best]), np.concatenate([x, np.zeros(len(best))])
        while True:
            s = equations.solved(right[inside])
            if (s > 0).all():
                x = s
                break
            # Go as far towards s as all stay positive, and leave out those that are zero then.
            down = s <= 0
            step = float(np.min(x[down] / np.maximum(x[down] - s[down], 1e-300)))
            x = x + step * (s - x)
            out = down & (x <= 1e-12 * x.max(initial=0.0))
            barred[:] = False
            barred[inside[out]] = True
            inside, x = inside[~out], x[~out]
            equations.leave(out)
        residual = integrals - x @ of_points[inside]
    order = np.argsort(inside)
    missed = float(np.linalg.norm(residual) / goal) if goal > 0 else 0.0
    return Rule(inside[order], (x / scale[inside])[order], missed)


def beside(values: FloatArray, integrals: FloatArray, tolerance: float, kept: FloatArray) -> Rule:
    """Choose points beside those that are kept with weights (n,), zero where they are not; else as `chosen`."""
    there, others = np.flatnonzero(kept), np.flatnonzero(kept == 0)
    left = integrals - values[:, there] @ kept[there]
    share = float(np.linalg.norm(left)) / (float(np.linalg.norm(integrals)) or 1.0)
    rule = chosen(values[:, others], left, tolerance / share if share > 0 else 1.0, len(others))
    points = np.concatenate([there, others[rule.points]])
    order = np.argsort(points)
    return Rule(points[order], np.concatenate([kept[there], rule.weights])[order], rule.missed * share)


class _Normal:
    """Normal equations of the points that are in, and their Cholesky factor: only what changes is made or moved.

    Of both the lower triangle is kept, in the corner of an array that has room for more.
    """

    def __init__(self) -> None:
        self._count = 0
        self._grams, self._factors = np.zeros((0, 0)), np.zeros((0, 0))
        self._whole = True  # whether there is a factor: there is none where points do the same

    def enter(self, beside: FloatArray, among: FloatArray) -> None:
        """Add points, by their products with those that are in (k, b) and among each other (b, b)."""
        k, n = self._count, self._count + len(among)
        if n > len(self._grams):
            self._grams, self._factors = (np.pad(one[:k, :k], (0, 2 * n - k)) for one in (self._grams, self._factors))
        self._grams[k:n, :k], self._grams[k:n, k:n] = beside.T, among
        if self._whole and k:
            across = solve_triangular(self._factors[:k, :k], beside, lower=True, check_finite=False)
            self._factors[k:n, :k] = across.T
        self._count = n
        self._go_on(k)

    def leave(self, out: NDArray[np.bool_]) -> None:
        """Leave out some of the points (k,)."""
        first = int(np.argmax(out))
        behind = first + np.flatnonzero(~out[first:])
        n = first + len(behind)
        self._grams[first:n, :first] = self._grams[behind, :first]
        self._grams[first:n, first:n] = self._grams[np.ix_(behind, behind)]
        self._factors[first:n, :first] = self._factors[behind, :first]
        self._count = n
        self._go_on(first)

    def _go_on(self, j: int) -> None:
        """Make the rest of the factor from that of the first points, of which there are j, and their part across."""
        n, j = self._count, j if self._whole else 0
        across = self._factors[j:n, :j]
        corner = _raised(self._grams[j:n, j:n], LEAST) - across @ across.T
        try:
            self._factors[j:n, j:n] = cholesky(corner, lower=True, check_finite=False)
            self._whole = True
        except LinAlgError:
            self._whole = False

    def solved(self, right: FloatArray) -> FloatArray:
        """Return the weights (k,) for right sides (k,)."""
        n = self._count
        if self._whole:
            factor = self._factors[:n, :n]
            half = solve_triangular(factor, right, lower=True, check_finite=False)
            return np.asarray(solve_triangular(factor, half, lower=True, trans=1, check_finite=False))
        gram = np.tril(self._grams[:n, :n])
        gram += np.tril(gram, -1).T
        for more in RAISED:
            try:
                return np.asarray(cho_solve(cho_factor(_raised(gram, more)), right))
            except LinAlgError:
                continue
        return np.asarray(np.linalg.lstsq(gram, right, rcond=1e-10)[0])


def _raised(gram: FloatArray, more: float) -> FloatArray:
    raised = gram.copy()
    raised[np.diag_indices_from(gram)] *= 1 + more
    return raised


class Mixture:
    """Sums of many rows at random, a few hundred in place of all: norms stay the same on average.

    Each row goes to a few of the sums with random signs (sparse embedding: J. Nelson, H. L. Nguyễn, FOCS 2013).
    """

    def __init__(self, size: int, points: int, seed: int) -> None:
        self.values, self.integrals = np.zeros((size, points)), np.zeros(size)
        self._random = np.random.default_rng(seed)

    def add(self, values: FloatArray, integrals: FloatArray) -> None:
        """Add rows (r, n) with their integrals (r,), no more than there are sums."""
        for _ in range(TIMES):
            where = self._random.permutation(len(self.integrals))[: len(values)]
            signs = self._random.choice([-1.0, 1.0], len(values)) / np.sqrt(TIMES)
            self.values[where] += signs[:, None] * values
            self.integrals[where] += signs * integrals
