"""From a body and its snapshots to a reduced model. Runs in one process, with FEniCSx."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from forward.fem.model import HyperelasticModel
from forward.model import FloatArray, ModelError
from forward.phases import phase
from forward.reduced.data import ReducedData, body_of
from forward.reduced.integrands import Integrand, of_form
from forward.reduced.modes import AtRest, boxes, enough
from forward.reduced.newton import stable
from forward.reduced.outputs import Outputs
from forward.reduced.reduced_equations import ReducedEquations
from forward.reduced.rules import STATES, Rules, Training
from forward.reduced.snapshots import Snapshots, solved
from forward.reduced.spec import mistakes

OF_ADJOINTS = 3  # modes of states that the larger model has besides, for one of adjoints
LOOKED_AT = 4  # snapshots at which the larger model must be stable
ROUNDING = 1e-10  # spread of an output, over the largest value of its unit, below which it is round-off
LEAST_SPREAD = 1e-300  # of an output that is zero, as all of its unit are
OF_TANGENTS = 0.5  # weight of changes of the state by one standard deviation, beside the states
KINDS = 3  # of modes in the mixed form: displacements, pressures, and their supports


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
        How many modes of states the nested larger model has besides; of adjoints it has as many as the model has modes,
        and at least a third of these.
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


class Reduction:
    """A body that is being reduced: what does not change from one round of snapshots to the next.

    The body is in this process alone; `nominal` and `spread` are means and standard deviations (d,) of its parameters.
    """

    def __init__(self, model: HyperelasticModel, nominal: FloatArray, spread: FloatArray) -> None:
        for said in mistakes(model.spec):
            raise ModelError(said)
        self.model, self.nominal, self.spread = model, nominal, spread
        self.equations = model.equations
        self._rest = AtRest(model, nominal)
        numbers = [i for i in self.equations.scalars if not model.parameters[i].startswith("displacements.")]
        self._numbers = np.array(numbers, dtype=np.int64)
        names = tuple(model.parameters[i] for i in numbers)
        self._outputs = Outputs(model, names)
        self._dead_rows: list[tuple[int, float, FloatArray]] = []
        self.equations.at_load(1.0)  # constants are read as they are now, and loads count in full
        works, whole = self._works(names)
        self._tapes = tuple(one.tape for one in works)
        self._rules = Rules(self.equations, works, whole, self._outputs.densities, self._numbers)

    # --- loads -------------------------------------------------------------------------------------------------------

    def _works(self, names: tuple[str, ...]) -> tuple[list[Integrand], list[bool]]:
        """Read virtual works that are evaluated at points, and whether at all of them: tools are exact everywhere."""
        equations, spec = self.equations, self.model.spec
        works = of_form(equations, equations.virtual_work_of_energy, names)
        whole = [False] * len(works)
        for load, work in zip(spec.loads, equations.virtual_works, strict=True):
            numbers = {path: equations.number(path) for path in spec.scalars if path.startswith(f"loads.{load.label}.")}
            if equations.is_dead(work, numbers):
                self._dead_rows += self._dead(work, numbers)
                continue
            found = of_form(equations, work, names)
            works += found
            whole += [load.contact] * len(found)
        return works, whole

    def _dead(self, work: Any, numbers: dict[str, float]) -> list[tuple[int, float, FloatArray]]:
        equations, paths = self.equations, self.model.parameters
        found: list[tuple[int, float, FloatArray]] = []
        assemble = equations.vector(work)
        kept = {path: float(equations.constants[path].value) for path in numbers}
        for path, value in numbers.items():
            for other in numbers:
                equations.constants[other].value = float(other == path)
            number = paths.index(path) if path in paths else -1
            found.append((number, value, assemble()))
        for path, value in kept.items():
            equations.constants[path].value = value
        return found

    # --- modes -------------------------------------------------------------------------------------------------------

    @phase("reducing")
    def reduced(self, snapshots: Snapshots, sizes: Sizes) -> ReducedData:
        """Return the reduced model of snapshots."""
        rest, every = self._held(snapshots)
        kept = None
        if sizes.cut is None:
            none = np.zeros((0, self.equations.size))
            first, squares = self._rest.modes(every, none, sizes.modes or sizes.truncation)
            n, most = enough(squares, sizes.truncation), enough(squares, sizes.truncation / 10)
            n = sizes.modes or n
            left = float(np.sqrt(max(1 - squares[:n].sum() / squares.sum(), 0.0)))
            more = sizes.more // (1 if self.equations.p is None else KINDS)
            more = more if sizes.modes else min(more, most - n)
            modes, n = np.vstack([first, self._rest.modes(every, first, more)[0]]), len(first)
        else:
            full = np.array(sizes.full).reshape(-1, 3)
            most, layout = sizes.modes or len(every), self.equations.layout
            if sizes.cut == "regions":
                labels = self.model.space.regions()
            else:
                labels = boxes(layout.cells()[0], layout.coordinates, sizes.cut)
            if labels is None:
                raise ModelError("the body has no regions, expected numbers of blocks along each axis")
            modes, n, kept = self._rest.of_blocks(every, labels, full, most, sizes.more)
            left = self._rest.left(every, modes[:n])
            n = min(n, len(modes))
            modes = modes[: n + sizes.more]
        adjoints = self.equations.layout.scatter(snapshots.adjoints)
        modes = np.vstack([modes, self._of_adjoints(adjoints, modes, max(n, sizes.more // OF_ADJOINTS))])
        outputs = snapshots.outputs
        told = {
            "spread": self._spread(snapshots).tolist(),
            "lowest": outputs.min(axis=0).tolist(),
            "highest": outputs.max(axis=0).tolist(),
        }
        return self._of_modes(modes, n, rest, snapshots.parameters, adjoints, sizes, told, left, kept)

    def _spread(self, snapshots: Snapshots) -> FloatArray:
        """Return the standard deviations (m,) of the outputs; of one that is round-off, the size of those of its unit.

        Such an output vanishes by symmetry, or depends on nothing: its errors are measured against the others.
        """
        units = [output.unit for output in self.model.spec.returned]
        sizes = np.abs(snapshots.outputs).max(axis=0)
        of_unit = {unit: max(size for size, one in zip(sizes, units, strict=True) if one == unit) for unit in units}
        if "m" in of_unit:
            of_unit["m"] = max(of_unit["m"], float(np.abs(snapshots.states[:, : self.model.space.displacements]).max()))
        size, found = np.array([of_unit[unit] for unit in units]), snapshots.outputs.std(axis=0)
        return np.maximum(np.where(found > ROUNDING * size, found, size), LEAST_SPREAD)

    @phase("enriching")
    def enriched(self, data: ReducedData, answers: Snapshots, sizes: Sizes) -> ReducedData:
        """Return a reduced model of this body that holds further solutions too, with a mode more for each of them.

        The modes that it had stay the first ones; the new ones hold what these leave of the solutions, and those of the
        larger model what is left of changes along the parameters. Points are chosen again, for all snapshots as the
        modes hold them.
        """
        layout, n = self.equations.layout, data.levels[0].modes
        old = layout.scatter(data.fields)[data.before :]
        rest, every = self._held(answers)
        fresh = self._rest.modes(rest, old[:n], len(rest))[0]
        first = np.vstack([old[:n], fresh])
        beside = np.vstack([old[n:], self._rest.normed(every[len(rest) :])])
        modes = np.vstack([first, self._rest.modes(beside, first, len(beside))[0]])
        adjoints = layout.scatter(answers.adjoints)
        modes = np.vstack([modes, self._of_adjoints(adjoints, modes, len(fresh))])
        whole = np.vstack([data.coordinates[:, data.before :] @ old, rest])
        parameters = np.vstack([data.snapshots, answers.parameters])
        truncation = max(self._rest.left(rest, first), data.about["truncation"])
        told: dict[str, list[float]] = {
            name: data.about[name] for name in ("spread", "lowest", "highest") if name in data.about
        }
        return self._of_modes(modes, len(first), whole, parameters, adjoints, sizes, told, truncation, None)

    def places(self, states: FloatArray, parameters: FloatArray) -> NDArray[np.int64]:
        """Return where the body has its largest values (s, m) in states (s, U) at parameters (s, d).

        Numbers of nodes or of quadrature points; −1 for outputs that are no largest value.
        """
        rows = self.equations.layout.scatter(states)
        return np.array([self._outputs.places(row, point) for row, point in zip(rows, parameters, strict=True)])

    def _of_adjoints(self, adjoints: FloatArray, modes: FloatArray, most: int) -> FloatArray:
        """Return modes of adjoints beside those of states; never the same ones, to which the residual is orthogonal."""
        if not len(adjoints):
            return np.zeros((0, self.equations.size))
        most = most if self.equations.p is None else max(most // KINDS, 1)
        return self._rest.modes(self._rest.normed(adjoints), modes, most)[0]

    def _moved(self, parameters: FloatArray) -> FloatArray:
        """Return the coordinates (s, l) of what prescribed displacements move."""
        moved = np.array([[v if n < 0 else p[n] for n, v, _ in self._rest.lifts] for p in parameters])
        return moved.reshape(len(parameters), len(self._rest.lifts))

    @property
    def _lift_rows(self) -> FloatArray:
        return np.array([row for _, _, row in self._rest.lifts]).reshape(-1, self.equations.size)

    def _held(self, snapshots: Snapshots) -> tuple[FloatArray, FloatArray]:
        """Return states (s, U_local) less what prescribed displacements move, and all rows that modes are to hold."""
        layout, fixed = self.equations.layout, self.equations.fixed
        rest = layout.scatter(snapshots.states) - self._moved(snapshots.parameters) @ self._lift_rows
        tangents = OF_TANGENTS * layout.scatter(snapshots.tangents)
        rest[:, fixed] = 0
        tangents[:, fixed] = 0
        return rest, np.vstack([rest, tangents])

    # --- the model ---------------------------------------------------------------------------------------------------

    def _of_modes(
        self,
        modes: FloatArray,
        n: int,
        rest: FloatArray,
        parameters: FloatArray,
        adjoints: FloatArray,
        sizes: Sizes,
        of_outputs: dict[str, list[float]],
        truncation: float,
        kept: NDArray[np.bool_] | None,
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
        adjoints
            Those of all outputs (k, U_local) at the last of these snapshots.
        sizes
            What the points may miss.
        of_outputs, truncation
            Standard deviations (m,) of the outputs and their range, and what the modes leave, for those who read it.
        kept
            Which cells are kept in full; None for none.
        """
        model, layout = self.model, self.equations.layout
        lifts, moved, tests = self._lift_rows, self._moved(parameters), self._outputs.tests
        rows = np.vstack([lifts, tests, modes])
        coordinates = np.hstack([moved, np.zeros((len(rest), len(tests))), rest @ self._rest.inner(modes).T])
        outputs = self._outputs.made(rows, rest + moved @ lifts, parameters, kept)
        on_outputs = self._on_outputs(adjoints, modes, np.array(of_outputs["spread"]), len(rest))
        training = Training(rows, coordinates, parameters, len(lifts) + len(tests), len(tests), on_outputs)
        whole = layout.gather(rows)
        assert whole is not None
        cells, kind = layout.cells()
        fields = self.equations.fields
        data = ReducedData(
            spec=model.spec.model_dump(mode="json", exclude_none=True),
            parameters=model.parameters,
            nominal=self.nominal,
            spread=self.spread,
            lower=parameters.min(axis=0),
            upper=parameters.max(axis=0),
            numbers=self._numbers,
            coefficients=tuple((field.field.label, field.positions) for field in fields),
            lifts=tuple((number, value) for number, value, _ in self._rest.lifts),
            tests=len(tests),
            dead=tuple((number, value, rows @ force) for number, value, force in self._dead_rows),
            works=self._tapes,
            levels=(),
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
                **of_outputs,
            },
        )
        untested = model.spec.solver.accept_unstable
        for shaken in (0, min(len(modes), STATES)):
            levels, told = self._rules.levels(training, (n, len(modes)), sizes.cubature, shaken, kept)
            data = replace(data, levels=levels, about=data.about | told)
            if untested or _definite(data):
                break
        return data

    def _on_outputs(self, adjoints: FloatArray, modes: FloatArray, spread: FloatArray, count: int) -> FloatArray:
        """Return what forces on the modes do to outputs: coordinates (s, m, N) of adjoints over the spreads (m,).

        Zero at snapshots of which the adjoints (k, U_local) are not known, which are the first ones of so many, and for
        outputs that never differ from zero.
        """
        m = len(spread) if len(adjoints) else 0
        found = np.zeros((count, m, len(modes)))
        if m:
            known = (adjoints @ self._rest.inner(modes).T).reshape(-1, m, len(modes))
            found[count - len(known) :] = np.where(spread > LEAST_SPREAD, 1 / spread, 0.0)[:, None] * known
        return found

    def _factor(self, number: int) -> tuple[FloatArray, FloatArray, float]:
        """Return the logarithm of a random field at the nodes, its slopes, and the variance that is kept."""
        model, field = self.model, self.equations.fields[number]
        d = len(model.parameters)
        points = np.zeros((1 + len(field.positions), d))
        points[1 + np.arange(len(field.positions)), field.positions] = 1.0
        logs = np.log(model.space.factors(points)[field.field.label])
        return logs[0], (logs[1:] - logs[0]).T.copy(), float(field.kept)


def _definite(data: ReducedData) -> bool:
    """Whether the larger model is stable at the snapshots, as the body is.

    Modes on which no force of any snapshot works, by symmetry, are not integrated by rules that are trained on forces.
    """
    level = ReducedEquations(data, data.levels[-1], np.zeros(0, dtype=np.int64))
    for i in np.linspace(0, len(data.snapshots) - 1, LOOKED_AT).round().astype(int):
        _, K, _ = level.stiffness(data.coordinates[i], data.snapshots[i])
        if not stable(K[level.free, level.free], level.pressures):
            return False
    return True


def enriched(data: ReducedData, points: FloatArray, cubature: float = 1e-3) -> ReducedData:
    """Solve the full model at parameters (k, d), and return a reduced model that holds these too.

    Such points are where a reduced model with a tolerance has asked the full one (`ReducedModel.asked`).
    It stays as it is; `cubature` is what the points of the new one may miss of the forces, relative.

    Raises
    ------
    SolveError
        Where the full model has no answer.
    """
    model: HyperelasticModel = body_of(data.spec).build(MPI.COMM_SELF, data.parameters)
    answers = solved(model, points, data.spread)
    return Reduction(model, data.nominal, data.spread).enriched(data, answers, Sizes(cubature=cubature))
