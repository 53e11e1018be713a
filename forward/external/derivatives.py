"""Whether the stated derivatives of another program's model are those of its values, checked at one point.

Two more evaluations along a direction that moves all parameters; only if these contradict the derivatives, four more
for each parameter, to name it. An output may have a kink at the point, or be rough: a derivative between the slopes on
both sides is accepted, and so is one that shorter differences do not contradict in the same way.
"""

from __future__ import annotations

import numpy as np

from forward.model import Finding, FloatArray, ForwardModel, SolveError

STEP = 1e-2  # of a difference, in standard deviations
SHORTER = 4  # ratio of the steps to those of the differences that confirm
SLOPE = 1e-2  # relative error of a derivative that is accepted
ROUGHNESS = 1e-7  # error of values of an output, relative to it
SAME = 0.1  # difference between slopes of both lengths, over the contradiction
MANY = 25  # number of parameters above which they are not checked one by one
SHOWN = 3


def contradicted(model: ForwardModel, point: FloatArray, scale: FloatArray) -> tuple[Finding, ...]:
    """Compare the derivatives of a model with differences of its values; not collective.

    Parameters
    ----------
    model
        Any model of outputs; one without derivatives is not checked.
    point, scale
        Parameters (d,), and their scales (d,), such as their standard deviations.

    Returns
    -------
    tuple
        An error that names the worst derivatives; empty if there is none, or if the model has no answer.
    """
    if not model.differentiable:
        return ()
    signs = np.random.default_rng(0).choice([-1.0, 1.0], len(point))
    try:
        middle = model.solve(point)
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
    return (
        Finding(
            "error",
            f"The derivatives that the model states are not those of its values at the mean parameters: {said}{more}. "
            "What follows from derivatives (expansions, controls, local sensitivities, modes) is wrong: correct the "
            "jacobian, or leave it out.",
        ),
    )


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
