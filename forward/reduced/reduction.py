"""From a body and its snapshots to a reduced model. Runs in one process, with FEniCSx."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from forward.fem.model import HyperelasticModel
from forward.model import FloatArray, ModelError
from forward.observables.functionals import Integral, Linear
from forward.observables.max_displacement import MaxDisplacement
from forward.observables.max_von_mises import MaxVonMises
from forward.observables.reaction import Reaction
from forward.reduced import basis, blocks, cubature
from forward.reduced.data import LevelData, Output, Points, ReducedData
from forward.reduced.integrands import Integrand, Sampler, of_density, of_form
from forward.reduced.kernels import Kernel
from forward.reduced.level import LENGTH
from forward.reduced.limits import mistakes

CANDIDATES = 20_000  # points among which a rule is chosen, of more a random part
KEPT_WHOLE = 600  # points of a boundary that are all kept
NEAR_PEAK = 0.75  # of the largest stress of any snapshot, from which on points may have the largest
SEED = 7
DIRECTIONS = 16  # parameters up to which states are differentiated by each of them
FEW = 6  # random directions otherwise
FINER = 3.0  # how many times less the points of the larger model miss
OF_TANGENTS = 0.5  # weight of changes of the state by one standard deviation, beside the states


@dataclass(frozen=True)
class Sizes:
    """How large a reduced model is.

    Parameters
    ----------
    modes
        Number of modes; None: as many as `truncation` needs.
    truncation
        What the modes may leave of the snapshots: root mean square in the norm of the stiffness, relative.
    cubature
        What the points may miss of the forces of the snapshots, relative.
    more
        How many modes of states the nested larger model has besides, and as many of adjoints as the model has modes.
    cut
        Into how many blocks along each axis the body is cut, which have modes of their own; or its regions are blocks.
    full
        Places (f, 3) whose blocks are kept in full; their displacements are modes besides.
    """

    modes: int | None = None
    truncation: float = 3e-3
    cubature: float = 3e-3
    more: int = 120
    cut: tuple[int, int, int] | Literal["regions"] | None = None
    full: tuple[tuple[float, float, float], ...] = ()


@dataclass(frozen=True, eq=False)
class Snapshots:
    """Solutions of the full model, in canonical order.

    Attributes
    ----------
    parameters
        Where (s, d).
    states
        States (s, U).
    adjoints
        K⁻ᵀ ∂ψ/∂u (k, U) of outputs there.
    tangents
        Changes (k, U) of the states along the parameters, by about one standard deviation of these.
    outputs
        Outputs (s, m).
    """

    parameters: FloatArray
    states: FloatArray
    adjoints: FloatArray
    tangents: FloatArray
    outputs: FloatArray

    def with_others(self, others: Snapshots) -> Snapshots:
        """Return these and others."""
        names = ("parameters", "states", "adjoints", "tangents", "outputs")
        return Snapshots(*(np.concatenate([getattr(self, name), getattr(others, name)]) for name in names))


def adjoint_states(model: HyperelasticModel, solution: Any) -> FloatArray:
    """Return K⁻ᵀ ∂ψ/∂u (m, U_local) of all outputs at a solution; collective."""
    loads = np.array(solution.loads(np.eye(len(model.outputs))))
    loads[:, model.equations.fixed] = 0
    return np.asarray(solution.solve(loads, transpose=True))


def directions(spread: FloatArray, point: FloatArray) -> FloatArray:
    """Return the directions (k, d) along which states are differentiated at a point (d,).

    Those of all parameters if they are few, otherwise a few random ones that depend on the point.
    """
    if len(spread) <= DIRECTIONS:
        return np.diag(spread)
    seed = np.frombuffer(np.ascontiguousarray(point).tobytes(), dtype=np.uint32)
    return np.asarray(np.random.default_rng(seed).standard_normal((FEW, len(spread))) * spread)


class Reduction:
    """A body that is being reduced: what does not change from one round of snapshots to the next.

    Parameters
    ----------
    model
        The body, in this process alone.
    nominal, spread
        Means and standard deviations (d,) of its parameters.
    """

    def __init__(self, model: HyperelasticModel, nominal: FloatArray, spread: FloatArray) -> None:
        for said in mistakes(model.spec):
            raise ModelError(said)
        self.model, self.nominal, self.spread = model, nominal, spread
        self.equations = equations = model.equations
        spec = model.spec
        self._paths = model.parameters
        numbers = [i for i in equations.scalars if not model.parameters[i].startswith("displacements.")]
        self._numbers = np.array(numbers, dtype=np.int64)
        self._names = tuple(model.parameters[i] for i in numbers)
        self._at_rest()
        self._lifts = self._lifted()
        self._kept: NDArray[np.bool_] | None = None  # which cells are kept in full
        self._densities: list[tuple[Sampler, Integral]] = []
        self._tests, self._outputs = self._of_outputs()
        self._dead_rows: list[tuple[int, float, FloatArray]] = []
        equations.at_load(1.0)  # constants are read as they are now, and loads count in full
        potential = equations.virtual_work_of_energy
        self._integrands = of_form(equations, potential, self._names)
        for load, work in zip(spec.loads, equations.virtual_works, strict=True):
            numbers_of = {
                path: equations.number(path) for path in spec.scalars if path.startswith(f"loads.{load.label}.")
            }
            if equations.is_dead(work, numbers_of):
                self._dead_rows += self._dead(work, numbers_of)
            else:
                self._integrands += of_form(equations, work, self._names)
        self._samplers = [Sampler(equations, one) for one in self._integrands]

    # --- the body at rest --------------------------------------------------------------------------------------------

    def _at_rest(self) -> None:
        equations = self.equations
        equations.latest.begin()
        equations.set_parameters(self.nominal)
        equations.at_load(0.0)
        equations.set_state(np.zeros(equations.size))

    def inner(self, rows: FloatArray) -> FloatArray:
        """Return the products of rows (k, U_local) with the stiffness at rest, with zeros where the body is held."""
        self._at_rest()
        found = np.array([self.equations.stiffness_times(row) for row in rows]).reshape(rows.shape)
        found[:, self.equations.fixed] = 0
        return found

    def _lifted(self) -> list[tuple[int, float, FloatArray]]:
        """Fields that displacements by one metre make of the body at rest: parameter, value otherwise, field."""
        equations = self.equations
        found: list[tuple[int, float, FloatArray]] = []
        for path, mover in equations.movers.items():
            number = self._paths.index(path) if path in self._paths else -1
            value = equations.number(path)
            if number < 0 and value == 0:
                continue
            if not found:
                self._at_rest()
                equations.factorise(np.zeros(equations.size))
            w = np.zeros(equations.size)
            w[equations.fixed] = mover
            right = -equations.stiffness_times(w)
            right[equations.fixed] = mover
            found.append((number, value, equations.back_substitute(right)))
        return found

    # --- loads and outputs -------------------------------------------------------------------------------------------

    def _dead(self, work: Any, numbers: dict[str, float]) -> list[tuple[int, float, FloatArray]]:
        equations = self.equations
        found: list[tuple[int, float, FloatArray]] = []
        assemble = equations.vector(work)
        equations.at_load(1.0)
        kept = {path: float(equations.constants[path].value) for path in numbers}
        for path, value in numbers.items():
            for other in numbers:
                equations.constants[other].value = float(other == path)
            number = self._paths.index(path) if path in self._paths else -1
            found.append((number, value, assemble()))
        for path, value in kept.items():
            equations.constants[path].value = value
        return found

    def _of_outputs(self) -> tuple[list[FloatArray], list[Callable[[FloatArray, FloatArray], Output]]]:
        """Return test fields (U_local,), and for each output what makes it once the coordinate fields are known."""
        model = self.model
        tests: list[FloatArray] = []
        made: list[Callable[[FloatArray, FloatArray], Output]] = []
        for one, functional in zip(model.spec.outputs, model.functionals, strict=True):
            if isinstance(one, Reaction):
                made.append(_made(one, "work", which=len(tests)))
                tests.append(functional.w)  # type: ignore[attr-defined]
            elif isinstance(one, MaxDisplacement):
                axis = LENGTH if one.component == "magnitude" else "xyz".index(one.component)
                made.append(_made(one, "largest", which=axis))
            elif isinstance(one, MaxVonMises):
                made.append(self._peak(one, functional))
            elif isinstance(functional, Linear):
                made.append(_linear(one, functional.gradient()))
            elif isinstance(functional, Integral):
                made.append(self._integral(one, functional))
            else:
                message = f"the output '{one.name}' cannot be reduced"
                raise ModelError(message)
        return tests, made

    def _integral(self, one: Any, functional: Integral) -> Callable[[FloatArray, FloatArray], Output]:
        found = of_density(self.equations, functional.density, functional.measure, self._names)
        if found.boundary is not None:
            message = f"the output '{one.name}' is an integral over a boundary, which a reduced model does not have"
            raise ModelError(message)
        self._densities.append((Sampler(self.equations, found), functional))
        return _made(one, "integral", which=len(self._densities) - 1, size=functional.size, density=found.written)

    def _peak(self, one: MaxVonMises, functional: Any) -> Callable[[FloatArray, FloatArray], Output]:
        found = of_density(self.equations, functional.stress, self.equations.dx, self._names)
        sampler = Sampler(self.equations, found)
        numbers = self._numbers

        def make(rows: FloatArray, parameters: FloatArray) -> Output:
            """Keep the points that are near the largest stress in any snapshot, and those in cells kept in full."""
            near = np.zeros(sampler.count, dtype=bool)
            if self._kept is not None:
                near |= np.repeat(self._kept, sampler.count // len(self._kept))
            everywhere = sampler.points(np.zeros((0, rows.shape[1])))
            kernel = Kernel(found.written.tape, len(found.components) + len(everywhere.given) + len(everywhere.logs))
            for state, point in zip(self._training, parameters, strict=True):
                inputs = self._inputs(sampler.components(state), everywhere, point)
                stress = kernel(inputs, point[numbers])[0]
                near |= stress >= NEAR_PEAK * stress.max()
            points = sampler.points(rows, np.flatnonzero(near))
            return Output(one.name, one.unit, "peak", density=found.written, points=points)

        return make

    def _inputs(self, components: FloatArray, points: Points, parameters: FloatArray) -> FloatArray:
        logs = [log + slopes @ parameters[self.equations.fields[i].positions] for i, log, slopes in points.logs]
        return np.ascontiguousarray(np.vstack([components, points.given, *logs]))

    # --- reduction ---------------------------------------------------------------------------------------------------

    def reduced(self, snapshots: Snapshots, sizes: Sizes) -> ReducedData:
        """Return the reduced model of snapshots."""
        layout = self.equations.layout
        rest, every = self._held(snapshots)
        self._kept = None
        if sizes.cut is None:
            none = np.zeros((0, self.equations.size))
            modes, squares = basis.orthonormal(every, self.inner, none, self._most(sizes))
            n = sizes.modes or basis.enough(squares, sizes.truncation)
            left = float(np.sqrt(max(1 - squares[:n].sum() / squares.sum(), 0.0)))
        else:
            modes, n, self._kept = self._of_blocks(every, sizes)
            left = self._left(every, modes[:n])
        n = min(n, len(modes))
        modes = modes[: n + sizes.more]
        modes = np.vstack([modes, self._of_adjoints(layout.scatter(snapshots.adjoints), modes, n)])
        spread = np.maximum(snapshots.outputs.std(axis=0), 1e-300)
        return self._of_modes(modes, n, rest, snapshots.parameters, sizes, spread, left)

    def enriched(self, data: ReducedData, answers: Snapshots, sizes: Sizes) -> ReducedData:
        """Return a reduced model of this body that holds further solutions too, with a mode more for each of them.

        The modes that it had stay the first ones; the new ones hold what these leave of the solutions, and those of the
        larger model what is left of changes along the parameters. Points are chosen again, for all snapshots as the
        modes hold them.
        """
        layout, n = self.equations.layout, data.levels[0].modes
        old = layout.scatter(data.fields)[data.before :]
        rest, every = self._held(answers)
        fresh = basis.orthonormal(rest, self.inner, old[:n], len(rest))[0]
        first = np.vstack([old[:n], fresh])
        beside = np.vstack([old[n:], self._normed(every[len(rest) :])])
        modes = np.vstack([first, basis.orthonormal(beside, self.inner, first, len(beside))[0]])
        modes = np.vstack([modes, self._of_adjoints(layout.scatter(answers.adjoints), modes, len(fresh))])
        whole = np.vstack([data.coordinates[:, data.before :] @ old, rest])
        parameters = np.vstack([data.snapshots, answers.parameters])
        self._kept = None
        truncation = self._left(rest, first)
        spread = np.array(data.about["spread"])
        return self._of_modes(
            modes, len(first), whole, parameters, sizes, spread, max(truncation, data.about["truncation"])
        )

    def _moved(self, parameters: FloatArray) -> FloatArray:
        """Return the coordinates (s, l) of what prescribed displacements move."""
        moved = np.array([[v if n < 0 else p[n] for n, v, _ in self._lifts] for p in parameters])
        return moved.reshape(len(parameters), len(self._lifts))

    @property
    def _lift_rows(self) -> FloatArray:
        return np.array([row for _, _, row in self._lifts]).reshape(-1, self.equations.size)

    def _held(self, snapshots: Snapshots) -> tuple[FloatArray, FloatArray]:
        """Return states (s, U_local) less what prescribed displacements move, and all rows that modes are to hold."""
        layout, fixed = self.equations.layout, self.equations.fixed
        rest = layout.scatter(snapshots.states) - self._moved(snapshots.parameters) @ self._lift_rows
        tangents = OF_TANGENTS * layout.scatter(snapshots.tangents)
        rest[:, fixed] = 0
        tangents[:, fixed] = 0
        return rest, np.vstack([rest, tangents])

    def _of_modes(
        self,
        modes: FloatArray,
        n: int,
        rest: FloatArray,
        parameters: FloatArray,
        sizes: Sizes,
        spread: FloatArray,
        truncation: float,
    ) -> ReducedData:
        """Return the reduced model of the first n of some modes, and the larger one of all of them.

        Parameters
        ----------
        modes
            Modes (N, U_local).
        n
            How many the model has.
        rest, parameters
            Snapshots (s, U_local) less what prescribed displacements move, and their parameters (s, d).
        sizes
            What the points may miss.
        spread, truncation
            Standard deviations (m,) of the outputs, and what the modes leave, for those who read it.
        """
        model, layout = self.model, self.equations.layout
        lifts, moved = self._lift_rows, self._moved(parameters)
        self._training = rest + moved @ lifts
        tests = np.array(self._tests).reshape(-1, self.equations.size)
        rows = np.vstack([lifts, tests, modes])
        coordinates = np.hstack([moved, np.zeros((len(rest), len(tests))), rest @ self.inner(modes).T])
        outputs = tuple(make(rows, parameters) for make in self._outputs)
        levels, told = self._levels(rows, coordinates, parameters, (n, len(modes)), sizes)
        whole = layout.gather(rows)
        assert whole is not None
        cells, kind = layout.cells()
        fields = self.equations.fields
        linear = [(number, value, rows @ force) for number, value, force in self._dead_rows]
        return ReducedData(
            spec=model.spec.model_dump(mode="json", exclude_none=True),
            parameters=model.parameters,
            nominal=self.nominal,
            spread=self.spread,
            lower=parameters.min(axis=0),
            upper=parameters.max(axis=0),
            numbers=self._numbers,
            coefficients=tuple((field.field.label, field.positions) for field in fields),
            lifts=tuple((number, value) for number, value, _ in self._lifts),
            tests=len(tests),
            dead=tuple(linear),
            works=tuple(one.written for one in self._integrands),
            levels=levels,
            outputs=outputs,
            fields=whole,
            places=layout.coordinates,
            cells=cells,
            cell_kind=kind,
            regions=model.space.regions(),
            factors=tuple(self._factor(i) for i in range(len(fields))),
            snapshots=parameters,
            coordinates=coordinates,
            about={
                "snapshots": len(rest),
                "modes": n,
                "modes of the larger model": len(modes),
                "truncation": truncation,
                "unknowns": int(layout.size),
                "spread": spread.tolist(),
                **told,
            },
        )

    def _of_blocks(self, rows: FloatArray, sizes: Sizes) -> tuple[FloatArray, int, NDArray[np.bool_]]:
        """Return modes (k, U_local) of the blocks, how many of them the model has, and which cells are kept in full."""
        layout, equations = self.equations.layout, self.equations
        cells, _ = layout.cells()
        labels = self.model.space.regions() if sizes.cut == "regions" else None
        if sizes.cut == "regions" and labels is None:
            message = "the body has no regions, expected numbers of blocks along each axis"
            raise ModelError(message)
        if labels is None:
            assert isinstance(sizes.cut, tuple)
            labels = blocks.cut(cells, layout.coordinates, sizes.cut)
        parts = blocks.partition(labels, cells, layout.coordinates, np.array(sizes.full).reshape(-1, 3))
        self._at_rest()
        canonical = np.round(layout.scatter(np.arange(float(equations.size))[None])[0]).astype(np.int64)
        local = np.argsort(canonical)
        stiffness = equations.sparse_stiffness()[local][:, local]
        free = np.ones(equations.size, dtype=bool)
        free[canonical[equations.fixed]] = False
        whole = layout.gather(rows)
        assert whole is not None
        most = sizes.modes or len(rows)
        found = blocks.modes(parts, stiffness, free, whole, most + sizes.more)
        in_full = parts.full[parts.of_node]
        kept = np.zeros(len(cells), dtype=bool)
        kept[layout.by_cell(np.arange(len(cells)))] = in_full[cells].all(axis=1)
        return layout.scatter(found), int((np.repeat(in_full, 3) & free).sum()) + most, kept

    def _left(self, rows: FloatArray, modes: FloatArray) -> float:
        """What orthonormal modes leave of rows: root mean square in the norm of the stiffness, relative."""
        squares = ((rows @ self.inner(modes).T) ** 2).sum()
        return float(np.sqrt(max(1 - squares / max((rows * self.inner(rows)).sum(), 1e-300), 0.0)))

    @staticmethod
    def _most(sizes: Sizes) -> float:
        """Return how many modes the larger model may have, or what these may leave of the snapshots."""
        return sizes.truncation / 10 if sizes.modes is None else sizes.modes + sizes.more

    def _of_adjoints(self, adjoints: FloatArray, modes: FloatArray, most: int) -> FloatArray:
        """Return modes of adjoints beside those of states; never the same ones, to which the residual is orthogonal."""
        if not len(adjoints):
            return np.zeros((0, self.equations.size))
        return basis.orthonormal(self._normed(adjoints), self.inner, modes, most)[0]

    def _normed(self, rows: FloatArray) -> FloatArray:
        """Return rows (k, U_local) of norm 1."""
        return np.asarray(rows / np.sqrt(np.maximum((rows * self.inner(rows)).sum(axis=1), 1e-300))[:, None])

    def _factor(self, number: int) -> tuple[FloatArray, FloatArray, float]:
        """Return the logarithm of a random field at the nodes, its slopes, and the variance that is kept."""
        model, field = self.model, self.equations.fields[number]
        d = len(model.parameters)
        points = np.zeros((1 + len(field.positions), d))
        points[1 + np.arange(len(field.positions)), field.positions] = 1.0
        logs = np.log(model.space.factors(points)[field.field.label])
        return logs[0], (logs[1:] - logs[0]).T.copy(), float(field.kept)

    def _levels(
        self,
        rows: FloatArray,
        coordinates: FloatArray,
        parameters: FloatArray,
        counts: tuple[int, int],
        sizes: Sizes,
    ) -> tuple[tuple[LevelData, ...], dict[str, Any]]:
        """Choose the points of each level; all of those in cells that are kept in full."""
        before = len(self._lifts) + len(self._tests)
        levels: list[LevelData] = []
        told: dict[str, Any] = {}
        in_full = [np.zeros(sampler.count, dtype=bool) for sampler in self._samplers]
        if self._kept is not None:
            in_full[0] = np.repeat(self._kept, self._samplers[0].count // len(self._kept))
        candidates = [self._candidates(sampler, some) for sampler, some in zip(self._samplers, in_full, strict=True)]
        known = [sampler.points(rows, some) for sampler, some in zip(self._samplers, candidates, strict=True)]
        of_densities = [sampler.points(rows, candidates[0]) for sampler, _ in self._densities]
        for level, n in enumerate(counts):
            works, integrals = [], []
            for number, (integrand, points) in enumerate(zip(self._integrands, known, strict=True)):
                every = np.arange(len(points.weights))
                if number > 0 and (len(every) <= KEPT_WHOLE or in_full[0].any()):
                    works.append(points.some(every, points.weights, before + n))
                    continue
                sizes_of = (counts[0],) if level == 0 else counts
                training = _Training(rows, coordinates, parameters, before, n, sizes_of)
                beside = of_densities if number == 0 else []
                missed = sizes.cubature / (1 if level == 0 else FINER)
                fixed = in_full[number][candidates[number]]
                rule = self._rule(number, integrand, points, beside, training, missed, fixed)
                works.append(points.some(rule.points, rule.weights, before + n))
                if number == 0:
                    integrals = [one.some(rule.points, rule.weights, before + n) for one in of_densities]
                    kind = "points" if level == 0 else "points of the larger model"
                    told |= {kind: len(rule.points), f"missed by the {kind}": rule.missed}
            levels.append(LevelData(n, tuple(works), tuple(integrals)))
        return tuple(levels), told

    @staticmethod
    def _candidates(sampler: Sampler, kept: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Number the points among which a rule is chosen, and those (n,) that are kept."""
        if sampler.count <= CANDIDATES:
            return np.arange(sampler.count)
        some = np.random.default_rng(SEED).choice(sampler.count, CANDIDATES, replace=False)
        return np.union1d(some, np.flatnonzero(kept))

    def _rule(
        self,
        number: int,
        integrand: Integrand,
        points: Points,
        densities: list[Points],
        training: _Training,
        missed: float,
        fixed: NDArray[np.bool_],
    ) -> cubature.Rule:
        """Choose points and weights that integrate the works of projected snapshots, densities of outputs, and volume.

        The works of each state are scaled to its forces, and mixed at random: a few hundred sums stand for all of them.
        """
        equations, numbers = self.equations, self._numbers
        kernel = _kernel(integrand.written.tape, len(numbers))
        of_densities = (
            [_kernel(one.integrand.written.tape, len(numbers)) for one, _ in self._densities] if densities else []
        )
        tested = training.tested(len(self._tests))
        tests = len(self._tests)
        whole = len(points.weights) == self._samplers[number].count
        size = min(training.count * len(tested), 4 * len(tested) + 400)
        mixture = cubature.Mixture(size, len(points.weights), SEED)
        rows: list[FloatArray] = []
        m, n = points.fields.shape[:2]
        fields = points.fields[:, :, tested].transpose(0, 2, 1).copy()
        for c, point in training:
            T = kernel(
                self._inputs((points.fields.reshape(m * n, -1) @ c).reshape(m, n), points, point), point[numbers]
            )
            values = T[0] * fields[0]
            for k in range(1, m):
                values += T[k] * fields[k]
            targets = values @ points.weights
            totals = []
            for of, kernel_of in zip(densities, of_densities, strict=True):
                density = kernel_of(self._inputs(of.fields @ c, of, point), point[numbers])[0]
                rows.append(density)
                totals.append(float(density @ of.weights))
            if not whole:
                equations.set_parameters(point)
                equations.at_load(0.0)
                equations.set_state(c @ training.rows)
                targets = training.rows[tested] @ equations.imbalance()
                totals = [functional.value() * functional.size for _, functional in self._densities]
            for i, total in enumerate(totals):
                rows[i - len(totals)] = rows[i - len(totals)] / (total or 1.0)
            scale = np.full(len(tested), float(np.linalg.norm(targets[tests:])) or 1.0)
            scale[:tests] = np.where(targets[:tests] == 0, scale[:tests], np.abs(targets[:tests]))
            mixture.add(values / scale[:, None], targets / scale)
        volume = np.ones((1, len(points.weights))) / self._samplers[number].weights.sum()
        every = np.vstack([mixture.values, *rows, volume])
        aims = np.concatenate([mixture.integrals, np.ones(len(rows) + 1)])
        rule = cubature.beside(every, aims, missed, np.where(fixed, points.weights, 0.0))
        if whole and rule.missed > missed:  # then all points are needed
            return cubature.Rule(np.arange(len(points.weights)), points.weights, 0.0)
        return rule


