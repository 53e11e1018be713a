"""What the error of a mesh makes doubtful: a posterior, or the comparison of models on meshes of their own.

Each function returns findings as those of `inverse.criticism.doubts`, judging by finer meshes that were solved on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from forward.findings import Finding
from forward.model import FloatArray

LINEAR = 2.0  # posterior deviations up to which a first-order shift of ln Z is about right
MOVED = 1.0  # by which a finer mesh moves ln Z, "not worth more than a bare mention" (Kass and Raftery 1995)
# Shift by the mesh, in posterior deviations: intervals of 95 % still hold 92 %; they hold half.
BIASED, WRONG = 0.5, 2.0
EXTREME, DECIDES = 20.0, 0.8  # shift by a correction, and share of the deviations that it makes, that are doubted
UNSETTLED = 3.0  # error of the mesh over the noise from which on a correction that has not settled is not to be trusted
# Error of the mesh over the noise up to which intervals of corrected fields were counted; of other bodies than these.
OF_FIELD, OF_OTHERS = 4.0, 0.3
# The same of few parameters of bodies from files, whose cells are divided: 92 % of intervals hold at 1.6, 78 % at 2.9.
OF_FILES = 2.0


def mesh_too_coarse(
    looked: bool, why: str, error: FloatArray, shifts: Mapping[str, float], nodes: FloatArray
) -> list[Finding]:
    """Doubt the mesh, judging by a finer one.

    Parameters
    ----------
    looked
        Whether there was a solve on a finer mesh, or else `why` not.
    error
        What it adds to the predicted data (n,), over the noise.
    shifts
        The resulting shifts of unknowns, by name, over their posterior deviations.
    nodes
        The same for a field at the vertices (N,), or None.
    """
    if not looked:
        return [Finding("mesh-not-checked", "warning", {"why": why})]
    size, most = float(np.sqrt((error**2).mean())), float(np.abs(error).max())
    listed, worst = _moves(shifts, nodes)
    values = {"size": size, "most": most, "listed": listed, "worst": worst}
    if worst <= BIASED:
        return [Finding("mesh-moves-little", "note", values)]
    return [Finding("mesh-too-coarse", "error" if worst > WRONG else "warning", values)]


def not_estimable(names: Sequence[str]) -> list[Finding]:
    """Doubt data of outputs, by name, whose error of the mesh nothing tells."""
    if not names:
        return []
    return [Finding("mesh-not-estimable", "warning", {"names": ", ".join(names)})]


def mesh_corrected(
    error: FloatArray,
    shifts: Mapping[str, float],
    left: Mapping[str, float],
    nodes: FloatArray,
    *,
    settled: bool,
    counted: bool = True,
    from_file: bool = False,
) -> list[Finding]:
    """Say what correcting the error of the mesh has done, and doubt it where it decides.

    Parameters
    ----------
    error, shifts, nodes
        As of `mesh_too_coarse`: what the correction has moved.
    left
        Standard deviations of what is uncertain of that, by name, over those of the posterior.
    settled
        Whether the error at the mode is the one that was corrected.
    counted
        Whether it was counted how often intervals of fields of such bodies hold.
    from_file
        Whether the mesh is that of a file.
    """
    size, most = float(np.sqrt((error**2).mean())), float(np.abs(error).max())
    listed, worst = _moves(shifts, nodes)
    uncertain = max([value for value in left.values() if np.isfinite(value)], default=0.0)
    values = {"size": size, "most": most, "listed": listed, "uncertain": uncertain}
    if not settled:
        bad = worst > WRONG and size > UNSETTLED
        return [Finding("mesh-correction-unsettled", "error" if bad else "warning", values)]
    if decides(worst, uncertain):
        return [Finding("mesh-correction-decides", "warning", values)]
    if len(nodes) and size > (OF_FIELD if counted else OF_OTHERS):
        return [Finding("mesh-correction-of-field", "warning", values)]
    if from_file and not len(nodes) and beyond_files(size):
        return [Finding("mesh-correction-of-file", "warning", values)]
    return [Finding("mesh-corrected", "note", values)]


def decides(shift: Any, left: Any) -> Any:
    """Whether a correction of the mesh decides on a result, by its largest shift and what is uncertain of it."""
    return (shift > EXTREME) | (left > DECIDES)


def beyond_files(size: Any) -> Any:
    """Whether errors of this size, over the noise, are more than corrections on meshes of files hold for."""
    return size > OF_FILES


def _moves(shifts: Mapping[str, float], nodes: FloatArray) -> tuple[str, float]:
    """Shifts of unknowns in words, the largest first, and its size."""
    moved = {name: shift for name, shift in shifts.items() if np.isfinite(shift)}
    everywhere = float(np.sqrt((nodes**2).mean())) if len(nodes) else 0.0
    worst = max([abs(shift) for shift in moved.values()] + [everywhere], default=0.0)
    ordered = sorted(moved.items(), key=lambda item: -abs(item[1]))
    listed = [f"{name} {shift:+.2g}".replace(" -", " −") for name, shift in ordered]
    listed += [f"values at the vertices {everywhere:.2g} (root mean square)"] if len(nodes) else []
    return ", ".join(listed), worst


def meshes_too_coarse(
    log_evidence: Mapping[str, float], added: Mapping[str, float], shifts: Mapping[str, float]
) -> list[Finding]:
    """Doubt the meshes of candidates, judging by the effect of finer ones on their evidences.

    Parameters
    ----------
    log_evidence
        With the prior odds, by name.
    added
        What a finer mesh adds to that, to first order; NaN where unknown, which counts as zero.
    shifts
        The resulting largest shift of an unknown, in posterior deviations.
    """
    known = {name: change for name, change in added.items() if np.isfinite(change)}
    if not known:
        return []
    there = {name: value + known.get(name, 0.0) for name, value in log_evidence.items()}
    best, other = max(log_evidence, key=log_evidence.__getitem__), max(there, key=there.__getitem__)
    listed = ", ".join(f"{name} {change_in_words(change, shifts[name])}" for name, change in known.items())
    settled = all(certain(change, shifts[name]) for name, change in known.items())
    values = {"listed": listed, "best": best, "other": other, "limit": MOVED}
    if best != other:
        return [Finding("evidence-decided-by-meshes", "error", values)]
    return [Finding("evidence-settled", "note", values) if settled else Finding("evidence-moves", "warning", values)]


def meshes_of_files(which: Sequence[str]) -> list[Finding]:
    """Doubt evidences of candidates, by name, on meshes of files which err by more than corrections hold for."""
    if not which:
        return []
    return [Finding("meshes-of-files", "warning", {"models": ", ".join(which), "limit": OF_FILES})]


def meshes_not_alike(corrected: Sequence[str], unknown: Sequence[str]) -> list[Finding]:
    """Doubt evidences of candidates, by name, of which some are corrected for their meshes and some not looked at."""
    if not corrected or not unknown:
        return []
    values = {"corrected": ", ".join(corrected), "unknown": ", ".join(unknown)}
    return [Finding("meshes-not-alike", "warning", values)]


def certain(change: Any, shift: Any) -> Any:
    """Whether a change of ln Z is small, and known: to first order, at shifts of 3 deviations, it was off by 1.6."""
    return (np.abs(change) <= MOVED) & (np.abs(shift) <= LINEAR)


def change_in_words(change: float, shift: float) -> str:
    """Write a first-order change of ln Z, given the largest shift of an unknown (posterior deviations)."""
    if abs(shift) <= LINEAR:
        return f"about {change:+.2g}"
    return (
        f"a lot ({change:+.2g} to first order, which does not hold where unknowns move by {abs(shift):.2g} deviations)"
    )
