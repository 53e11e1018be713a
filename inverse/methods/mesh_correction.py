"""Posteriors corrected for the error of the mesh: found at the mode on finer meshes, and again at the next mode.

Each round solves on the finer meshes at the mode, corrects the model there (`inverse.data.noise`) and
searches on from that mode, until the error at the new mode moves no unknown any more. Of few parameters the derivatives
of the error are known too. Of a field they are left out: they move its mode by Γ_post(A_f − A)ᵀr, a share of its
deviations as small as that by which the mesh changes the derivatives A of what the data see well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from forward.model import FloatArray
from forward.phases import phase
from inverse.criticism.finer import Finer, Look, MeshFound, evidence_moved, parameters_moved
from inverse.data.measurements import Measurements
from inverse.data.noise import ModelError, Noise, Trend
from inverse.fields.field_posterior import FieldPosterior
from inverse.fields.newton_cg import SolvedField
from inverse.low_dimensional.laplace import Laplace, deviations, laplace
from inverse.low_dimensional.posterior import Density, Posterior
from uq.evaluation.request import Request

Treatment = Literal["correct", "report"]
S = TypeVar("S")
# An error, None where nothing tells it; what it does; and how far it moves unknowns at most.
Seen = tuple[ModelError | None, MeshFound, float]
# Standard deviations of what finer meshes still miss: of the pattern of the difference between them and of the error
# itself, over these, and datum by datum, over the difference (chosen by `python -m benchmarks meshes`).
OF_DIFFERENCE, OF_ERROR, OF_DATUM = 0.35, 0.1, 0.3
# And along each direction of a field that the data determine (chosen by `python -m benchmarks meshes_of_fields`).
OF_DIRECTION = 0.5
EXCEEDS = 0.2  # of a datum's noise, or of an unknown's deviation, from which on the error of the mesh is corrected
SETTLED = 0.1  # deviations of an unknown that are left when it is
ROUNDS = 5


def told(error: FloatArray, count: float, say: Callable[[str], None]) -> float:
    """Say what the mesh does to `count` data at the mean of the prior, over the noise, before the search; its size."""
    size, largest = float(np.sqrt((error**2).sum() / count)), float(np.abs(error).max())
    words = f"at the mean of the prior the error of the mesh is {size:.2g} standard deviations of the noise"
    done = "it will be looked at again at the mode, and corrected where it exceeds a fifth"
    say(f"{words} (root mean square; at most {largest:.2g}); {done}")
    return size


@phase("solving on finer meshes")
def before_few(posterior: Posterior, finer: Finer, say: Callable[[str], None]) -> float:
    """Hold the error of the mesh at the mean of the prior against the noise, before the search; its size.

    NaN where there is no answer there.
    """
    point = posterior.inputs.mean
    look, _ = finer.look(point)
    own = posterior.evaluate(Request(point[None], start=posterior.start))
    if look is None or own.failures:
        return np.nan
    error = (look.outputs - own.outputs[0])[posterior.which] / posterior.noise.sigma
    return told(error, error.size, say)


def error_of(look: Look, outputs: FloatArray, data: Measurements) -> ModelError:
    """Return the error of a mesh on which a model has outputs (m,)."""
    error = look.outputs - outputs
    root = np.concatenate([uncertain(error, look.between, data), along_curves(look, data)])
    return ModelError(error, root, OF_DATUM * beside(look.between, data))


def beside(between: FloatArray, data: Measurements) -> FloatArray:
    """Return the sizes (m,) of differences between finer meshes, of outputs as root mean squares along their curves.

    Of a datum and those before and after it, over their noise: where the difference changes its sign it is small, and
    errors need not be.
    """
    squares = (between / data.sigma) ** 2
    for curve in np.unique(data.curves[~data.placed]):
        rows = np.flatnonzero(data.curves == curve)
        rows = rows[np.argsort(data.cases[rows], kind="stable")]
        pairs = np.pad(squares[rows], 1, constant_values=np.nan)
        squares[rows] = np.nanmean([pairs[:-2], pairs[1:-1], pairs[2:]], axis=0)
    return np.asarray(np.sqrt(squares) * data.sigma)


def uncertain(error: FloatArray, between: FloatArray, data: Measurements) -> FloatArray:
    """Return Uᵀ (k, m): what finer meshes still miss, by the error (m,) and by the difference (m,) between them.

    Both are patterns, of which the rest is extrapolated by one factor; in truth it is another in each load case, for
    each component, and varies slowly over the body: the data say which of these they are, and where.
    """
    somewhere, points, groups = data.placed, data.places, data.kinds
    seen = points[somewhere] if somewhere.any() else np.zeros((1, 3))
    low, high = seen.min(axis=0), seen.max(axis=0)
    across = np.zeros((len(between), 3))
    across[somewhere] = 2 * (points[somewhere] - low) / np.where(high > low, high - low, 1.0) - (high > low)
    shapes = [np.ones(len(between)), *across.T]
    patterns = (OF_DIFFERENCE * between, OF_ERROR * error)
    rows = [
        pattern * shape * (groups == group) for pattern in patterns for group in np.unique(groups) for shape in shapes
    ]
    found = np.array(rows).reshape(-1, len(between))
    return np.asarray(found[np.abs(found).max(axis=1, initial=0.0) > 0])


def along_curves(look: Look, data: Measurements) -> FloatArray:
    """Return rows (k, m) of what is uncertain of outputs besides: a factor of each curve, as a stiffness would be.

    Its size is the root mean square of the difference over that of the outputs, both over the noise. Where differences
    change their sign along a curve, errors need not, and independent ones would vanish in a mean over many data.
    """
    mine = data.curves == np.unique(data.curves[~data.placed])[:, None]
    mine = mine[[len(np.unique(data.kinds[row])) > 1 for row in mine]]
    weights = mine / data.sigma
    apart, sizes = (np.linalg.norm(weights * one, axis=1, keepdims=True) for one in (look.between, look.outputs))
    share = np.divide(apart, sizes, out=np.zeros_like(sizes), where=sizes > 0)
    return np.asarray(OF_DIFFERENCE * share * mine * look.outputs)


def along(images: FloatArray, between: FloatArray, noise: Noise) -> FloatArray:
    """Return rows (r, m) of what is uncertain along the directions of a field, in addition to `uncertain`.

    What the data determine best is what few patterns of all data determine, and a rest that is small in every datum may
    lie along these: there it counts as much as the difference (m,) between the finer meshes. The images A u (r, m) of
    orthogonal directions u of the field are orthogonal patterns in independent errors, those without the errors of the
    mesh.
    """
    patterns = images / np.maximum(np.linalg.norm(images, axis=1, keepdims=True), 1e-300)
    seen = OF_DIRECTION * np.abs(patterns @ noise.whitened(between / noise.scale))
    return np.asarray(seen[:, None] * noise.coloured(patterns) * noise.scale)


def part(look: Look, which: NDArray[np.int64] | slice) -> Look:
    """Return what is said of some of the outputs."""
    return Look(look.outputs[which], look.between[which], None if look.tangents is None else look.tangents[which])


def _rounds(
    here: S, looked: Callable[[S], Seen], again: Callable[[S, ModelError], S], treatment: Treatment
) -> tuple[S, MeshFound]:
    """Look at the error of the mesh where a search has ended, and search again with it, until it moves nothing more."""
    known: MeshFound | None = None
    while True:
        error, found, largest = looked(here)
        if error is None:
            return here, found if known is None else replace(known, corrected=True, settled=False)
        solves, corrected = 1 if known is None else known.solves + 1, known is not None
        known = replace(found, corrected=corrected, settled=not corrected or largest <= SETTLED, solves=solves)
        small = max(largest, float(np.abs(known.error).max())) <= EXCEEDS
        if treatment == "report" or (known.settled if corrected else small) or solves == ROUNDS:
            return here, known
        here = again(here, error)


@phase("correcting the error of the mesh")
def corrected_few(
    posterior: Posterior, gaussian: Laplace, finer: Finer, data: Measurements, treatment: Treatment
) -> tuple[Posterior, Laplace, MeshFound]:
    """Look at the error of the mesh at the mode, and correct it where it is not small.

    Raises `SolveError` if the model has no answer at the mode.
    """
    d = len(posterior.inputs.names)

    def looked(here: tuple[Posterior, Laplace]) -> Seen:
        posterior, gaussian = here
        x, mesh, noise = gaussian.mode[None], posterior.noise.model, posterior.noise
        at = posterior.at(x, derivatives=True)
        point = at.parameters[0]
        look, why = finer.look(point, tangents=True)
        if look is None:
            return None, MeshFound.unknown(why, posterior.data.size, d, 0 if finer.solve is None else 1), 0.0
        assert at.tangents is not None
        tangents = at.tangents[0, posterior.which]
        look, outputs = part(look, posterior.which), at.everything[0, posterior.which]
        found = error_of(look, outputs, data)
        if look.tangents is not None:
            slopes = look.tangents - tangents
            trend = Trend(point, outputs, tangents, slopes, np.zeros(len(outputs)), posterior.inputs.std)
            found = replace(found, trend=trend)
        scale, slopes = posterior.scale(x)[0], posterior.inputs.from_normals(x[:, :d])[1][0]
        root = np.sqrt(noise.information(posterior.residuals(at.outputs, x)))[0]
        A = posterior.sensitivities(at)[0] * root[:, None]
        widths = deviations(posterior, gaussian)
        rest = found.error if mesh is None else found.error - mesh.at(point[None], outputs[None])[0]
        shift = parameters_moved(posterior, gaussian, A, root * noise.whitened(rest / scale)) / widths
        factor = 1.0 if noise.factor is None else posterior.physical(x)[0, -1]
        largest, left = np.abs(shift).max(), np.zeros(d)
        if mesh is not None:
            gain = slopes @ np.linalg.solve(gaussian.hessian[:d, :d], (root[:, None] * A).T)
            left = _left(noise.whitened(gain) / scale, mesh) / widths
            # The size of the noise that the covariance was made for must be that of this mode too.
            largest = max(largest, abs(np.log(factor / mesh.scale)))
        added = _evidence(posterior, at, found.error)
        known = MeshFound("", found.error / (factor * noise.sigma), shift, left, log_evidence=added)
        return replace(found, scale=float(factor)), known, float(largest)

    def again(here: tuple[Posterior, Laplace], mesh: ModelError) -> tuple[Posterior, Laplace]:
        corrected = replace(here[0], noise=replace(posterior.noise, model=mesh))
        return corrected, laplace(corrected, starts=1, first=here[1].mode, exact=False)

    (there, best), known = _rounds((posterior, gaussian), looked, again, treatment)
    if known.corrected:
        best = laplace(there, starts=1, first=best.mode)
        moved_by = there.physical(best.mode[None])[0] - there.physical(gaussian.mode[None])[0]
        known = replace(known, shift=moved_by[:d] / deviations(there, best))
    return there, best, known


def _evidence(posterior: Posterior, at: Density, error: FloatArray) -> float:
    """What predictions that are larger by `error` (m,) add to ln Z of the model that is linear at a point."""
    noise = replace(posterior.noise, model=None)
    alone = replace(posterior, noise=noise)
    d, s = len(posterior.inputs.names), float((alone.scale(at.x) / noise.scale)[0, 0])
    A = s * alone.sensitivities(at)[0]
    residual = noise.whitened((posterior.data - at.everything[0, posterior.which]) / noise.scale)
    return evidence_moved(A, residual + A @ at.x[0, :d], noise.whitened(error / noise.scale), noise.factor)


@phase("correcting the error of the mesh")
def corrected_field(
    posterior: FieldPosterior,
    solve: Callable[[FieldPosterior, FloatArray | None], SolvedField],
    finer: Finer,
    data: Measurements,
    treatment: Treatment,
    weights: FloatArray,
) -> tuple[SolvedField, FloatArray, MeshFound]:
    """Do the same for a field of N values: what was solved last, how far its mode moves (N,), and what was found.

    The mode of a posterior, here not corrected, is found from ξ (N,) or from the centre of the prior, with the Gaussian
    there. Weights of the vertices (N,) are those in the mean over the body.
    """
    first = solve(posterior, None)
    images, moved = first.found.spectrum.images, np.full(len(weights), np.nan)

    def looked(here: SolvedField) -> Seen:
        nonlocal moved
        point, mesh = here.mode.point, here.mode.point.posterior.noise.model
        look, why = finer.look(point.values)
        if look is None:
            return None, MeshFound.unknown(why, len(posterior.data), 1, 0 if finer.solve is None else 1), 0.0
        found = error_of(look, np.asarray(point.solution.outputs), data)
        found = replace(found, root=np.concatenate([found.root, along(images, look.between, posterior.seen)]))
        # Nothing is said of data that are not there.
        over = found.error * posterior.measured / point.posterior.noise.sigma
        moved = field_moved(here, found.error if mesh is None else found.error - mesh.error)
        width = here.found.marginal(weights)[1]
        shift = np.array([weights @ moved / width])
        largest = max(abs(float(shift[0])), float(np.sqrt(((moved / here.found.std) ** 2).mean())))
        left = np.zeros(1) if mesh is None else _left(_gain(here, weights)[None], mesh) / width
        return found, MeshFound("", over, shift, left), largest

    def again(here: SolvedField, mesh: ModelError) -> SolvedField:
        return solve(replace(posterior, noise=replace(posterior.noise, model=mesh)), here.mode.point.whitened)

    here, known = _rounds(first, looked, again, treatment)
    if known.corrected:
        moved = here.found.mean - first.found.mean
        known = replace(known, shift=np.array([weights @ moved / here.found.marginal(weights)[1]]))
    return here, moved, known


def field_moved(here: SolvedField, error: FloatArray) -> FloatArray:
    """Return how far (…, N) the mode of a field moves where data are predicted larger by (…, n), in their units."""
    point, spectrum = here.mode.point, here.found.spectrum
    over = point.root * point.posterior.seen.whitened(point.posterior.weights * error)
    return np.asarray(-(over @ spectrum.images.T / (1 + spectrum.values)) @ here.found.directions)


def _gain(here: SolvedField, weights: FloatArray) -> FloatArray:
    """How far (n,) the mean of a field over the body moves with each of the data, in their units."""
    point, spectrum = here.mode.point, here.found.spectrum
    over = spectrum.images.T @ (here.found.directions @ weights / (1 + spectrum.values))
    return np.asarray(point.posterior.weights * point.posterior.seen.whitened(point.root * over))


def _left(gain: FloatArray, mesh: ModelError) -> FloatArray:
    """Standard deviations (k,) by what is uncertain of a mesh, of estimates with derivatives (k, n) by the data."""
    return np.asarray(np.linalg.norm(np.hstack([gain @ mesh.root.T, gain * mesh.apart]), axis=1))
