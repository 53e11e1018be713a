"""Whether another program's model answers the same when it is asked again, and states derivatives of its values.

It is asked again at one point. There, and at a few others, two more evaluations along a direction that moves all
parameters; only if these contradict the derivatives, four more for each parameter, to name it. An output may have a
kink at the point, or be rough: a derivative between the slopes on both sides is accepted, and so is one that shorter
differences do not contradict in the same way.
"""

from __future__ import annotations

import numpy as np

from forward.findings import Finding, Severity
from forward.model import FloatArray, ForwardModel, Solution, SolveError

STEP = 1e-2  # of a difference, in standard deviations
SHORTER = 4  # ratio of the steps to those of the differences that confirm
SLOPE = 1e-2  # relative error of a derivative that is accepted
ROUGHNESS = 1e-7  # error of values of an output, relative to it
SAME = 0.1  # difference between slopes of both lengths, over the contradiction
MANY = 25  # number of parameters above which they are not checked one by one
SHOWN = 3
AT_MEAN = "at the mean parameters"


def mistrusted(
    model: ForwardModel,
    points: FloatArray,
    scale: FloatArray,
    known: FloatArray | None = None,
    spread: FloatArray | None = None,
) -> tuple[Finding, ...]:
    """Ask a model again, and compare its derivatives with differences of its values; not collective.

    Derivatives of a model that answers differently are not compared.

    Parameters
    ----------
    model
        Any model of outputs.
    points
        The mean of the parameters, at which it is asked again, and others (n, d) at which its derivatives are compared.
    scale
        Scales (d,) of the parameters, such as their standard deviations.
    known
        What it has answered at the mean (m,); it is asked twice if that is not known.
    spread
        Standard deviations (m,) of the outputs, if they are known; otherwise those to first order.

    Returns
    -------
    tuple
        What is wrong; empty if there is nothing, or if the model has no answer at the mean.
    """
    try:
        if known is None:
            known = model.solve(points[0]).outputs
        again = model.solve(points[0])
        if spread is None and model.differentiable:
            spread = np.sqrt((np.asarray(again.tangent(np.diag(scale))) ** 2).sum(axis=0))
    except SolveError:
        return ()
    found = _unsteady(model.outputs, known, again.outputs, spread)
    found = found or contradicted(model, points[0], scale, middle=again)
    for point in points[1:]:
        if found:
            break
        numbers = ", ".join(f"{name} = {value:.4g}" for name, value in zip(model.parameters, point, strict=True))
        where = f"away from the mean, at {numbers}" if len(point) <= MANY else "away from the mean"
        found = contradicted(model, point, scale, where)
    return found


def _unsteady(
    outputs: tuple[str, ...], first: FloatArray, again: FloatArray, spread: FloatArray | None
) -> tuple[Finding, ...]:
    """Find answers (m,) that differ by more than values are rough: an error where that is visible in the spread."""
    off = np.abs(again - first)
    wrong = np.flatnonzero(off > ROUGHNESS * np.maximum(np.abs(first), np.abs(again)))
    if not wrong.size:
        return ()
    share = np.divide(off, spread, out=np.full(len(off), np.inf), where=spread > 0) if spread is not None else None
    listed = "; ".join(
        f"{outputs[i]} was {first[i]:.9g} and then {again[i]:.9g}"
        + (f", {share[i]:.2g} of its standard deviation" if share is not None and np.isfinite(share[i]) else "")
        for i in wrong[:SHOWN]
    )
    more = f" and {len(wrong) - SHOWN} more" if len(wrong) > SHOWN else ""
    severity: Severity = "error" if share is None or share[wrong].max() > SLOPE else "warning"
    return (Finding("answers-differ", severity, {"where": AT_MEAN, "listed": listed, "more": more}),)


def contradicted(
    model: ForwardModel, point: FloatArray, scale: FloatArray, where: str = AT_MEAN, middle: Solution | None = None
) -> tuple[Finding, ...]:
    """Compare the derivatives of a model with differences of its values; not collective.

    A model without derivatives is not checked. Scales (d,) are such as the standard deviations of parameters (d,); the
    point is `where` in words, and `middle` the solution there, if it is known.

    Returns
    -------
    tuple
        An error that names the worst derivatives; empty if there is none, or if the model has no answer.
    """
    if not model.differentiable:
        return ()
    signs = np.random.default_rng(0).choice([-1.0, 1.0], len(point))
    try:
        middle = middle or model.solve(point)
        slopes = np.asarray(middle.tangent(np.diag(scale)))  # (d, m)
        whole = _against(model, point, scale * signs, middle.outputs, signs @ slopes, STEP)
        if not whole.any():
            return ()
        directions = np.eye(len(point)) if len(point) <= MANY else signs[None]
        stated = directions @ slopes
        found = [
            _confirmed(model, point, scale * d, middle.outputs, s) for d, s in zip(directions, stated, strict=True)
        ]
    except SolveError:
        return ()
    named = model.parameters if len(point) <= MANY else ("all parameters",)
    worst = [
        (abs(wrong[i] - right[i]) / max(abs(wrong[i]), abs(right[i])), output, name, wrong[i], right[i])
        for name, wrong, right in zip(named, stated, found, strict=True)
        for i, output in enumerate(model.outputs)
        if np.isfinite(right[i])
    ]
    if not worst:
        return ()
    said = "; ".join(
        f"of {output} by {name} {100 * abs(wrong - right) / abs(right):.3g} % off"
        if right
        else f"of {output} by {name}"
        for _, output, name, wrong, right in sorted(worst, reverse=True)[:SHOWN]
    )
    more = f" and {len(worst) - SHOWN} more" if len(worst) > SHOWN else ""
    return (Finding("derivatives-contradicted", "error", {"where": where, "said": said, "more": more}),)


def _against(
    model: ForwardModel, point: FloatArray, direction: FloatArray, middle: FloatArray, stated: FloatArray, step: float
) -> FloatArray:
    """By how much (m,) stated slopes contradict differences over steps to both sides; 0 where they do not."""
    ahead, behind = (model.solve(point + sign * step * direction).outputs for sign in (1, -1))
    forward, backward = (ahead - middle) / step, (middle - behind) / step
    sizes = np.abs([forward, backward, stated]).max(axis=0)
    rough = ROUGHNESS * np.abs([ahead, middle, behind]).max(axis=0) / step
    allowed = SLOPE * sizes + rough + np.abs(forward - backward)
    off = stated - (forward + backward) / 2
    return np.where(np.abs(off) > allowed, off, 0.0)


def _confirmed(
    model: ForwardModel, point: FloatArray, direction: FloatArray, middle: FloatArray, stated: FloatArray
) -> FloatArray:
    """Slopes (m,) by differences if these contradict the stated ones equally at both lengths; otherwise NaN."""
    off, closer = (_against(model, point, direction, middle, stated, step) for step in (STEP, STEP / SHORTER))
    sure = (off != 0) & (closer != 0) & (np.abs(off - closer) <= SAME * np.abs(closer))
    return np.where(sure, stated - closer, np.nan)
