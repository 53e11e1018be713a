"""The choice of observations one after the other, each the one that adds most, with a budget by number or cost.

For a submodular criterion the set that is found tells at least 1 − 1/e = 63 % of what the best set of that number does
(G. L. Nemhauser, L. A. Wolsey, M. L. Fisher, Math. Program. 14 (1978) 265–294), mostly far more. What a candidate added
before bounds what it adds now, so that few candidates are looked at again in each step (M. Minoux, 1978). With costs
that differ, the choice by gain for the cost and that by gain alone are both made, and the better one counts (J.
Leskovec et al., KDD 2007: at least (1 − 1/e)/2 of the best).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from forward.findings import Finding
from forward.model import FloatArray
from inverse.data.measurements import Measurements
from inverse.designs.criteria import Criterion, IntArray
from uq.findings import add

if TYPE_CHECKING:
    import xarray as xr

Each = Literal["value", "point", "place", "case", "output", "step"]
NEAR = 12  # decimals of coordinates (m) of points that are the same
TOGETHER = 16  # candidates that are looked at again at once
ROUNDING = 1e-9  # of a budget
FARTHER = 6  # times as many random observations as chosen ones
BAND = (0.05, 0.5, 0.95)
QUANTILES = ("lower", "median", "upper")


def kinds(values: Measurements) -> list[tuple[str, str]]:
    """Return what errors may be relative to (m,): displacements in a load case, or an output."""
    where = zip(values.tests.tolist(), values.names.tolist(), values.points >= 0, strict=True)
    return [(case, "") if at else (case if case and not case.isdigit() else "", part) for case, part, at in where]


def matching(names: Iterable[str], pattern: str) -> NDArray[np.bool_]:
    """Return which names (m,) match a pattern."""
    return np.array([fnmatchcase(name, pattern) for name in names], dtype=bool)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Observations that can be chosen.

    Attributes
    ----------
    names
        Of the c candidates.
    which
        Number (m,) of the candidate that each value belongs to; -1 of values that are not measured.
    places
        Where (c, 3) they are (m); NaN of those at no point, or at several.
    cases, parts
        Load case of each, empty if in several; and what is measured, such as "xyz" or "force".
    costs
        What each costs (c,).
    """

    names: tuple[str, ...]
    which: IntArray
    places: FloatArray
    cases: tuple[str, ...]
    parts: tuple[str, ...]
    costs: FloatArray

    @classmethod
    def of(cls, values: Measurements, each: Each, goals: NDArray[np.bool_]) -> Candidates:
        """Gather values, but for goals (m,), into observations of cost 1. The same value at one point counts once."""
        which, seen, of_kind = np.full(len(values), -1), set(), kinds(values)
        texts = (values.labels.tolist(), values.tests.tolist(), values.names.tolist())
        groups: dict[tuple[object, ...], tuple[str, list[int]]] = {}
        for k, (name, case, part, at) in enumerate(zip(*texts, values.points >= 0, strict=True)):
            place = tuple((np.round(values.places[k], NEAR) + 0.0).tolist()) if at else ()
            same = (case, place, part) if at else (name,)
            if goals[k] or same in seen:
                continue
            seen.add(same)
            key: tuple[object, ...]
            match each:
                case "point" if at:
                    key, called = (case, place), name.rpartition(".")[0]
                case "place" if at:
                    key, called = (place,), (name.partition(".")[2] if case else name).rpartition(".")[0]
                case "output":
                    key, called = (("", part), "displacements") if at else ((of_kind[k][0], part), part)
                case "case" | "step":
                    key, called = (case,), f"step {case}" if case and each == "step" else case or name
                case _:
                    key, called = (name,), name
            groups.setdefault(key, (called, []))[1].append(k)
        every = [rows for _, rows in groups.values()]
        for number, rows in enumerate(every):
            which[rows] = number
        return cls(
            tuple(called for called, _ in groups.values()),
            which,
            np.array([_one([values.places[k] for k in rows]) for rows in every]).reshape(-1, 3),
            tuple(_common([texts[1][k] for k in rows]) for rows in every),
            tuple(_parts([texts[2][k] for k in rows]) for rows in every),
            np.ones(len(every)),
        )

    def costing(self, given: Mapping[str, float]) -> Candidates:
        """Return them with costs by patterns of names, of which the last that matches counts; else 1.

        Raises `ValueError` if a pattern matches none.
        """
        found = np.ones(len(self.names))
        for pattern, value in given.items():
            mine = matching(self.names, pattern)
            if not mine.any():
                raise ValueError(f"'{pattern}' is the name of no candidate, such as {', '.join(self.names[:3])}")
            found[mine] = value
        return replace(self, costs=found)


def _one(places: Sequence[FloatArray]) -> FloatArray:
    """The place of all of them, or NaN."""
    same = all(np.array_equal(np.round(one, NEAR), np.round(places[0], NEAR), equal_nan=True) for one in places)
    return places[0] if same else np.full(3, np.nan)


def _common(words: Sequence[str]) -> str:
    return words[0] if len(set(words)) == 1 else ""


def _parts(words: Sequence[str]) -> str:
    """The parts in their order, each once: "xyz" of components."""
    each = list(dict.fromkeys(words))
    return ("" if all(len(word) == 1 for word in each) else " ").join(each)


class Choice(NamedTuple):
    """Chosen candidates.

    Attributes
    ----------
    order
        Their numbers, the first chosen first.
    gains
        What each added.
    looks
        How many times a candidate was looked at.
    """

    order: tuple[int, ...]
    gains: tuple[float, ...]
    looks: int

    @property
    def worth(self) -> float:
        """What they are worth together."""
        return sum(self.gains)


