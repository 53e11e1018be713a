"""Where the model has no answer, or several: what samples that failed, were refused, or have jumped have in common.

A perfect column under a dead load has no stable straight state beyond its first buckling load, and its bent state is
not found from the straight ones. Estimates from the other samples describe the branch on which these are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from forward.findings import Finding
from forward.model import FloatArray, Stability
from uq.evaluation.request import Evaluations
from uq.inputs.random_parameters import Inputs

SHOWN = 0.1  # weight of a parameter in a direction, relative to the largest, from which it is named


def findings(inputs: Inputs, evaluations: Evaluations, *, continued: bool) -> Iterator[Finding]:
    """Say where samples have no answer, and what that does to estimates.

    Parameters
    ----------
    inputs, evaluations
        The random parameters and the evaluated samples.
    continued
        Whether estimates use a function that continues where the model has no answer (an expansion).
    """
    known, ok = evaluations.stability, evaluations.ok
    refused = ~ok & (known >= Stability.REFUSED)
    count, total = int(refused.sum()), len(known)
    if count:
        where = separated(inputs, evaluations.points, refused, ok)
        code = "no-stable-state-continued" if continued else "no-stable-state"
        yield Finding(code, "error" if continued else "warning", {"count": count, "total": total, "where": where})
    yield from of_jumps([evaluations], inputs, continued=continued)
    failed = ~ok & ~refused
    count = int(failed.sum())
    if count:
        where = separated(inputs, evaluations.points, failed, ok)
        code = "no-answer-continued" if continued else "no-answer"
        yield Finding(code, "warning", {"count": count, "total": total, "where": where})
    partly = ~ok & np.isfinite(evaluations.outputs).any(axis=1)
    count = int(partly.sum())
    if count:
        known_outputs = np.isfinite(evaluations.outputs[partly])
        least, outputs = int(known_outputs.sum(axis=1).min()), known_outputs.shape[1]
        values = {"count": count, "total": total, "least": least, "outputs": outputs}
        yield Finding("stopped-on-the-way", "warning", values)
    missed = int((known == Stability.MISSED).sum())
    if missed:
        screened = int((known == Stability.SCREENED).sum())
        equilibria = "equilibrium" if missed == 1 else "equilibria"
        values = {"missed": missed, "equilibria": equilibria, "screened": screened}
        yield Finding("screen-missed", "error" if screened else "warning", values)


def of_jumps(
    evaluations: Sequence[Evaluations], inputs: Inputs | None = None, *, continued: bool = False
) -> Iterator[Finding]:
    """Say at how many solves the body has other stable equilibria, and, with `inputs` of one evaluation, where.

    Parameters
    ----------
    evaluations, inputs, continued
        As of `findings`.
    """
    total = sum(len(found.points) for found in evaluations)
    snapped, others = ([found.ok & (found.counted(name) > 0) for found in evaluations] for name in ("snaps", "others"))
    count, answered = sum(int(one.sum()) for one in snapped), sum(int(found.ok.sum()) for found in evaluations)
    what = "solves" if inputs is None else "samples"
    if count:
        some = continued and count < answered
        where = ""
        if inputs is not None and count < answered:
            (found,), (jumped,) = evaluations, snapped
            where = f": {separated(inputs, found.points, jumped, found.ok & ~jumped)}"
        values = {"share": _share(count, total, what), "where": where}
        yield Finding("jumps-continued" if some else "jumps", "error" if some else "warning", values)
    count = sum(int(one.sum()) for one in others)
    if count:
        yield Finding("other-states", "warning", {"share": _share(count, total, what)})


def _share(count: int, total: int, what: str) -> str:
    return f"{count} of {total} {what} ({100 * count / total:.2g} %)"


def separated(inputs: Inputs, points: FloatArray, refused: NDArray[np.bool_], ok: NDArray[np.bool_]) -> str:
    """Say in words what distinguishes the points (n, d) that were refused (n,) from those that have an answer.

    That is a bound on one parameter, or on a sum of several if that separates them better.
    """
    if not ok.any():
        return "no sample has an answer"
    names = inputs.names
    bounds = [_bound(points[:, i], refused, ok) for i in range(len(names))]
    i = min(range(len(names)), key=lambda k: bounds[k][0])
    wrong, above = bounds[i]
    if wrong > 0 and len(names) > 1:
        scaled = (points - inputs.mean) / inputs.std
        both = refused | ok
        rows = np.column_stack([np.ones(both.sum()), scaled[both]])
        weights = np.linalg.lstsq(rows, np.where(refused[both], 1.0, -1.0), rcond=None)[0][1:]
        weights /= np.abs(weights).max()
        along = scaled @ weights
        together, above_together = _bound(along, refused, ok)
        if together < wrong and above_together:
            shown = [k for k in np.argsort(-np.abs(weights)) if abs(weights[k]) >= SHOWN]
            terms = " ".join(f"{'−' if weights[k] < 0 else '+'} {abs(weights[k]):.2g} {names[k]}" for k in shown)
            what = f"{terms.removeprefix('+ ')} (deviations from the means in standard deviations)"
            return _words(what, along, refused, ok, together, above=True)
    return _words(names[i], points[:, i], refused, ok, wrong, above=above)


def _bound(x: FloatArray, refused: NDArray[np.bool_], ok: NDArray[np.bool_]) -> tuple[int, bool]:
    """Smallest number of points on the wrong side of a bound of x (n,), and whether the refused ones are above it."""
    both = refused | ok
    order = np.argsort(x[both], kind="stable")
    bad = refused[both][order]
    below = np.concatenate([[0], np.cumsum(bad)])  # refused ones among the k smallest
    k = np.arange(len(below))
    above = (below + (len(bad) - k - (bad.sum() - below))).min()  # refused below the bound, answered above it
    under = ((k - below) + (bad.sum() - below)).min()
    return int(min(above, under)), bool(above <= under)


def _words(
    what: str, x: FloatArray, refused: NDArray[np.bool_], ok: NDArray[np.bool_], wrong: int, *, above: bool
) -> str:
    sign = 1 if above else -1
    first = sign * (sign * x[refused]).min()
    sides = "≥" if above else "≤", "≤" if above else "≥"
    if wrong == 0:
        last = sign * (sign * x[ok]).max()
        return f"all with {what} {sides[0]} {first:.5g}, none with {what} {sides[1]} {last:.5g}"
    inside = int(((sign * x >= sign * first) & ok).sum())
    if 2 * inside > ok.sum():
        return "no bound on the parameters separates them from the others"
    others = "1 other has" if inside == 1 else f"{inside} others have"
    return f"all with {what} {sides[0]} {first:.5g}, where {others} an answer"


def counts(evaluations: Iterable[Evaluations]) -> dict[str, int]:
    """Number of states by how their stability was tested; empty if no model has equilibria."""
    known = np.concatenate([np.zeros(0, dtype=np.int8), *(found.stability for found in evaluations)])
    if not known.any():
        return {}
    return {one.name.lower(): int((known == one).sum()) for one in Stability}


JOINED = ("not looked at", "screened", "audited", "another equilibrium found too", "beyond a jump")


def joined(evaluations: Evaluations) -> NDArray[np.int8]:
    """Return how each state (n,) is known to be joined to rest, as a number of `JOINED`."""
    levels = [evaluations.counted(name) > 0 for name in ("screens", "audits", "others", "snaps")]
    known = np.max([(k + 1) * level for k, level in enumerate(levels)], axis=0)
    return np.asarray(np.where(evaluations.ok, known, 0), dtype=np.int8)


def joined_counts(evaluations: Iterable[Evaluations]) -> dict[str, int]:
    """Number of states by `JOINED`; empty if none was looked at."""
    known = np.concatenate([np.zeros(0, dtype=np.int8), *(joined(found)[found.ok] for found in evaluations)])
    return {name: int((known == i).sum()) for i, name in enumerate(JOINED)} if known.any() else {}


def joined_by_sample(points: FloatArray, evaluations: Evaluations) -> NDArray[np.int8]:
    """Return the number (n,) of `JOINED` at points (n, d): the largest of several solves at a point."""
    return _at(points, evaluations, joined(evaluations), max)


def by_sample(points: FloatArray, evaluations: Evaluations) -> NDArray[np.int8]:
    """Return what is known (n,) about the stability at points (n, d): the least of several solves at a point."""
    refused = Stability.REFUSED
    return _at(
        points, evaluations, evaluations.stability, lambda all_: max(all_) if max(all_) >= refused else min(all_)
    )


def _at(
    points: FloatArray, evaluations: Evaluations, values: NDArray[np.int8], of: Callable[[list[int]], int]
) -> NDArray[np.int8]:
    """What follows at points (n, d) from a number of each solve; of none from 0."""
    known: dict[bytes, list[int]] = {}
    for point, one in zip(evaluations.points, values.tolist(), strict=True):
        known.setdefault(point.tobytes(), []).append(one)
    return np.array([of(known.get(np.ascontiguousarray(point).tobytes(), [0])) for point in points], dtype=np.int8)
