"""Where the model has no answer, or several: what samples that failed, were refused, or have jumped have in common.

A perfect column under a dead load has no stable straight state beyond its first buckling load, and its bent state is
not found from the straight ones. Estimates from the other samples describe the branch on which these are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from forward.findings import Entry, Finding
from forward.model import FloatArray, Stability
from forward.readable import told as in_words
from uq.evaluation.request import Evaluations
from uq.inputs.random_parameters import Inputs

SHOWN = 0.1  # weight of a parameter in a direction, relative to the largest, from which it is named
SHUFFLES = 39  # of labels, all of which a bound separates worse: one time in forty by chance
NAMED = 3  # parameters of a place, those furthest from their means
ROWS = 2000  # points of a kind by which others are told apart, at most
STEPS, RIDGE = 10, 1e-4  # of the logistic regression


def findings(
    inputs: Inputs, evaluations: Evaluations, units: Mapping[str, str], *, continued: bool
) -> Iterator[Finding]:
    """Say where samples have no answer, and what that does to estimates.

    Parameters
    ----------
    inputs, evaluations
        The random parameters and the evaluated samples.
    units
        Of the outputs (m), by their names, in order.
    continued
        Whether estimates use a function that continues where the model has no answer (an expansion).
    """
    known, ok = evaluations.stability, evaluations.ok
    refused, total = ~ok & (known >= Stability.REFUSED), len(known)

    def counts(which: NDArray[np.bool_]) -> dict[str, Any]:
        where = separated(inputs, evaluations.points, which, ok)
        return {"count": int(which.sum()), "total": total, "where": where}

    if refused.any():
        code = "no-stable-state-continued" if continued else "no-stable-state"
        yield Finding(code, "error" if continued else "warning", counts(refused))
    yield from of_jumps([evaluations], inputs, continued=continued)
    failed = ~ok & ~refused
    if failed.any():
        code = "no-answer-continued" if continued else "no-answer"
        yield Finding(code, "warning", counts(failed))
    partly = ~ok & np.isfinite(evaluations.outputs).any(axis=1)
    count = int(partly.sum())
    if count:
        known_outputs = np.isfinite(evaluations.outputs[partly])
        least, outputs = int(known_outputs.sum(axis=1).min()), known_outputs.shape[1]
        values = {"count": count, "total": total, "least": least, "outputs": outputs}
        yield Finding("stopped-on-the-way", "warning", values)
    if not ok.all():
        yield from _left_out(units, evaluations.outputs)
    missed = int((known == Stability.MISSED).sum())
    if missed:
        screened = int((known == Stability.SCREENED).sum())
        equilibria = "equilibrium" if missed == 1 else "equilibria"
        values = {"missed": missed, "equilibria": equilibria, "screened": screened}
        yield Finding("screen-missed", "error" if screened else "warning", values)


def _left_out(units: Mapping[str, str], outputs: FloatArray) -> Iterator[Finding]:
    """Say between which ends moments of the whole distribution lie, by the outputs (n, m) that are known.

    Its share is at most the upper end by C. J. Clopper and E. S. Pearson (Biometrika 26 (1934) 404–413).
    With a share s without answer, the quantile of p is between those of (p − s)/(1 − s) and p/(1 − s) of the
    others.
    """
    from scipy.special import betaincinv

    n, told, most = len(outputs), [], 0.0
    for (name, unit), column in zip(units.items(), outputs.T, strict=True):
        values = column[np.isfinite(column)]
        if len(values) in (0, n):
            continue
        share = float(betaincinv(n - len(values) + 1, len(values), 0.975))
        ends = (1 - share) * values.mean() + share * np.array([values.min(), values.max()])
        middle = np.quantile(values, np.clip([(0.5 - share) / (1 - share), 0.5 / (1 - share)], 0, 1))
        of_mean, of_median = (f"{in_words(a, unit, 3)} to {in_words(b, unit, 3)}" for a, b in (ends, middle))
        told.append(Entry(name, f" from {of_mean} (median {of_median if share < 0.5 else 'not known'})", share))
        most = max(most, share)
    if told:
        yield Finding("answers-missing", "warning", {"most": most}, about=tuple(told))


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

    That is a bound on one parameter, or on a sum of several if that separates them better; but neither, where labels
    that are shuffled are separated as well.
    """
    if not ok.any():
        return "no sample has an answer"
    scaled = (points - inputs.mean) / inputs.std
    some = np.concatenate([np.flatnonzero(one)[:: 1 + int(one.sum()) // ROWS] for one in (refused, ok)])
    x, labels, rng = scaled[some], refused[some], np.random.default_rng(0)
    found = _least_wrong(x, labels)
    shuffled = [_least_wrong(x, rng.permutation(labels)) for _ in range(SHUFFLES)]
    chance = [min(wrong for wrong, _ in kind) for kind in zip(*shuffled, strict=True)]
    told = [one for one, least in zip(found, chance, strict=True) if one[0] < least]
    if not told:
        first = np.flatnonzero(refused)[0]
        far = np.argsort(-np.abs(scaled[first]))[:NAMED]
        place = ", ".join(f"{inputs.names[k]} = {points[first, k]:.5g}" for k in far)
        return f"no bound on the parameters separates them from the others; the first is at {place}"
    _, weights = min(told, key=lambda one: one[0])
    shown = [k for k in np.argsort(-np.abs(weights)) if abs(weights[k]) >= SHOWN]
    if len(shown) == 1:
        what, sign, along = inputs.names[shown[0]], np.sign(weights[shown[0]]), points[:, shown[0]]
    else:
        terms = " ".join(f"{'−' if weights[k] < 0 else '+'} {abs(weights[k]):.2g} {inputs.names[k]}" for k in shown)
        what = f"{terms.removeprefix('+ ')} (deviations from the means in standard deviations)"
        sign, along = 1.0, scaled @ weights
    both = refused | ok
    bound = _bounds(sign * along[both, None], refused[both])[1][0]
    beyond = sign * along >= bound
    inside, others = int((refused & beyond).sum()), int((ok & beyond).sum())
    here, there = ("≥", "≤") if sign > 0 else ("≤", "≥")
    said = f"{'all' if inside == refused.sum() else inside} with {what} {here} {sign * bound:.5g}"
    if others:
        return f"{said}, where {others} {'other has' if others == 1 else 'others have'} an answer"
    if inside < refused.sum():
        return f"{said}, where no other has an answer"
    return f"{said}, none with {what} {there} {sign * (sign * along[ok]).max():.5g}"


def _least_wrong(x: FloatArray, refused: NDArray[np.bool_]) -> list[tuple[int, FloatArray]]:
    """Return the fewest points of x (n, d) on the wrong side of a bound, and the weights (d,) of the bounded sum.

    That is of one parameter, up or down, and of the direction of a logistic regression.
    """
    n, d = x.shape
    rows, fitted = np.column_stack([np.ones(n), x]), np.zeros(d + 1)
    for _ in range(STEPS):
        p = 1 / (1 + np.exp(-rows @ fitted))
        curvature = (rows.T * (p * (1 - p))) @ rows + RIDGE * n * np.eye(d + 1)
        fitted += np.linalg.solve(curvature, rows.T @ (refused - p) - RIDGE * n * fitted)
    one, along = np.vstack([np.eye(d), -np.eye(d)]), fitted[1:] / max(np.abs(fitted[1:]).max(), 1e-300)
    wrong = _bounds(x @ one.T, refused)[0]
    best = int(wrong.argmin())
    return [(int(wrong[best]), one[best]), (int(_bounds(x @ along[:, None], refused)[0][0]), along)]


def _bounds(x: FloatArray, refused: NDArray[np.bool_]) -> tuple[NDArray[np.int_], FloatArray]:
    """Return the bound (c,) of each column of x (n, c) with the fewest points on the wrong side, and how many (c,).

    Refused ones are to be at the bound or above it.
    """
    order = np.argsort(x, axis=0, kind="stable")
    below, answered = (np.pad(np.cumsum(one[order], axis=0), ((1, 0), (0, 0))) for one in (refused, ~refused))
    wrong = below + answered[-1] - answered
    k = wrong.argmin(axis=0)
    sorted_, columns = np.take_along_axis(x, order, axis=0), np.arange(x.shape[1])
    return wrong[k, columns], np.vstack([sorted_, np.full(x.shape[1], np.inf)])[k, columns]


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
    return _at(points, evaluations, evaluations.stability, lambda of: max(of) if max(of) >= refused else min(of))


def _at(
    points: FloatArray, evaluations: Evaluations, values: NDArray[np.int8], of: Callable[[list[int]], int]
) -> NDArray[np.int8]:
    """What follows at points (n, d) from a number of each solve; of none from 0."""
    known: dict[bytes, list[int]] = {}
    for point, one in zip(evaluations.points, values.tolist(), strict=True):
        known.setdefault(point.tobytes(), []).append(one)
    return np.array([of(known.get(np.ascontiguousarray(point).tobytes(), [0])) for point in points], dtype=np.int8)
