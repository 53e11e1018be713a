"""What was chosen to be measured, as files: a table, what other studies take of a specimen, and a form for the data."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from inverse.designs.greedy import NEAR

if TYPE_CHECKING:
    import xarray as xr

    from forward.spec import ModelSpec


def files(spec: ModelSpec, found: xr.Dataset) -> dict[str, str]:
    """Return a table of the chosen observations, and of a specimen what other studies take, by their names."""
    texts = {"design.csv": _table(found)}
    if spec.placed:
        blocks = (
            [f"{key} = {json.dumps(value, ensure_ascii=False)}" for key, value in one.items()]
            for one in observed(found)
        )
        lines = "".join(f"    {{ {', '.join(block)} }},\n" for block in blocks)
        texts["observed.toml"] = f"# What was chosen, for the block [model] of a specimen.\nobserved = [\n{lines}]\n"
        texts["observed.csv"] = _form(found)
    return texts


def _table(found: xr.Dataset) -> str:
    """The chosen observations in their order."""
    head = ["order", "name", "case", "x", "y", "z", "measured", "cost", "gain", "information"]
    rows = [head]
    for k, one in enumerate(found["chosen"].to_numpy()):
        at = found.isel(candidate=int(one), choice=k)
        place = ["" if np.isnan(x) else _metres(x) for x in at["candidate_place"].to_numpy()]
        words = [str(at[f"candidate_{what}"].item()) for what in ("case", "part")]
        numbers = [f"{float(at[what]):.6g}" for what in ("candidate_cost", "gain", "information")]
        rows.append([str(k + 1), str(at["candidate"].item()), words[0], *place, words[1], *numbers])
    return _csv(rows)


def observed(found: xr.Dataset) -> list[dict[str, Any]]:
    """Return blocks `model.observed` of the chosen displacements, in their order."""
    blocks = []
    for k, rows in enumerate(_rows(found)):
        cases: dict[tuple[tuple[float, ...], str], list[str]] = {}
        parts: dict[tuple[tuple[float, ...], str], str] = {}
        for row in rows:
            place = tuple(np.round(found["value_place"].to_numpy()[row], NEAR).tolist())
            case, part = (str(found[f"value_{what}"].to_numpy()[row]) for what in ("case", "part"))
            parts[place, case] = parts.get((place, case), "") + part
        for (place, case), components in parts.items():
            cases.setdefault((place, components), []).append(case)
        for i, ((place, components), where) in enumerate(cases.items()):
            name = f"{k + 1}" if len(cases) == 1 else f"{k + 1}-{i + 1}"
            block = {"name": name, "at": [list(place)], "components": components, "cases": where}
            blocks.append(block)
    return blocks


def _rows(found: xr.Dataset) -> list[list[int]]:
    """Numbers of the displacements of each chosen candidate."""
    at = np.isfinite(found["value_place"].to_numpy()).all(axis=1)
    which = found["value_candidate"].to_numpy()
    return [np.flatnonzero((which == one) & at).tolist() for one in found["chosen"].to_numpy()]


def _form(found: xr.Dataset) -> str:
    """A table of data to be filled in: a row for each point in a load case, with the errors that were assumed."""
    rows = [["x", "y", "z", "ux", "uy", "uz", "sigma", "case", "output", "value", "sigma_value"]]
    sigma, which = found["value_sigma"].to_numpy(), found["value_candidate"].to_numpy()
    chosen = found["chosen"].to_numpy()
    displaced = set()
    for numbers in _rows(found):
        seen = set()
        for row in numbers:
            displaced.add(row)
            place = tuple(map(_metres, found["value_place"].to_numpy()[row]))
            case = str(found["value_case"].to_numpy()[row])
            if (place, case) not in seen:
                seen.add((place, case))
                rows.append([*place, "", "", "", f"{sigma[row]:.4e}", case, "", "", ""])
    for row in (row for one in chosen for row in np.flatnonzero(which == one).tolist() if row not in displaced):
        case, part = (str(found[f"value_{what}"].to_numpy()[row]) for what in ("case", "part"))
        rows.append([*[""] * 7, case, part, "", f"{sigma[row]:.4e}"])
    if all(not any(row[8:]) for row in rows[1:]):
        rows = [row[:8] for row in rows]
    return "# To be filled in: measured displacements (m) at the chosen points.\n" + _csv(rows)


def _metres(x: float) -> str:
    return f"{np.round(x, NEAR) + 0.0:.8g}"


def _csv(rows: Sequence[Sequence[str]]) -> str:
    file = io.StringIO()
    csv.writer(file, lineterminator="\n").writerows(rows)
    return file.getvalue()