@dataclass(frozen=True, eq=False)
class _Training:
    """Snapshots projected on so many modes, for a rule that tests with the first `modes`."""

    rows: FloatArray
    coordinates: FloatArray
    parameters: FloatArray
    before: int
    modes: int
    sizes: tuple[int, ...]

    @property
    def count(self) -> int:
        return len(self.coordinates) * len(self.sizes)

    def tested(self, tests: int) -> NDArray[np.int64]:
        return np.arange(self.before - tests, self.before + self.modes)

    def __iter__(self) -> Iterator[tuple[FloatArray, FloatArray]]:
        for c, point in zip(self.coordinates, self.parameters, strict=True):
            for size in self.sizes:
                kept = np.zeros(len(self.rows))
                kept[: self.before + size] = c[: self.before + size]
                yield kept, point


def _kernel(tape: Any, numbers: int) -> Kernel:
    return Kernel(tape, tape.inputs - numbers)


def _made(one: Any, kind: str, **rest: Any) -> Callable[[FloatArray, FloatArray], Output]:
    return lambda rows, parameters: Output(one.name, one.unit, kind, **rest)


def _linear(one: Any, gradient: FloatArray) -> Callable[[FloatArray, FloatArray], Output]:
    return lambda rows, parameters: Output(one.name, one.unit, "linear", row=rows @ gradient)
