"""What a study found out about the worth of its own numbers, kept with the results."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from forward.findings import Entry, Finding, Severity, entries

if TYPE_CHECKING:
    import xarray as xr

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")  # the most severe first
MANY = 3  # steps at which a list says the same
UNKNOWN = "mesh_unknown"  # attribute of results, see `keep_unknown`
NOT_KNOWN = "mesh not known"  # beside every error that is of sampling alone
DIGITS = 2  # of numbers whose error of the mesh was to be known, and is not
ROUNDING = 1e-9  # of the largest quantity of the same unit: what is zero by symmetry is smaller
NUMBER = "1"  # unit of ratios, which differ in size
LENGTH = "m"  # unit of the displacement field


def add(dataset: xr.Dataset, *found: Finding, first: bool = False) -> None:
    """Keep findings in ``dataset.attrs["findings"]``, each once, after those that are there, or before them."""
    there = _kept(dataset)
    if found or there:
        _keep(dataset, dict.fromkeys([*found, *there] if first else [*there, *found]))


def withdraw(dataset: xr.Dataset, names: Collection[str]) -> None:
    """Forget what findings say of these outputs, and findings that say nothing of others."""
    left = [(one, tuple(entry for entry in one.about if entry.name not in names)) for one in _kept(dataset)]
    _keep(dataset, [replace(one, about=about) for one, about in left if about or not one.about])


def once_for_steps(dataset: xr.Dataset) -> None:
    """Say once what findings say of one output at several steps of a path, in the words of the first of them.

    Of a list within a finding, what it says of an output at three steps or more becomes the largest, with the steps.
    """
    places = {
        str(name): (str(of), int(step))
        for name, of, step in zip(*(dataset[key].values for key in ("output", "output_of", "step")), strict=True)
    }
    shorter = [replace(one, about=_shorter(one.about, places)) for one in _kept(dataset)]
    said = [
        replace(first, also=f"at {_steps([places[name][1] for name in others])}") if others else first
        for first, others in _alike(shorter, {name: of for name, (of, _) in places.items()})
    ]
    if said:
        _keep(dataset, said)


def once_for_outputs(found: Iterable[Finding], names: Iterable[str]) -> list[Finding]:
    """Say once what findings say of several outputs, given by their names, in the words of the first of them."""
    groups = _alike(found, dict.fromkeys(names, ""))
    return [replace(first, also=f"of {', '.join(others)}") if others else first for first, others in groups]


def _alike(found: Iterable[Finding], kinds: Mapping[str, str]) -> list[tuple[Finding, list[str]]]:
    """Return findings, and the outputs of which later ones say the same with other numbers.

    That is, of one output each, of the same kind by `kinds`; findings of other outputs or several stay alone.
    """
    groups: dict[object, tuple[Finding, list[str]]] = {}
    for one in found:
        name = one.about[0].name if len(one.about) == 1 else ""
        if name not in kinds:
            groups[object()] = one, []
            continue
        words = tuple((key, value) for key, value in one.values.items() if isinstance(value, str))
        key = one.code, one.severity, one.subject, words, kinds[name]
        if key in groups:
            groups[key][1].append(name)
        else:
            groups[key] = one, []
    return list(groups.values())


def _shorter(about: Sequence[Entry], places: Mapping[str, tuple[str, int]]) -> tuple[Entry, ...]:
    """Shorten a list of outputs: F.1 2%, F.2 5%, F.3 4% to F 5% (step 2, the largest of steps 1 to 3)."""
    alike: dict[object, list[Entry]] = {}
    for entry in about:
        alike.setdefault(places[entry.name][0] if entry.name in places else object(), []).append(entry)
    short = []
    for of, several in alike.items():
        if len(several) < MANY:
            short += several
            continue
        steps = _steps([places[entry.name][1] for entry in several])
        if any(entry.size is None for entry in several):
            short.append(Entry(f"{of} at {steps}", several[0].words))
            continue
        most = max(several, key=lambda entry: abs(entry.size or 0.0))
        where = f" (step {places[most.name][1]}, the largest of {steps})"
        short.append(Entry(str(of), most.words + where, most.size))
    return tuple(short)


def _steps(steps: Collection[int]) -> str:
    """Name steps: "step 2", "steps 2, 10", "steps 2 to 5"."""
    first, *others = sorted(steps)
    if not others:
        return f"step {first}"
    if len(steps) >= MANY and others[-1] - first == len(others):
        return f"steps {first} to {others[-1]}"
    return f"steps {', '.join(map(str, [first, *others]))}"


def findings(dataset: xr.Dataset) -> list[Finding]:
    """Return the findings that a dataset keeps, the most severe first."""
    return sorted(_kept(dataset), key=lambda one: SEVERITIES.index(one.severity))


def keep_unknown(dataset: xr.Dataset, names: Collection[str], planned: Collection[str]) -> None:
    """Keep which outputs have a mesh whose error is not known, so that their errors are of sampling alone.

    Parameters
    ----------
    dataset
        The results.
    names
        These outputs.
    planned
        Outputs whose error of the mesh was to be estimated.
    """
    if names:
        dataset.attrs[UNKNOWN] = json.dumps({name: name in planned for name in names}, ensure_ascii=False)


def meshes_unknown(dataset: xr.Dataset) -> dict[str, bool]:
    """Return the outputs whose error of the mesh is not known, and whether its estimates have failed."""
    found: dict[str, bool] = json.loads(dataset.attrs.get(UNKNOWN, "{}"))
    return found


def _kept(dataset: xr.Dataset) -> list[Finding]:
    return [Finding.read(one) for one in json.loads(dataset.attrs.get("findings", "[]"))]


def _keep(dataset: xr.Dataset, found: Iterable[Finding]) -> None:
    kept = [one.kept() for one in found]
    dataset.attrs["findings"] = json.dumps(kept, ensure_ascii=False, default=lambda number: number.item())


def only_rounding(dataset: xr.Dataset, units: Mapping[str, str]) -> NDArray[np.bool_]:
    """Say which outputs (m,) are rounding beside others of the same unit, or beside the displacement field.

    Parameters
    ----------
    dataset
        Results: values at the mean parameters, moments where there are some, fields where there are some.
    units
        Of the outputs.
    """
    known = [units.get(str(name), "1") for name in dataset["output"].values]
    sizes = np.zeros(len(known))
    for name in ("nominal", "mean", "std"):
        if name in dataset and dataset[name].dims == ("output",):
            sizes = np.fmax(sizes, np.abs(dataset[name].to_numpy()))
    largest = {unit: float(sizes[[other == unit for other in known]].max()) for unit in known}
    for name in ("field_nominal", "field_mean"):
        if name in dataset and LENGTH in largest and dataset[name].size:
            largest[LENGTH] = max(largest[LENGTH], float(np.nanmax(np.abs(dataset[name].to_numpy()))))
    comparable = np.array([unit != NUMBER for unit in known])
    return np.asarray(comparable & (sizes <= ROUNDING * np.array([largest[unit] for unit in known])))


def settled(dataset: xr.Dataset, units: Mapping[str, str]) -> None:
    """Withdraw what was said of outputs that are rounding, of which nothing can be explained, and say that they are."""
    names = [str(name) for name in dataset["output"].values[only_rounding(dataset, units)]]
    if names:
        withdraw(dataset, names)
        be = "is" if len(names) == 1 else "are"
        add(dataset, Finding("only-rounding", "note", {"be": be}, about=entries(names)))
