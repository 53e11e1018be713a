"""What a multifidelity study says of itself: estimates, what was spent on what, and what other methods need."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from forward.findings import Finding
from forward.model import FloatArray
from uq.estimators.fidelities import Found, correlations
from uq.estimators.moments import ESTIMATES
from uq.findings import add
from uq.methods.fidelity_choice import ByChoice
from uq.methods.fidelity_team import PILOT, Team
from uq.methods.fidelity_ways import ByExpansion, ByModels
from uq.surrogates.linearisation import local_dataset

if TYPE_CHECKING:
    import xarray as xr

KNOWN = 10  # failures at samples of the study's model that tell how much they matter
UNRELATED = 0.1  # squared correlation of remainders up to which a cheap model is of no use


def described(
    team: Team, way: ByModels | ByExpansion | ByChoice, models: ByModels, expanded: ByExpansion | None
) -> xr.Dataset:
    """Return estimates, what was spent on what, and what other methods are predicted to need, as labelled arrays."""
    by_output, fidelity, group = ("output",), ("fidelity",), ("group",)
    estimates, pilot, blocks = way.estimates, models.pilot, way.blocks()
    dataset = local_dataset(team.inputs, team.evaluate, team.members[0].centre, fields=True)
    K = len(team.members)
    inside = np.array([np.isin(np.arange(K), one.group) for one in blocks])
    sizes_of = np.array([len(one.taken.points) for one in blocks])
    dataset = dataset.assign_coords(fidelity=[one.label for one in team.members], group=np.arange(len(blocks)))
    dataset = dataset.assign(
        {
            **{name: (by_output, getattr(estimates, name)) for name in ESTIMATES},
            "fidelity_cost": (fidelity, np.array([one.cost for one in team.members])),
            "fidelity_samples": (fidelity, sizes_of @ inside),
            "fidelity_nominal": (("output", "fidelity"), np.array([m.centre.outputs for m in team.members]).T),
            "fidelity_correlation": (("output", "fidelity"), plain_correlations(team)),
            "fidelity_remainder_correlation": (("output", "fidelity"), correlations(pilot.covariance)),
            "group_models": (("group", "fidelity"), inside),
            "group_pilot": (group, np.array([one.pilot for one in blocks])),
            "group_chosen": (group, np.array([one.chosen for one in blocks])),
            "group_samples": (group, sizes_of),
            "group_failed": (group, np.array([int((~one.ok).sum()) for one in blocks])),
            "group_cost": (group, inside @ np.array([one.cost for one in team.members])),
            "spent": ((), team.spent),
            "points": (("sample", "parameter"), np.concatenate([one.taken.points for one in blocks])),
            "sample_group": (("sample",), np.repeat(np.arange(len(blocks)), sizes_of)),
            "fidelity_values": (("sample", "fidelity", "output"), np.concatenate([one.taken.values for one in blocks])),
            "ok": (("sample",), np.concatenate([one.ok for one in blocks])),
        }
    )
    for name, (worth, error) in zip(("gain", "std_gain"), way.gains(team.spent), strict=False):
        dataset = dataset.assign({name: (by_output, worth), f"{name}_error": (by_output, error)})
    squares = np.where(estimates.mean_error > 0, estimates.mean_error, np.nan) ** 2
    others = {"monte-carlo": way.plain / squares}
    if team.controlled:
        left = way.found.left if isinstance(way, ByChoice) else np.einsum("mkk->mk", pilot.covariance)[:, 0]
        others["sensitivity-monte-carlo"] = left / squares
    if expanded is not None:
        others["expansion"] = expanded.left**2 / squares + sizes_of[0]
    dataset = dataset.assign_coords(alternative=list(others))
    dataset = dataset.assign(alternative_solves=(("alternative", "output"), np.array(list(others.values()))))
    add(dataset, compared(others, team.spent, expanded_used=isinstance(way, ByExpansion)))
    values = np.isfinite(dataset["fidelity_values"].to_numpy()).all(axis=2)
    asked = np.repeat(inside, sizes_of, axis=0)
    lost, filled = int((asked & ~values)[:, 0].sum()), int((asked & ~values)[:, 1:].any(axis=1).sum())
    told = []
    if lost:
        told.append(
            f"{lost} of {int(asked[:, 0].sum())} samples of the study's model have no answer; estimates are over "
            "the others, that is, conditional on it having one"
        )
    if filled:
        told.append(
            f"at {filled} samples a cheap model has no answer; its tangent stands for it, which causes no bias"
            if team.controlled
            else f"at {filled} samples a cheap model has no answer; its value at the mean stands for it, without bias"
        )
    if told:
        dataset.attrs["note"] = "; ".join(told)
    add(dataset, *rarely_failing(team, asked, values))
    return dataset


def rarely_failing(team: Team, asked: NDArray[np.bool_], answered: NDArray[np.bool_]) -> Iterator[Finding]:
    """Find cheap models that fail at few of the samples of the study's model, which tell what is missed there.

    Parameters
    ----------
    team
        The models.
    asked, answered
        Which models were asked at each sample (n, K), and have an answer there.
    """
    for k, one in enumerate(team.members[1:], 1):
        failed = asked[:, k] & ~answered[:, k]
        few = int((failed & asked[:, 0]).sum())
        if failed.any() and few < KNOWN:
            lost, of = int(failed.sum()), int(asked[:, k].sum())
            yield Finding("cheap-model-fails", "warning", {"model": one.label, "lost": lost, "asked": of, "few": few})


def plain_correlations(team: Team) -> FloatArray:
    """Return the correlations (m, K) of the outputs of the models with those of the study's, at samples of all."""
    samples = team.samples(PILOT if PILOT in team.taken else 0)
    deviations = samples.deviations[samples.answered]
    centred = deviations - deviations.mean(axis=0)
    return correlations(np.einsum("nkm,nlm->mkl", centred, centred))


def compared(others: dict[str, FloatArray], spent: float, *, expanded_used: bool) -> Finding:
    """Say what other methods are predicted to need for the errors that were reached."""
    words = {
        "monte-carlo": "plain Monte Carlo {} solves",
        "sensitivity-monte-carlo": "the tangent alone {}",
        "expansion": "an expansion of the pilot, corrected by further solves, {}",
    }
    needed = {name: float(np.nanmax(found, initial=0.0)) for name, found in others.items()}
    told = ", ".join(words[name].format(f"{number:,.0f}") for name, number in needed.items())
    values = {"spent": spent, "needed": told}
    least = min(needed, key=lambda name: needed[name])
    if needed[least] < spent and not expanded_used:
        instead = "quasi-monte-carlo with control = 'chaos'" if least == "expansion" else least
        return Finding("fidelities-not-worth", "note", values | {"instead": instead})
    return Finding("fidelities-expansion-taken" if expanded_used else "fidelities-compared", "note", values)


def preferred(by_models: float, by_expansion: float) -> Finding:
    """Say that an expansion takes the place of the cheap models."""
    times = f"{by_models / by_expansion:.3g} times" if by_expansion > 0 else "infinitely"
    return Finding("expansion-instead", "note", {"times": times})


def useless(team: Team, found: Found) -> Iterator[Finding]:
    """Find cheap models that do not follow the model of the study."""
    squares = correlations(found.covariance) ** 2
    for k, one in enumerate(team.members[1:], 1):
        if (squares[:, k] <= UNRELATED).all():
            beside = "what the tangents leave of it" if team.controlled else "it"
            yield Finding(
                "cheap-model-useless", "note", {"model": one.label, "beside": beside, "square": squares[:, k].max()}
            )
