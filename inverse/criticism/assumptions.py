"""What an inversion has taken for granted, and how far its answers move if that is otherwise.

Numbers of the model that are not inferred, the scales of the data and the places of points are as stated. With the mode
x̂ of ½|r|² + ½|x|², r = Γ^(−½)(ψ(ω(x), s) − y), a number s that is larger by δs moves it by

    δx̂ = −H⁻¹ (Aᵀ ∂r/∂s + Σ r ∂²r/∂x∂s) δs,   A = ∂r/∂x,

by the implicit function theorem. The sum follows from ∂r/∂s at points beside the mode, one for each unknown; of fields
it is left out. Where the unknowns swallow the change, residuals cannot show it (J. Brynjarsdóttir, A. O'Hagan, Inverse
Problems 30 (2014) 114007).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from forward.findings import Finding
from forward.model import FloatArray, ForwardModel, Guess, SolveError
from forward.readable import number, told
from inverse.criticism.finer import parameters_moved
from inverse.data.measurements import AXES, STEP_OF, Measurements
from inverse.data.shared_motion import Shared
from uq.evaluation.request import Evaluate, Request, Start

if TYPE_CHECKING:
    import xarray as xr

    from inverse.low_dimensional.laplace import Laplace
    from inverse.low_dimensional.posterior import Density, Posterior

PART = 0.01  # of a number, or of the size of the body for a place, or an angle (rad), by which it may be otherwise
SHOWN, SEEN = 3, 0.1  # of how many is told, and of which size (deviations) on
BENT = 0.2  # deviations by which second order may move an answer
OFF = 3.0  # deviations from which on what the data say of it contradicts what is stated
BESIDE = 0.05  # of a posterior deviation, by which points are beside the mode
STEP = 1e-4  # of the extent of a body, by which points are moved for derivatives


class Assumption(NamedTuple):
    """Something that is taken for granted, and by how much it may be larger in size, in its unit.

    Of numbers that may be otherwise by a part of themselves, `part` is that; 0 of others.
    """

    name: str
    size: float
    unit: str
    part: float = 0.0

    def __str__(self) -> str:
        """Say what is otherwise."""
        kind, _, what = self.name.removeprefix("data.").partition(".")
        far = f"{100 * self.part:g} %" if self.part else told(self.size, self.unit)
        if self.name.startswith("data.") and what:
            return f"points are {far} farther along {what}" if kind == "shift" else f"measured {what} is {far} larger"
        return f"{self.name} is {far} larger"


def quantities(data: Measurements, units: Mapping[str, str]) -> list[str]:
    """Return what was measured (m,): displacements, or outputs by their names, whatever the step of a path.

    Outputs in m, by their units, are displacements too: one camera or ruler has measured them. Tests have stresses.
    """
    return [
        "displacement" if place or units.get(name) == "m" else STEP_OF.sub("", name) or "stress"
        for name, place in zip(data.names.tolist(), data.placed, strict=True)
    ]


def of_data(found: Sequence[Measurements | None], units: Mapping[str, str], extent: float) -> list[Assumption]:
    """Return what data sets on a body of some extent (m) take for granted: where points are, and the scales."""
    there = [data for data in found if data is not None]
    placed = any(data.placed.any() for data in there)
    scales = dict.fromkeys(name for data in there for name in quantities(data, units))
    shifts = [Assumption(f"data.shift.{axis}", PART * extent, "m") for axis in AXES if placed]
    return [*shifts, *(Assumption(f"data.scale.{name}", PART, "1", PART) for name in scales)]


Asked = tuple[FloatArray, FloatArray]  # outputs (n, M), and their derivatives (n, M, k) by the numbers that are held
# Parameters (n, d), values (n, k) of the numbers, and where states start, as it is known there.
Ask = Callable[[FloatArray, FloatArray, Any], Asked]


def by_evaluation(evaluate: Evaluate) -> Ask:
    """Ask a model with further parameters, from a `Start` or None."""

    def ask(points: FloatArray, values: FloatArray, start: Start | None) -> Asked:
        d = points.shape[1]
        near = None if start is None else _Beside(start, d)
        found = evaluate(Request(np.hstack([points, values]), tangents=True, start=near))
        for failure in found.failures:
            raise SolveError(failure.reason)
        assert found.tangents is not None
        return found.outputs, found.tangents[:, :, d:]

    return ask


def by_model(model: ForwardModel) -> Ask:
    """Ask the same of a model itself, from a state (U_local,) or None; collective."""

    def ask(points: FloatArray, values: FloatArray, state: FloatArray | None) -> Asked:
        d, k = points.shape[1], values.shape[1]
        solutions = [model.solve(point, Guess(state)) for point in np.hstack([points, values])]
        slopes = [solution.tangent(np.eye(k, d + k, d)).T for solution in solutions]
        return np.array([solution.outputs for solution in solutions]), np.array(slopes)

    return ask


@dataclass(frozen=True)
class _Beside:
    """A prediction of the state of a model that has further parameters; a `Start` without a reference."""

    start: Start
    count: int

    @property
    def reference(self) -> Any:
        """That of the model without them."""
        return self.start.reference

    def on(self, model: ForwardModel) -> Callable[[FloatArray], Guess]:
        """Return the function parameters → predicted state (U_local,)."""
        near = self.start.on(model)
        return lambda parameters: Guess(near(parameters[: self.count]).state)


@dataclass(frozen=True, eq=False)
class Moved:
    """Points of m data, moved a little along each axis both ways, where they stay in the body or on its surface.

    Parameters
    ----------
    data
        The data, of which some may be at no place, as forces.
    extent
        Of the body (m).
    nearest
        Puts points (n, 3) back into the body, or on its surface.
    on_surface
        Whether these are points of the surface, which stay there.
    """

    data: Measurements
    extent: float
    nearest: Callable[[FloatArray], FloatArray]
    on_surface: bool

    @cached_property
    def rows(self) -> NDArray[np.intp]:
        """Which data (r,) are at places."""
        return np.flatnonzero(self.data.placed)

    @cached_property
    def places(self) -> FloatArray:
        """Where they are moved to (3, 2, r, 3): along each axis, ahead and back."""
        steps = STEP * self.extent * np.eye(3)[:, None] * np.array([1.0, -1.0])[:, None]
        moved = self.data.places[self.rows] + steps[:, :, None]
        return np.asarray(self.nearest(moved.reshape(-1, 3)).reshape(moved.shape))

    @cached_property
    def order(self) -> NDArray[np.intp]:
        """The order by load cases of the data and, behind them, of these."""
        return np.argsort(np.append(self.data.cases, np.tile(self.data.cases[self.rows], 6)), kind="stable")

    def observed(self, model: Any) -> ForwardModel:
        """Return a specimen that is observed where the data are, and there; collective."""
        data, rows = self.data, self.rows
        places = np.concatenate([data.places, self.places.reshape(-1, 3)])
        axes, cases = (np.append(one, np.tile(one[rows], 6)) for one in (data.axes, data.cases))
        along = np.concatenate([data.along, np.tile(data.along[rows], (6, 1))])
        found: ForwardModel = model.observing(*(one[self.order] for one in (places, axes, cases, along)))
        return found

    def slopes(self, outputs: FloatArray) -> FloatArray:
        """Return derivatives (n, 3, m) of the data by a shift of all points, given the outputs there (n, 6r).

        Of points that cannot move one way, those of the other way.
        """
        n, step = len(outputs), STEP * self.extent
        ahead, back = np.moveaxis(outputs.reshape(n, 3, 2, len(self.rows)), 2, 0)
        apart = np.einsum("ara->ar", self.places[:, 0] - self.places[:, 1])
        far = np.full(apart.shape, 2 * step) if self.on_surface else apart
        found = np.zeros((n, 3, len(self.data)))
        found[:, :, self.rows] = np.divide(ahead - back, far, out=np.zeros(ahead.shape), where=far > 0.5 * step)
        return found


def merged(assumed: Sequence[Assumption], groups: Mapping[str, FloatArray]) -> tuple[list[Assumption], FloatArray]:
    """Return what is told of, and the weights (r, k) of all in it: what is uncertain together is one, before the rest.

    That which is not otherwise by one part is told of by its standard deviation.
    """
    shown, weights = list[Assumption](), np.array(list(groups.values())).reshape(len(groups), len(assumed))
    for name, row in zip(groups, weights, strict=True):
        members = [one for one, weight in zip(assumed, row, strict=True) if weight]
        parts = {one.part for one in members}
        part = parts.pop() if len(parts) == 1 else 0.0
        by_part = Assumption(name, part, "1", part) if part else Assumption(name, 1.0, "standard deviation")
        shown.append(by_part if len(members) > 1 else members[0])
    alone = ~weights.any(axis=0)
    return [*shown, *(assumed[k] for k in np.flatnonzero(alone))], np.vstack([weights, np.eye(len(assumed))[alone]])


@dataclass(frozen=True, eq=False)
class Assumptions:
    """What is taken for granted of m data, numbers of the model first.

    Attributes
    ----------
    data
        The data.
    numbers, beside
        Those of the model (k,), and of the data sets of a study.
    values
        Of the numbers (k,), as stated.
    units
        SI units of outputs, by their names.
    ask
        Asks the model with these numbers for the data and, where they are at places, for moved ones; None where there
        is nothing to ask.
    moved
        Tells how data change with the places; None of data at no places.
    groups
        What is uncertain, each independently of the others, by name: weights (k,) of all in it.
    """

    data: Measurements
    numbers: Sequence[Assumption]
    beside: Sequence[Assumption]
    values: FloatArray
    units: Mapping[str, str]
    ask: Ask | None
    moved: Moved | None = None
    groups: Mapping[str, FloatArray] = field(default_factory=dict)

    @property
    def all(self) -> list[Assumption]:
        """All of them."""
        return [*self.numbers, *self.beside]

    @cached_property
    def shown(self) -> tuple[list[Assumption], FloatArray]:
        """What is told of, as `merged`."""
        return merged(self.all, self.groups)

    @property
    def weights(self) -> FloatArray:
        """The weights (g, k) of all groups."""
        return np.array(list(self.groups.values())).reshape(len(self.groups), len(self.all))

    def changes(self, points: FloatArray, start: Any, *, predicted: bool = False) -> FloatArray:
        """Return by how much outputs (n, k, m) are larger if each is; NaN where the model has no answer.

        At parameters (n, d) or values of a field (1, N), from a prediction of the states. Of scales it is that of what
        was measured or, where it becomes an error that data share, `predicted`: else noise would count as signal, and
        answers be drawn to smaller data (Peelle's puzzle; G. D'Agostini, Nucl. Instrum. Methods A 346 (1994) 306–311).
        Raises `SolveError` of what is predicted, if the model has no answer.
        """
        n, m, moved = len(points), len(self.data), self.moved
        by_shift = {one.name: one.size for one in self.beside if one.name.startswith("data.shift.")}
        found, scaled = {one.name: np.zeros((n, m)) for one in (*self.numbers, *self.beside)}, self.data.values
        if self.ask is not None:
            try:
                outputs, slopes = self._asked(points, np.broadcast_to(self.values, (n, len(self.values))), start)
            except SolveError:
                if predicted:
                    raise
                return np.full((n, len(self.all), m), np.nan)
            found |= {one.name: one.size * slopes[:, :m, i] for i, one in enumerate(self.numbers)}
            scaled = outputs[:, :m] if predicted else scaled
            if moved is not None:
                by_axes = dict(zip(AXES, np.swapaxes(moved.slopes(outputs[:, m:]), 0, 1), strict=True))
                found |= {name: size * by_axes[name[-1]] for name, size in by_shift.items()}
        of = np.array(quantities(self.data, self.units))
        scales = [one for one in self.beside if one.name not in by_shift]
        found |= {one.name: -one.size * scaled * (of == one.name.split(".", 2)[-1]) for one in scales}
        rows = [np.broadcast_to(found[one.name], (n, m)) for one in self.all]
        return np.array(rows).reshape(-1, n, m).swapaxes(0, 1)

    def _asked(self, points: FloatArray, values: FloatArray, start: Any) -> Asked:
        """Ask, in the order of the data."""
        assert self.ask is not None
        outputs, slopes = self.ask(points, values, start)
        back = slice(None) if self.moved is None else np.argsort(self.moved.order)
        return outputs[:, back], slopes[:, back]

    def bends(self, point: FloatArray, start: Any) -> FloatArray:
        """Return what first order leaves out of the outputs (g, m) where each row of the uncertain is larger by itself.

        NaN where the model has no answer; scales and places are nearly linear.
        """
        m, k = len(self.data), len(self.numbers)
        more = self.weights[:, :k] * [one.size for one in self.numbers]
        found, some = np.zeros((len(more), m)), np.flatnonzero(more.any(axis=1))
        if len(some):
            values = self.values + np.vstack([np.zeros(k), more[some]])
            try:
                outputs, slopes = self._asked(np.broadcast_to(point, (len(values), len(point))), values, start)
                found[some] = outputs[1:, :m] - outputs[0, :m] - more[some] @ slopes[0, :m].T
            except SolveError:
                found[some] = np.nan
        return found

    def errors(self, points: FloatArray, start: Any, measured: NDArray[np.bool_] | bool = True) -> FloatArray:
        """Return what data share since some of it is uncertain (n, g, m), where `changes` are predicted.

        Those that are not measured (m,) share what is uncertain of the model only. Raises `SolveError` if the model has
        no answer.
        """
        changes = self.changes(points, start, predicted=True)
        changes[:, len(self.numbers) :] *= measured
        return np.asarray(self.weights @ changes)

    @property
    def shared(self) -> Shared | None:
        """The same at parameters (d,), by its name in `Noise`; None if nothing is uncertain."""
        return (lambda point: {"uncertain": self.errors(point[None], None)[0]}) if len(self.weights) else None


class Moves(NamedTuple):
    """How far k assumptions move the most probable parameters (k, d), and ln Z (k,), to first order.

    And how far (g, d) second order of those that are uncertain moves the parameters.
    """

    parameters: FloatArray
    log_evidence: FloatArray
    bends: FloatArray


def moved_by(posterior: Posterior, gaussian: Laplace, at: Density, assumed: Assumptions) -> Moves:
    """Return how far what is taken for granted moves a posterior, given it at its mode, with derivatives.

    Of ln Z what the fit at the mode adds; widths hardly change it.
    """
    d, noise, scale = len(posterior.inputs.names), posterior.noise, posterior.scale(at.x)[0]
    mode, L = gaussian.mode[:d], np.linalg.cholesky(np.linalg.inv(gaussian.hessian[:d, :d]))
    points, slopes = posterior.inputs.from_normals(np.vstack([mode, mode + BESIDE * L.T]))
    here, *beside = assumed.shown[1] @ assumed.changes(points, posterior.start)
    residual = posterior.residuals(at.outputs, at.x)[0]
    pull, A = noise.whitened(noise.score(residual)) / scale, posterior.sensitivities(at)[0]

    def moved(changes: FloatArray) -> FloatArray:
        over = noise.score_slope(residual) * noise.whitened(changes / scale)
        return parameters_moved(posterior, gaussian, A, over.T).T

    curved = np.array([(other - here) @ pull / BESIDE for other in beside])  # Σ r ∂²r/∂x∂s along the columns of L
    bends = moved(assumed.bends(points[0], posterior.start))
    return Moves(moved(here) - (slopes[0] @ L @ curved).T, -here @ pull, bends)


def findings(assumed: Sequence[Assumption], names: Sequence[str], shifts: FloatArray) -> list[Finding]:
    """Return a note of what moves the answers most, if it moves them.

    Given how far (k, c), in posterior deviations, each assumption moves each of the answers.
    """
    sizes, lines = np.nan_to_num(np.abs(shifts)), []
    for k in np.argsort(-sizes.max(axis=1, initial=0.0), kind="stable")[:SHOWN]:
        i = int(sizes[k].argmax())
        if sizes[k, i] >= SEEN:
            way = "larger" if shifts[k, i] > 0 else "smaller"
            lines.append(f"if {assumed[k]} than stated, {names[i]} is {number(sizes[k, i], 2)} deviations {way}")
    return [Finding("taken-for-granted", "note", {"listed": "; ".join(lines)})] if lines else []


def of_outputs(
    assumed: Sequence[Assumption], outputs: Sequence[str], changes: FloatArray, spread: FloatArray
) -> list[Finding]:
    """Return a note of what that is not random moves outputs most, by changes (k, m) over deviations (m,) of these.

    Nothing is said of outputs whose deviations are not known.
    """
    shifts = np.divide(changes, spread, out=np.full(changes.shape, np.nan), where=spread > 0)
    return [
        Finding("not-random", "note", {"listed": one.values["listed"]}) for one in findings(assumed, outputs, shifts)
    ]


def kept_in(of: xr.Dataset) -> list[Assumption]:
    """Return what results take for granted."""
    keys = (of[f"assumption{key}"].to_numpy().tolist() for key in ("", "_size", "_unit", "_part"))
    return [Assumption(str(name), size, str(unit), part) for name, size, unit, part in zip(*keys, strict=True)]


def findings_in(of: xr.Dataset) -> list[Finding]:
    """Return what the results of one data set, or of a candidate for one group, say of what is taken for granted."""
    answers = [str(name) for name in of["parameter"].values]
    shifts, bends = (
        of[f"assumption_{name}"].transpose(dim, "parameter").to_numpy()
        for name, dim in (("shift", "assumption"), ("bend", "uncertain"))
    )
    names = [str(name) for name in of["uncertain"].values]
    far = of["uncertain_mean"].to_numpy() if "uncertain_mean" in of else np.zeros(len(names))
    sampled = of["uncertain_sampled"].to_numpy() > 0 if "uncertain_sampled" in of else np.zeros(len(names), dtype=bool)
    there = [name for name, one in zip(names, sampled, strict=True) if one]
    told = [Finding("uncertain-sampled", "note", {"listed": ", ".join(there)})] if there else []
    bends = np.where(sampled[:, None], np.nan, bends)
    return [*findings(kept_in(of), answers, shifts), *told, *bent(names, answers, bends), *off(names, far)]


def off(names: Sequence[str], means: FloatArray) -> list[Finding]:
    """Warn of what the data say is farther off (g,), in its deviations, than what is stated makes likely."""
    return [
        Finding("uncertain-off", "warning", {"name": name, "size": abs(z), "way": "larger" if z > 0 else "smaller"})
        for name, z in zip(names, means, strict=True)
        if abs(z) > OFF
    ]


def bent(names: Sequence[str], answers: Sequence[str], shifts: FloatArray) -> list[Finding]:
    """Warn of what is too uncertain for first order, by how far (g, c), in deviations, second order moves answers."""
    found = []
    for name, row in zip(names, np.abs(shifts), strict=True):
        known = np.isfinite(row)
        if known.any() and row[known].max() > BENT:
            i = int(np.where(known, row, -1.0).argmax())
            found.append(Finding("uncertain-bent", "warning", {"name": name, "answer": answers[i], "size": row[i]}))
    return found
