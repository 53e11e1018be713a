"""What is to be said of the error of the mesh."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from forward.findings import Entry, Finding, entries
from forward.model import FloatArray
from forward.readable import told as in_words
from uq.estimators.estimate import estimate_of, holds
from uq.evaluation.request import Evaluations
from uq.findings import only_rounding

if TYPE_CHECKING:
    import xarray as xr

DECIDES = 3.0  # times the error of sampling: then more samples do not help
MANY = 10.0  # times a value: percentages beyond say nothing
LARGE = 0.1  # of a value: an error of the mesh that is to be looked at
ROUGH = 0.5  # of the error of the mesh: its doubt, above which its sign is all that is known
EXACT = 1e-9  # of a value: errors that are no more than that are rounding
LOOSE = 1e-8  # tolerance of the solver from which its error may be as large as one of a mesh
VISIBLE = 1e-3  # of a mean: doubts below do no harm
OF_FACETS = 1.25  # times what facets are estimated to hide, which it may be
FEWEST_ANSWERS = 2  # of estimates: one alone does not say how far it is from others
TINY = 1e-300
Names = NDArray[Any]  # of the outputs (m,)


class Told(NamedTuple):
    """What is known of a model beside its solutions.

    Attributes
    ----------
    units
        Of the outputs.
    never
        Outputs whose error of the mesh is not estimated at all.
    tolerance
        Of its solver, relative.
    """

    units: Mapping[str, str]
    never: frozenset[str] = frozenset()
    tolerance: float = 0.0


def doubts(dataset: xr.Dataset, estimates: Evaluations, told: Told) -> Iterator[Finding]:
    """Find what is not estimated, where the mesh decides, and where its error is large or not well known."""
    names = np.array([str(name) for name in dataset["output"].values])
    units, counts = told.units, ~only_rounding(dataset, told.units)
    yield from _of_estimates(names, estimates, told, counts)
    if not holds(dataset, "mean", "mesh"):
        if "nominal" in dataset:  # methods from outside may leave it out
            at_mean = estimate_of(dataset, "nominal")
            error, size = np.abs(at_mean.mesh), np.abs(at_mean.value)
            yield from _large(names, "value at the mean parameters", np.where(counts, error, 0.0), size)
            yield from _of_solver(names, np.where(counts, error, np.nan), size, told)
        return
    moments = estimate_of(dataset, "mean"), estimate_of(dataset, "std")
    (mean, std), sampling = (one.value for one in moments), moments[0].error
    size = np.maximum(np.abs(mean), std)  # a mean may be zero
    error, of_std = (np.where(counts, np.abs(one.mesh), 0.0) for one in moments)
    yield from _large(names, "mean", error, size)
    yield from _large(names, "standard deviation", of_std, std)
    yield from _unexplained(names, dataset, counts)
    yield from _of_solver(names, np.where(counts, error, np.nan), size, told)
    decides = (error > DECIDES * sampling) & (error > EXACT * size)
    if decides.any():
        listed = [
            Entry(name, f" {in_words(e, units.get(name, '1'))} against {in_words(s, units.get(name, '1'))}", e)
            for name, e, s in zip(names[decides], error[decides], sampling[decides], strict=True)
        ]
        yield Finding("mesh-decides", "note", about=tuple(listed))


def of_facets(names: Names, outputs: FloatArray, hidden: FloatArray) -> Iterator[Finding]:
    """Say what flat facets of a curved surface hide in outputs (m,), where anything does."""
    size = np.maximum(np.abs(outputs), TINY)
    if np.isnan(hidden).any():
        yield Finding("facets-unknown", "warning")
    some = np.abs(hidden) > VISIBLE * size
    if some.any():
        listed = [
            Entry(str(name), f" {min(share, MANY):.1%}", share)
            for name, share in zip(names[some], np.abs(hidden)[some] / size[some], strict=True)
        ]
        yield Finding("facets", "warning", about=tuple(listed))


def failed(why: str) -> Finding:
    """Say that the error of the mesh was to be estimated and is not known."""
    return Finding("mesh-unknown", "error", {"why": why})


def _unexplained(names: Names, dataset: xr.Dataset, counts: NDArray[np.bool_]) -> Iterator[Finding]:
    """Find errors of the mesh that vary with the parameters as no expansion says."""
    mean = estimate_of(dataset, "mean")
    hidden = OF_FACETS * np.abs(np.nan_to_num(dataset["mesh_error_facets"].to_numpy()))
    rough = mean.doubt - hidden > ROUGH * np.abs(mean.mesh)
    visible = mean.doubt > np.maximum(mean.error, VISIBLE * np.abs(mean.value))
    contradicted = dataset["mesh_error_unknown"].to_numpy() > ROUGH
    unclear = rough & visible & counts & ~contradicted
    if (contradicted & visible & counts).any():
        yield Finding("mesh-estimates-disagree", "note", about=entries(names[contradicted & visible & counts]))
    if unclear.any():
        yield Finding("mesh-error-varies", "note", about=entries(names[unclear]))


def _of_solver(names: Names, error: FloatArray, size: FloatArray, told: Told) -> Iterator[Finding]:
    """Find outputs that the solver may leave as far off as the mesh does."""
    hidden = error < told.tolerance * size
    if told.tolerance > LOOSE and hidden.any():
        yield Finding("solver-tolerance", "warning", {"tolerance": told.tolerance}, about=entries(names[hidden]))


def _of_estimates(names: Names, estimates: Evaluations, told: Told, counts: NDArray[np.bool_]) -> Iterator[Finding]:
    """Find estimates that failed, and outputs without any, by the reason."""
    n, ok = len(estimates.points), int(estimates.ok.sum())
    if ok < n:
        reason = estimates.failures[0].reason
        known = ok >= FEWEST_ANSWERS
        rest = "the others are used" if known else "so that nothing is known of the error of the mesh"
        values = {"lost": n - ok, "n": n, "reason": reason, "rest": rest}
        yield Finding("mesh-estimates-failed", "warning" if known else "error", values)
    if ok < FEWEST_ANSWERS:
        return
    assert estimates.mesh_errors is not None
    known = np.isfinite(estimates.mesh_errors[estimates.ok])
    never = np.isin(names, list(told.never))
    if never.any():
        yield Finding("mesh-never-estimated", "note", about=entries(names[never]))
    lost = ~known.all(axis=0) & ~never & counts
    if lost.any():
        missing = (~known).sum(axis=0)[lost]
        listed = [
            Entry(name, f" ({some} of {ok})", some) for name, some in zip(names[lost], missing.tolist(), strict=True)
        ]
        yield Finding("mesh-estimates-missing", "error", about=tuple(listed))


def _large(names: Names, word: str, error: FloatArray, size: FloatArray) -> Iterator[Finding]:
    large = error > LARGE * size
    if large.any():
        listed = [
            Entry(name, f" {e / s:.0%}" if e < MANY * s else f" (more than {MANY:.0f} times it)", e / max(s, TINY))
            for name, e, s in zip(names[large], error[large], size[large], strict=True)
        ]
        yield Finding("mesh-coarse", "warning", {"what": word}, about=tuple(listed))