def choose(make: Callable[[], Criterion], costs: FloatArray, *, number: int | None, budget: float | None) -> Choice:
    """Choose a number of candidates with costs (c,), or as many as a budget pays for, by a criterion made anew."""
    found = greedy(make(), costs, costs, number=number, budget=budget)
    if budget is not None and np.ptp(costs) > 0:
        other = greedy(make(), costs, np.ones(len(costs)), number=number, budget=budget)
        found = other if other.worth > found.worth else found
    return found


def greedy(
    criterion: Criterion, costs: FloatArray, divisors: FloatArray, *, number: int | None, budget: float | None
) -> Choice:
    """Choose candidates by gain over divisor (c,), until there are enough, or none that the budget pays for."""
    spare = np.inf if budget is None else budget * (1 + ROUNDING)
    order: list[int] = []
    gains: list[float] = []
    free, looks = np.ones(len(costs), dtype=bool), len(costs)
    bounds = criterion.gains(np.arange(looks))
    while len(order) < (len(costs) if number is None else number):
        open_ = np.flatnonzero(free & (costs <= spare))
        if len(open_) == 0:
            break
        if order:
            looks += _look_again(criterion, bounds, divisors, open_)
        best = int(open_[np.argmax(bounds[open_] / divisors[open_])])
        order.append(best)
        gains.append(float(bounds[best]))
        free[best] = False
        spare -= costs[best]
        criterion.take(best)
    return Choice(tuple(order), tuple(gains), looks)


def _look_again(criterion: Criterion, bounds: FloatArray, divisors: FloatArray, open_: NDArray[np.int64]) -> int:
    """Bring bounds up to date until the largest is one that is; return how many were."""
    if not criterion.submodular:
        bounds[open_] = criterion.gains(open_)
        return len(open_)
    ranked = open_[np.argsort(-bounds[open_] / divisors[open_], kind="stable")]
    best, looks = -np.inf, 0
    while looks < len(ranked) and bounds[ranked[looks]] / divisors[ranked[looks]] >= best:
        some = ranked[looks : looks + TOGETHER]
        bounds[some] = criterion.gains(some)
        best = max(best, float((bounds[some] / divisors[some]).max()))
        looks += len(some)
    return looks


def compared(
    choice: Choice, candidates: Candidates, worth: Callable[[IntArray], FloatArray], random: int, seed: int
) -> xr.Dataset:
    """Return what chosen candidates are worth, and random ones.

    In an order (n,) the first, the first two, … are worth (n,); so many random orders follow from the seed.
    """
    import xarray as xr

    order, worth_of_chosen, costs = np.array(choice.order), np.cumsum(choice.gains), candidates.costs
    rng = np.random.default_rng([seed, 2])
    most = min(len(costs), FARTHER * len(order))
    orders = [rng.permutation(len(costs))[:most] for _ in range(random)]
    at_random = np.quantile([worth(one) for one in orders], BAND, axis=0)
    counts = np.flatnonzero(at_random[1] >= worth_of_chosen[-1])
    return xr.Dataset(
        {
            "chosen": ("choice", order),
            "worth": ("choice", worth_of_chosen),
            "cost": ("choice", np.cumsum(costs[order])),
            **{f"random_{name}": ("random_number", line) for name, line in zip(QUANTILES, at_random, strict=True)},
            "random_equal": float(counts[0] + 1) if len(counts) else np.nan,
            "candidate_cost": ("candidate", costs),
            "candidate_place": (("candidate", "axis"), candidates.places),
            "candidate_case": ("candidate", list(candidates.cases)),
            "candidate_part": ("candidate", list(candidates.parts)),
            "looks": choice.looks,
        },
        {"candidate": list(candidates.names), "random_number": np.arange(1, most + 1)},
    )


def with_values(
    found: xr.Dataset,
    values: Measurements,
    sigma: FloatArray,
    candidates: Candidates,
    mesh: FloatArray | None = None,
    *,
    noise: bool = False,
) -> xr.Dataset:
    """Add what the values of the candidates are, and say of which candidates errors of the mesh exceed the noise.

    The standard deviations (m,) are of the errors of all values. What the mesh is said to take away from them (m,) is
    NaN where that is not known, and may count as noise already.
    """
    which, names = candidates.which, candidates.names
    found = found.assign(
        value_candidate=("value", which),
        value_sigma=("value", sigma),
        value_place=(("value", "axis"), values.places),
        value_case=("value", values.tests),
        value_part=("value", values.names),
    ).assign_coords(value=values.labels)
    if mesh is None or not np.isfinite(mesh).any():
        return found
    found = found.assign(value_mesh_error=("value", mesh))
    measured = (which >= 0) & np.isfinite(mesh)
    own = np.sqrt(np.maximum(sigma**2 - mesh**2, 0)) if noise else sigma
    ratios = np.divide(mesh, own, out=np.zeros_like(mesh), where=measured & (own > 0))[measured]
    count, size = np.bincount(which[measured], minlength=len(names)), len(names)
    times = np.sqrt(np.bincount(which[measured], ratios**2, size) / np.maximum(count, 1))
    off, chosen = int((times > 1).sum()), found["chosen"].to_numpy()
    if not off:
        return found
    worst = chosen[np.argmax(times[chosen])]
    said = {
        "off": off,
        "size": size,
        "off_chosen": int((times[chosen] > 1).sum()),
        "chosen": len(chosen),
        "worst": names[worst],
        "times": times[worst],
    }
    add(found, Finding("design-mesh-as-noise", "note", said) if noise else Finding("design-mesh", "warning", said))
    return found
