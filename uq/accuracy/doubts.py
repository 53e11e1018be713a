"""What is to be said of the error of the mesh."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from forward.model import Finding, FloatArray
from uq.evaluation.evaluate import Evaluations

if TYPE_CHECKING:
    import xarray as xr

DECIDES = 3.0  # times the error of sampling: then more samples do not help
MANY = 10.0  # times a value: percentages beyond say nothing
LARGE = 0.1  # of a value: an error of the mesh that is to be looked at
ROUGH = 0.5  # of the error of the mesh: its doubt, above which its sign is all that is known
ROUNDING = 1e-9  # of the largest output of the same unit: what is zero by symmetry is smaller
VISIBLE = 1e-3  # of a mean: doubts below do no harm


def doubts(dataset: xr.Dataset, estimates: Evaluations, units: Mapping[str, str]) -> Iterator[Finding]:
    """Find what is not estimated, where the mesh decides, and where its error is large or not well known."""
    names = [str(name) for name in dataset["output"].values]
    yield from _of_estimates(names, estimates)
    if "mesh_error" not in dataset:
        if "nominal" in dataset:  # methods from outside may leave it out
            error, size = np.abs(dataset["nominal_mesh_error"].to_numpy()), np.abs(dataset["nominal"].to_numpy())
            yield from _large(names, "value at the mean parameters", error, size)
        return
    std = dataset["std"].to_numpy()
    size = np.maximum(np.abs(dataset["mean"].to_numpy()), std)  # a mean may be zero
    error = np.abs(dataset["mesh_error"].to_numpy())
    rounding = _rounding(names, size, units)
    yield from _large(names, "mean", np.where(rounding, 0.0, error), size)
    of_std = np.abs(dataset["std_mesh_error"].to_numpy())
    yield from _large(names, "standard deviation", np.where(rounding, 0.0, of_std), std)
    yield from _unexplained(names, dataset, rounding)
    decides = (error > DECIDES * dataset["mean_error"].to_numpy()) & ~rounding
    if decides.any():
        listed = "; ".join(
            f"{name} {_number(e, units.get(name, '1'))} against {_number(s, units.get(name, '1'))}"
            for name, e, s in zip(
                np.array(names)[decides], error[decides], dataset["mean_error"].to_numpy()[decides], strict=True
            )
        )
        yield Finding(
            "note", f"The mesh, not the samples, decides how exact the means are: {listed}. A finer mesh helps."
        )


def _rounding(names: Sequence[str], sizes: FloatArray, units: Mapping[str, str]) -> NDArray[np.bool_]:
    """Say which outputs of some sizes (m,) are rounding beside others of the same unit."""
    known = [units.get(name, "1") for name in names]
    largest = [max(size for size, other in zip(sizes, known, strict=True) if other == unit) for unit in known]
    return np.asarray(sizes < ROUNDING * np.array(largest))


def _unexplained(names: Sequence[str], dataset: xr.Dataset, rounding: NDArray[np.bool_]) -> Iterator[Finding]:
    """Find errors of the mesh that vary with the parameters as no expansion says."""
    error, doubt = np.abs(dataset["mesh_error"].to_numpy()), dataset["mesh_error_doubt"].to_numpy()
    rough = doubt > ROUGH * error
    visible = doubt > np.maximum(dataset["mean_error"].to_numpy(), VISIBLE * np.abs(dataset["mean"].to_numpy()))
    unclear = rough & visible & ~rounding
    if unclear.any():
        listed = ", ".join(np.array(names)[unclear])
        text = (
            f"The error of the mesh does not follow from a few estimates for {listed}: it varies with the parameters, "
            "and its doubt is as large as it is. More solves allow more estimates; a finer mesh makes it smaller."
        )
        yield Finding("note", text)


def _number(value: float, unit: str) -> str:
    return f"{value:.2g}" if unit == "1" else f"{value:.2g} {unit}"


def _of_estimates(names: Sequence[str], estimates: Evaluations) -> Iterator[Finding]:
    """Find estimates that failed, and outputs without any."""
    n, ok = len(estimates.points), int(estimates.ok.sum())
    if ok < n:
        reason = estimates.failures[0].reason
        rest = "the others are used" if ok > 1 else "so that nothing is known of the error of the mesh"
        yield Finding("warning", f"{n - ok} of {n} estimates of the error of the mesh failed ({reason}); {rest}.")
    if ok < 2:
        return
    assert estimates.mesh_errors is not None
    unknown = ~np.isfinite(estimates.mesh_errors[estimates.ok]).all(axis=0)
    if unknown.any():
        listed = ", ".join(np.array(names)[unknown])
        yield Finding("note", f"The error of the mesh is not estimated of {listed}: it need not fall with the cells.")


def _large(names: Sequence[str], word: str, error: FloatArray, size: FloatArray) -> Iterator[Finding]:
    large = error > LARGE * size
    if large.any():
        listed = ", ".join(
            f"{name} {e / s:.0%}" if e < MANY * s else f"{name} (more than {MANY:.0f} times it)"
            for name, e, s in zip(np.array(names)[large], error[large], size[large], strict=True)
        )
        yield Finding("warning", f"The mesh is coarse: by estimate it errs by this much of the {word}: {listed}.")
