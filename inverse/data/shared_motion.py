"""Errors that all data of a scan share, because its registration is uncertain.

A point that was put at X, and a displacement d measured along the unit vector a there, belong in truth to

    X* = e^[ω](X − c) + c + τ   and   e^[ω]a,   (ω, τ) ~ N(0, LLᵀ).

To first order d differs from what is predicted for X and a by G(ω, τ), the derivative of (e^[ω]a)·u(X*). And where the
specimen or the scanner has moved between the undeformed scan and that of load case k, by another motion (ω_k, τ_k), by
a·(ω_k × (X + u − c) + τ_k). The errors of the data have then the covariance σ² + GLLᵀGᵀ + …: the six unknowns of a
motion, on which the data depend linearly, are integrated out. The displacements u are the model's: at the mean of the
prior before the search for the mode, then at the mode.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forward.findings import Finding
from forward.model import FloatArray, SolveError
from inverse.data.measurements import Measurements
from inverse.data.noise import Noise
from inverse.data.registration import Rigid, slopes
from inverse.fields.low_rank import Spectrum
from uq.evaluation.request import Evaluate, Request

STEP = 1e-4  # of the extent of the points: how far they are moved for derivatives
DETERMINED = 1.0  # eigenvalue from which on data say more about a motion than the registration

# Parameters (d,) → what errors the data share there: rows (k, m), in their units, by the names of them in `Noise`.
Shared = Callable[[FloatArray], Mapping[str, Any]]


@dataclass(frozen=True, eq=False)
class SharedMotion:
    """Uncertain rigid motions of m data.

    Parameters
    ----------
    places
        Where (m, 3) they are (m).
    along
        Directions (m, 3) of what was measured.
    cases
        Numbers (m,) of their load cases, in ascending order.
    root
        (k, 6): Lᵀ of the registration; may be empty.
    between
        Standard deviations (6,) of the motions between scans (rad, m), or zeros.
    centre
        c (3,).
    project
        Puts points (n, 3) back on the surface; None if they may lie anywhere.
    """

    places: FloatArray
    along: FloatArray
    cases: NDArray[np.int64]
    root: FloatArray
    between: FloatArray
    centre: FloatArray
    project: Callable[[FloatArray], FloatArray] | None = None

    @classmethod
    def of(cls, data: Measurements, project: Callable[[FloatArray], FloatArray] | None = None) -> SharedMotion | None:
        """Return those of data, of which some may be at no place, as forces; None if none of it can move.

        Points are put back by `project`, as of the class.
        """
        registered = data.registered
        root = np.zeros((0, 6)) if registered is None or not registered.uncertain else registered.root
        root = root[np.linalg.norm(root, axis=1) > 0]
        there = data.placed
        if not there.any() or not (len(root) or any(data.between)):
            return None
        known = np.where(there[:, None], data.places, data.places[there][0])
        centre = known[there].mean(axis=0) if registered is None else registered.centre
        return cls(known, data.along, data.cases, root, np.repeat(data.between, 3), centre, project)

    @cached_property
    def steps(self) -> FloatArray:
        """Motions (k, 6) by which points are moved, parallel to the rows of the root; the largest moves are small."""
        extent = float(np.ptp(self.places, axis=0).max() or 1.0)
        size = np.linalg.norm(slopes(self.places, self.centre) @ self.root.T, axis=1).max(axis=0, initial=0.0)
        return np.asarray(self.root * (STEP * extent / np.maximum(size, 1e-300))[:, None])

    @cached_property
    def observed(self) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.int64], FloatArray]:
        """Places (n, 3), axes (n,), load cases (n,) and directions (n, 3) of what must be known of a state."""
        m = len(self.places)
        moved = [Rigid().moved(step, self.centre)(self.places) for step in self.steps]
        if self.project is not None:
            moved = [self.project(points) for points in moved]
        places = np.concatenate([np.repeat(self.places, 3, axis=0), *moved])
        axes = np.concatenate([np.tile([0, 1, 2], m), np.zeros(m * len(moved), dtype=np.int64)])
        cases = np.concatenate([np.repeat(self.cases, 3), np.tile(self.cases, len(moved))])
        along = np.concatenate([np.tile(np.eye(3), (m, 1)), np.tile(self.along, (len(moved), 1))])
        order = self._order
        return places[order], axes[order], cases[order], along[order]

    @cached_property
    def _order(self) -> NDArray[np.intp]:
        cases = np.concatenate([np.repeat(self.cases, 3), np.tile(self.cases, len(self.root))])
        return np.argsort(cases, kind="stable")

    def errors_by(self, evaluate: Evaluate) -> Shared:
        """Return the function parameters (d,) → what the data share, given the model of what is observed.

        It raises `SolveError` where that has no answer.
        """

        def errors(point: FloatArray) -> Mapping[str, FloatArray]:
            found = evaluate(Request(point[None]))
            for failure in found.failures:
                raise SolveError(failure.reason)
            return {"shared": self.errors(found.outputs[0])}

        return errors

    def errors(self, outputs: FloatArray) -> FloatArray:
        """Return what the data share (k, m), given the observed outputs (n,) of a state."""
        m = len(self.places)
        values = np.empty(len(outputs))
        values[self._order] = outputs
        u = values[: 3 * m].reshape(m, 3)
        moved = values[3 * m :].reshape(len(self.root), m)
        rows = []
        for step, root, there in zip(self.steps, self.root, moved, strict=True):
            size = np.linalg.norm(root) / np.linalg.norm(step)
            # (e^[ω]a)·u(X*) is measured as that along a: the direction turns too.
            turned = np.cross(step[:3], self.along)
            rows.append(size * (there - (self.along * u).sum(axis=1) + (turned * u).sum(axis=1)))
        if self.between.any():
            each = np.einsum("ma,mak->km", self.along, slopes(self.places + u, self.centre)) * self.between[:, None]
            rows += [row * (self.cases == case) for case in np.unique(self.cases) for row in each]
        return np.array(rows).reshape(-1, m)


def together(one: Shared | None, other: Shared | None) -> Shared | None:
    """Return what errors data share for two reasons; None if for neither."""
    if one is None or other is None:
        return one or other
    return lambda point: {**one(point), **other(point)}


def said(values: FloatArray) -> Finding:
    """Say what data determine, given the eigenvalues (k,) of `determined`."""
    seen, count = int((values > DETERMINED).sum()), len(values)
    lost = "" if seen == count else f"; {count - seen} cannot be separated from the unknowns and the noise"
    return Finding("motions", "note", {"count": count, "seen": seen, "lost": lost})


def determined(spectrum: Spectrum, noise: Noise, root: FloatArray) -> FloatArray:
    """Return eigenvalues (k,), descending, of what the data say about shared errors, over what is known of them before.

    What the unknowns explain, by the spectrum at the mode, cannot be told from a motion; `root` is √ (m,) of the
    weights of the data.
    """
    assert noise.shared is not None
    G = root * noise.shared / noise.scale
    images = noise.coloured(spectrum.images)
    # (I + AAᵀ)⁻¹ = I − Q diag(s²/(1 + s²)) Qᵀ with the images of the whole model, without these errors.
    _, sizes, rows = np.linalg.svd(images, full_matrices=False)
    seen = G @ rows.T
    S: FloatArray = G @ G.T - (seen * (sizes**2 / (1 + sizes**2))) @ seen.T
    return np.asarray(np.maximum(np.linalg.eigvalsh(S)[::-1], 0.0))
