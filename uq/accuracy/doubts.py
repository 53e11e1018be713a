"""What is to be said of the error of the mesh."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from forward.model import Finding, FloatArray
from forward.readable import told as in_words
from uq.estimators.rounding import only_rounding
from uq.evaluation.request import Evaluations

if TYPE_CHECKING:
    import xarray as xr

DECIDES = 3.0  # times the error of sampling: then more samples do not help
MANY = 10.0  # times a value: percentages beyond say nothing
LARGE = 0.1  # of a value: an error of the mesh that is to be looked at
ROUGH = 0.5  # of the error of the mesh: its doubt, above which its sign is all that is known
EXACT = 1e-9  # of a value: errors that are no more than that are rounding
LOOSE = 1e-8  # tolerance of the solver from which its error may be as large as one of a mesh
VISIBLE = 1e-3  # of a mean: doubts below do no harm
LISTED = 8  # outputs that a sentence names
FEWEST_ANSWERS = 2  # of estimates: one alone does not say how far it is from others
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
    contact
        Whether tools touch the body.
    """

    units: Mapping[str, str]
    never: frozenset[str] = frozenset()
    tolerance: float = 0.0
    contact: bool = False


def doubts(dataset: xr.Dataset, estimates: Evaluations, told: Told) -> Iterator[Finding]:
    """Find what is not estimated, where the mesh decides, and where its error is large or not well known."""
    names = np.array([str(name) for name in dataset["output"].values])
    units, counts = told.units, ~only_rounding(dataset, told.units)
    yield from _of_estimates(names, estimates, told, counts)
    if "mesh_error" not in dataset:
        if "nominal" in dataset:  # methods from outside may leave it out
            error, size = np.abs(dataset["nominal_mesh_error"].to_numpy()), np.abs(dataset["nominal"].to_numpy())
            yield from _large(names, "value at the mean parameters", np.where(counts, error, 0.0), size)
            yield from _of_solver(names, np.where(counts, error, np.nan), size, told)
        return
    mean, std, sampling = (dataset[name].to_numpy() for name in ("mean", "std", "mean_error"))
    size = np.maximum(np.abs(mean), std)  # a mean may be zero
    error, of_std = (np.where(counts, np.abs(dataset[f"{first}mesh_error"].to_numpy()), 0.0) for first in ("", "std_"))
    yield from _large(names, "mean", error, size)
    yield from _large(names, "standard deviation", of_std, std)
    yield from _unexplained(names, dataset, counts)
    yield from _of_solver(names, np.where(counts, error, np.nan), size, told)
    decides = (error > DECIDES * sampling) & (error > EXACT * size)
    if decides.any():
        listed = _listed(
            [
                f"{name} {in_words(e, units.get(name, '1'))} against {in_words(s, units.get(name, '1'))}"
                for name, e, s in zip(names[decides], error[decides], sampling[decides], strict=True)
            ],
            "; ",
        )
        yield Finding(
            "note", f"The mesh, not the samples, decides how exact the means are: {listed}. A finer mesh helps."
        )


def failed(why: str) -> Finding:
    """Say that the error of the mesh was to be estimated and is not known."""
    return Finding("error", f"The error of the mesh is not known: {why}. What stands after ± does not hold it.")


def _unexplained(names: Names, dataset: xr.Dataset, counts: NDArray[np.bool_]) -> Iterator[Finding]:
    """Find errors of the mesh that vary with the parameters as no expansion says."""
    error, doubt = np.abs(dataset["mesh_error"].to_numpy()), dataset["mesh_error_doubt"].to_numpy()
    rough = doubt > ROUGH * error
    visible = doubt > np.maximum(dataset["mean_error"].to_numpy(), VISIBLE * np.abs(dataset["mean"].to_numpy()))
    contradicted = dataset["mesh_error_unknown"].to_numpy() > ROUGH
    unclear = rough & visible & counts & ~contradicted
    if (contradicted & visible & counts).any():
        text = (
            "Richer elements and a finer mesh do not agree on the error of the mesh for "
            f"{_listed(names[contradicted & visible & counts].tolist(), ', ')}: where errors of several places cancel, "
            "little more than their size is known (mesh_error_doubt). A finer mesh makes it smaller."
        )
        yield Finding("note", text)
    if unclear.any():
        listed = ", ".join(names[unclear])
        text = (
            f"The error of the mesh does not follow from a few estimates for {listed}: it varies with the parameters, "
            "and its doubt is as large as it is. More solves allow more estimates; a finer mesh makes it smaller."
        )
        yield Finding("note", text)


def _of_solver(names: Names, error: FloatArray, size: FloatArray, told: Told) -> Iterator[Finding]:
    """Find outputs that the solver may leave as far off as the mesh does."""
    hidden = error < told.tolerance * size
    if told.tolerance > LOOSE and hidden.any():
        text = (
            f"The solver's tolerance of {told.tolerance:g} may leave larger errors than the mesh in "
            f"{', '.join(names[hidden])}: the error of the mesh is not known to better than that. "
            "Take a smaller model.solver.tolerance."
        )
        yield Finding("warning", text)


def _listed(words: Sequence[str], between: str) -> str:
    """Join words, the first of many."""
    rest = [f"and {len(words) - LISTED} more"] if len(words) > LISTED + 1 else []
    return between.join([*(words[:LISTED] if rest else words), *rest])


def _of_estimates(names: Names, estimates: Evaluations, told: Told, counts: NDArray[np.bool_]) -> Iterator[Finding]:
    """Find estimates that failed, and outputs without any, by the reason."""
    n, ok = len(estimates.points), int(estimates.ok.sum())
    if ok < n:
        reason = estimates.failures[0].reason
        known = ok >= FEWEST_ANSWERS
        rest = "the others are used" if known else "so that nothing is known of the error of the mesh"
        if told.contact:
            said = (
                f"{n - ok} of {n} estimates of the error of the mesh failed, as they mostly do in contact, where the "
                f"edge of the area that is touched moves; {rest}. Compare with a finer mesh, and set "
                "accuracy.mesh_error = false to save their time."
            )
        else:
            said = f"{n - ok} of {n} estimates of the error of the mesh failed ({reason}); {rest}."
        yield Finding("warning" if known else "error", said)
    if ok < FEWEST_ANSWERS:
        return
    assert estimates.mesh_errors is not None
    known = np.isfinite(estimates.mesh_errors[estimates.ok])
    never = np.isin(names, list(told.never))
    if never.any():
        text = (
            f"The error of the mesh is not estimated of {', '.join(names[never])}: such outputs need not converge as "
            "cells become smaller (the largest stress at an edge that is held grows without limit)."
        )
        yield Finding("note", text)
    lost = ~known.all(axis=0) & ~never & counts
    if lost.any():
        listed = ", ".join(
            f"{name} ({missing} of {ok})" for name, missing in zip(names[lost], (~known).sum(axis=0)[lost], strict=True)
        )
        text = (
            f"There is no estimate of the error of the mesh at some points of {listed}, and so none of its effect: "
            "richer elements give no finite value there. Take more cells, or leave these outputs out."
        )
        yield Finding("error", text)


def _large(names: Names, word: str, error: FloatArray, size: FloatArray) -> Iterator[Finding]:
    large = error > LARGE * size
    if large.any():
        listed = _listed(
            [
                f"{name} {e / s:.0%}" if e < MANY * s else f"{name} (more than {MANY:.0f} times it)"
                for name, e, s in zip(names[large], error[large], size[large], strict=True)
            ],
            ", ",
        )
        yield Finding("warning", f"The mesh is coarse: by estimate it errs by this much of the {word}: {listed}.")
