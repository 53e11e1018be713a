"""What a run prints at its end: numbers with all their errors, in at most 80 columns where names are short."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.words import NONE, duration, named, places
from uq.estimators.estimate import ESTIMATED, single
from uq.findings import DIGITS, NOT_KNOWN, meshes_unknown, only_rounding
from workflows.report import words

if TYPE_CHECKING:
    import xarray as xr

    from workflows.studies.study import StudyKind

MOST = 8  # significant digits of values
SMALL = -5  # power of ten below which it is written
PARAMETERS = 12  # of which derivatives are listed
WIDTH = 24  # letters of a bar
Row = Sequence[str]


def closing_words(dataset: xr.Dataset, summary: dict[str, Any], study: StudyKind) -> str:
    """Summarise the results at the end of a run: after what makes them doubtful, which is read first.

    What estimates outputs has tables of them; other studies have the answers that their report begins with.
    """
    severe = [one for one in summary["findings"] if one["severity"] != "note"]
    notes = [one for one in summary["findings"] if one["severity"] == "note"]
    lines = _said(severe)
    before = len(lines)
    if not {"outputs", "methods", "local"} & summary.keys():
        lines += _answers(dataset, summary, study)
    sets = summary.get("data_sets", {}).items()
    lines += [f"{name}: failed: {found['failed']}" for name, found in sets if "failed" in found]
    lines += _outputs(dataset, summary.get("outputs", {}))
    lines += _bars(summary)
    first = next(iter(dataset.output.values)) if "output" in dataset.coords else ""
    for name, rows in summary.get("methods", {}).items():
        last = rows[-1]
        lines.append(
            f"{name}: {last['cost']} solves, {last['cpu_seconds']:.3g} s, "
            f"root mean square error of the mean of {first} {last['error'] or float('nan'):.2g}"
        )
    if len(lines) == before:
        lines += _derivatives(dataset, summary)
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
    return "\n".join([*lines, *_said(notes)]) + "\n"


def _said(findings: Sequence[Mapping[str, str]]) -> list[str]:
    return [f"{one['severity']}: {one['text']}" for one in findings]


def _answers(dataset: xr.Dataset, summary: dict[str, Any], study: StudyKind) -> Iterator[str]:
    """Write the answers that the report begins with, a line each."""
    from workflows.report.blocks import Card, Text
    from workflows.report.section import SECTIONS, Results

    for block in SECTIONS["answer"]().content(Results(dataset, summary, study)):
        for one in block.answers if isinstance(block, Card) else ():
            yield "; ".join([f"{one.name}: {one.value}", *one.lines]).replace("\u00a0", " ")
        if isinstance(block, Text):  # how many others there are
            yield block.text


def _outputs(dataset: xr.Dataset, outputs: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Moments of the outputs: in a table with the errors of the mesh where there are any, else a line each."""
    unknown = meshes_unknown(dataset)
    if not any(np.isfinite(single(values, "mean").mesh) for values in outputs.values()):
        for output, values in outputs.items():
            yield _line(output, values, _unit(dataset, output), unknown.get(output))
        return
    rounding = only_rounding(dataset, {output: _unit(dataset, output) for output in outputs})
    rows: list[Row] = [("", "value", "sampling", "mesh", "in all", "corrected")]
    for (output, values), nothing in zip(outputs.items(), rounding.tolist(), strict=True):
        rows.append((named(output, _unit(dataset, output)) + (": zero but for rounding" if nothing else ""),))
        for name in ESTIMATED if not nothing else ():
            one = single(values, name)
            of_mesh = ["not known" if output in unknown else NONE]
            if np.isfinite(one.corrected):
                of_mesh = [_signed(one.mesh, one.doubt), _error(one.total), _plus_minus(one.corrected, one.left)]
            elif np.isfinite(one.mesh):  # of the finest of several meshes; comparisons look at one, and add nothing
                of_mesh = [f"{one.mesh:+.2g}", NONE if np.isnan(one.total) else _error(one.total), NONE]
            value = _two(one.value) if unknown.get(output) else _value(one.value, one.error)
            rows.append((f"  {name}", value, _error(one.error), *of_mesh))
    yield from _table(rows)


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


