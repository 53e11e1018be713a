"""What a run prints at its end: numbers with all their errors, in at most 80 columns where names are short."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.readable import NONE, duration, margin, named, number, scale, with_error
from uq.estimators.estimate import ESTIMATED, Estimate, single
from uq.findings import DIGITS, NOT_KNOWN, meshes_unknown, only_rounding
from workflows.report import words
from workflows.results.summary import leading

if TYPE_CHECKING:
    import xarray as xr

    from workflows.studies.study import StudyKind

WIDTH = 24  # letters of a bar
MANY = 12  # outputs that are told
MOST = 11  # lines that notes fill up; one more says where the report is
Row = Sequence[str]


def closing_words(dataset: xr.Dataset, summary: dict[str, Any], study: StudyKind) -> str:
    """Summarise the results at the end of a run: after what makes them doubtful, which is read first.

    What estimates outputs has a table of them; other studies have the answers that their report begins with.
    """
    said = [(one["severity"], f"{one['severity']}: {one['text']}") for one in summary["findings"]]
    lines = [line for severity, line in said if severity != "note"]
    if "outputs" not in summary or "methods" in summary:
        lines += answers(dataset, summary, study)
    sets = summary.get("data_sets", {}).items()
    lines += [f"{name}: failed: {found['failed']}" for name, found in sets if "failed" in found]
    lines += _outputs(dataset, summary.get("outputs", {}))
    lines += _bars(summary)
    failed = f"{summary['failed']}{' data sets' if len(summary.get('data_sets', ())) > 1 else ''} failed"
    took, own = f"{summary['wall_seconds']:.1f} s", summary["own_seconds"]
    if own > summary["cpu_seconds"] / 2:  # a third of all, or more
        took += f", of which the method itself {duration(own)} of processor time"
    lines.append(f"{words.counted(words.solves(summary))} in {took}, {failed}")
    if "stability" in summary:
        lines.append(words.stability(summary["stability"]))
    if "joined" in summary:
        lines.append(words.joined(summary["joined"], summary["work"]))
    if "note" in summary:
        lines.append(summary["note"])
    notes = [line for severity, line in said if severity == "note"]
    if len(lines) + len(notes) > MOST:
        kept = notes[: max(MOST - 1 - len(lines), 0)]
        notes = [*kept, f"notes: {len(notes) - len(kept)} more in summary.json"]
    return "\n".join([*lines, *notes]) + "\n"


def answers(dataset: xr.Dataset, summary: dict[str, Any], study: StudyKind) -> Iterator[str]:
    """Write the answers that the report begins with, a line each."""
    from workflows.report.section import SECTIONS, Results

    for block in SECTIONS["answer"]().content(Results(dataset, summary, study)):
        yield from (line.replace("\u00a0", " ") for line in block.lines)


def _outputs(dataset: xr.Dataset, outputs: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Moments of the outputs, each output in one unit, with the errors of the mesh where there are any."""
    if not outputs:
        return
    units = {output: str(dataset.unit.sel(output=output).item()) for output in outputs}
    unknown, rounding = meshes_unknown(dataset), only_rounding(dataset, units).tolist()
    meshed = any(np.isfinite(single(values, "mean").mesh) for values in outputs.values())
    told = leading(dataset, outputs, MANY)
    rows: list[Row] = [("", "value ± sampling", *(("mesh", "in all", "corrected") if meshed else ()))]
    for (output, values), nothing in zip(outputs.items(), rounding, strict=True):
        if output not in told:
            continue
        found = {name: single(values, name) for name in ESTIMATED}
        size, unit = scale(max(abs(found["mean"].value), found["std"].value), units[output])
        rows.append((named(output, unit) + (": zero but for rounding" if nothing else ""),))
        for name in ESTIMATED if not nothing else ():
            one = Estimate(*(part / size for part in found[name]))
            write = f"{number(one.value, DIGITS)} ± {margin(one.error)}"
            value = write if unknown.get(output) else with_error(one.value, one.error)
            rows.append((f"  {name}", value, *_of_mesh(one, known=output not in unknown)))
    yield from _table(rows)
    if len(told) < len(outputs):
        yield f"and {len(outputs) - len(told)} outputs that vary less, in results.nc"


def _of_mesh(one: Estimate[float], *, known: bool) -> list[str]:
    """Write the error of the mesh of an estimate, the total of its errors, and what it is once corrected."""
    sign = "+" if one.mesh >= 0 else ""
    if np.isfinite(one.corrected):
        return [f"{sign}{with_error(one.mesh, one.doubt)}", margin(one.total), with_error(one.corrected, one.left)]
    if np.isfinite(one.mesh):  # of the finest of several meshes; comparisons look at one, and add nothing
        return [f"{sign}{number(one.mesh, 2)}", margin(one.total), NONE]
    return [] if known else [NOT_KNOWN]


def _bars(summary: Mapping[str, Any]) -> list[str]:
    """Draw what each error takes of a tolerance for all of them, and say what it costs and why."""
    told = summary.get("accuracy")
    if told is None:
        return []
    shares, costs = told["shares"], summary.get("accuracy_seconds", {})
    worst = f"the {told['worst']['of']} of {told['worst']['output']}"
    kept = "kept" if told["kept"] else "NOT kept"
    if told["unmet"]:
        kept += f", all samples of {', '.join(told['unmet'])} are the same"
    if told["mesh"] is not None and not told["mesh"]["estimated"]:
        kept += " but for the mesh, whose error is not known"
    lines = [f"tolerance {told['tolerance']:g}: {kept}; {worst} is known to {told['reached']:.2g}"]
    for source, share in shares.items():
        full = min(WIDTH, round(WIDTH * share))
        cost = f"{costs[source]:8.3g} s of CPU" if source in costs else ""
        lines.append(f"  {source:9} {'█' * full}{'·' * (WIDTH - full)} {100 * share:5.1f} %{cost}".rstrip())
    return [*lines, *(f"  {reason}" for reason in told["reasons"])]


def _table(rows: Sequence[Row]) -> Iterator[str]:
    """Columns side by side, the first to the left, numbers to the right; a row of one cell is as wide as it is."""
    columns = list(zip_longest(*(row for row in rows if len(row) > 1), fillvalue=""))
    first, *widths = (max(map(len, column)) for column in columns)
    for row in rows:
        cells = [row[0].ljust(first), *(cell.rjust(width) for cell, width in zip(row[1:], widths, strict=False))]
        yield ("  ".join(cells) if len(row) > 1 else row[0]).rstrip()