def _line(output: str, values: Mapping[str, Any], unit: str, failed: bool | None) -> str:
    """Moments of an output, and whether estimates of the error of its mesh have failed: None if it is known."""
    write = _two_plus_minus if failed else _plus_minus
    return (
        f"{output}: mean {write(values['mean'], values['mean_error'])} {unit}, "
        f"standard deviation {write(values['std'], values['std_error'])} {unit}"
    ) + ("" if failed is None else f" (± is of sampling, {NOT_KNOWN})")


def _derivatives(dataset: xr.Dataset, summary: Mapping[str, Any]) -> Iterator[str]:
    """Outputs at the mean parameters, and the effects of the parameters to first order."""
    shown = summary.get("local_per_range", {})
    nominal = {output: single(dataset.sel(output=output), "nominal") for output in shown}
    known = any(np.isfinite(one.mesh) for one in nominal.values())
    unknown = meshes_unknown(dataset)
    rows: list[Row] = [("", "value", *(("mesh", "corrected") if known else ()))]
    for output, slopes in shown.items():
        rows.append((named(output, _unit(dataset, output)),))
        at = nominal[output]
        digits, gap = DIGITS if unknown.get(output) else 4, ("not known",) * (known and output in unknown)
        rows.append(("  at the mean parameters", *_with_mesh(at.value, at.mesh, at.doubt, digits), *gap))
        spreads = [_spread(dataset, summary, output, name, slope) for name, slope in slopes.items()]
        spreads.sort(key=lambda one: -abs(one[1]))
        for name, value, factor in spreads[:PARAMETERS]:
            slope = single(dataset.sel(output=output, parameter=name), "derivative")
            rows.append((f"  {name}", *_with_mesh(value, slope.mesh * factor, slope.doubt * factor, digits)))
        if len(spreads) > PARAMETERS:
            rows.append((f"  {len(spreads) - PARAMETERS} smaller ones are in summary.json",))
    if len(rows) > 1:
        yield "Derivatives × range of the parameter (× standard deviation where it has no bounds):"
        yield from _table(rows)


def _spread(
    dataset: xr.Dataset, summary: Mapping[str, Any], output: str, name: str, per_range: float | None
) -> tuple[str, float, float]:
    """Return a parameter, its effect to first order, and what derivatives by it are multiplied by."""
    if per_range is not None:
        return name, per_range, float(dataset["parameter_range"].sel(parameter=name))
    effect = summary["local_per_std"][output][name]
    return name, float("nan") if effect is None else effect, float(dataset["parameter_std"].sel(parameter=name))


def _with_mesh(value: float, error: float, doubt: float, digits: int) -> list[str]:
    if not (np.isfinite(error) and np.isfinite(doubt)):
        return [f"{value:.{digits}g}"]
    return [f"{value:.6g}", _signed(error, doubt), _plus_minus(value + error, doubt)]


def _unit(dataset: xr.Dataset, output: str) -> str:
    return str(dataset.unit.sel(output=output).item())


def _plus_minus(value: float, error: float) -> str:
    return f"{_value(value, error)} ± {_error(error)}"


def _two_plus_minus(value: float, error: float) -> str:
    return f"{_two(value)} ± {_error(error)}"


def _two(value: float) -> str:
    """Write a value of whose error only a part is known."""
    return f"{value:.{DIGITS}g}"


def _error(error: float) -> str:
    return _value(error, error) if error else "0"


def _signed(value: float, doubt: float) -> str:
    return f"{'+' if value >= 0 else ''}{_value(value, doubt)}"


def _value(value: float, error: float) -> str:
    """Write a value with as many digits as its error leaves."""
    if not (math.isfinite(value) and value and error > 0):
        return NONE if math.isnan(value) else f"{value:.6g}"
    power = math.floor(math.log10(max(abs(value), error)))
    after = min(places(error), MOST - 1 - power)
    if SMALL <= power < MOST:
        return f"{round(value, after):.{max(after, 0)}f}"
    shown = round(value, after)
    return f"{shown:.{max(math.floor(math.log10(abs(shown))) + after, 0)}e}" if shown else "0"


def _table(rows: Sequence[Row]) -> Iterator[str]:
    """Columns side by side, the first to the left, numbers to the right; a row of one cell is as wide as it is."""
    count = max(map(len, rows))
    whole = [row for row in rows if len(row) > 1]
    widths = [max(len(row[i]) for row in whole if len(row) > i) for i in range(count)]
    for row in rows:
        cells = [
            row[0].ljust(widths[0]),
            *(cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=False)),
        ]
        yield ("  ".join(cells) if len(row) > 1 else row[0]).rstrip()
