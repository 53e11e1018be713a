"""The report of a study, and several studies side by side: one HTML file each, with its pictures inside."""

from __future__ import annotations

import base64
import tomllib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.words import number
from uq.findings import findings
from workflows.config.study import Study, StudyError, parse
from workflows.report import bodies, plots, tables, words
from workflows.report.tables import Results, Table
from workflows.report.words import model_in_words
from workflows.results.directory import read_dataset, read_summary, write_text

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes

    from workflows.config.study import AnyStudy

LEVELS_DRAWN = "Residuals at the samples, relative to the loads, and relative change of the moments, level by level."
DERIVATIVES_DRAWN = 6  # parameters whose effect on the body is drawn
MAPS_DRAWN = 4  # parameters whose indices are drawn on the body
NO_BODY = "The body could not be drawn on this machine: drawing needs OpenGL without a display (Debian: libegl1)."


HALF = 8.0  # inches: wider pictures are not legible on half a page


@dataclass(frozen=True)
class Picture:
    """A PNG in base64 with what it shows; `wide` is one of many panels, which needs all of the page."""

    data: str
    caption: str
    wide: bool = False


def write_report(directory: Path) -> Path:
    """Write report.html beside the results of a study.

    Raises
    ------
    FileNotFoundError
        If the directory holds no results.
    """
    path = directory / "report.html"
    dataset, summary, study = _read(directory)
    if isinstance(study, Study):
        write_text(path, _render("report.html.jinja", _context(Results(dataset, summary, study))))
    elif "probability" in dataset:
        write_text(path, _render("selection.html.jinja", _comparison(dataset, summary, study)))
    else:
        write_text(path, _render("inversion.html.jinja", _inversion(dataset, summary, study)))
    return path


def compare(directories: Sequence[Path], out: Path) -> Path:
    """Write the estimates of several studies side by side to the file `out`.

    Raises
    ------
    FileNotFoundError
        If one of the directories holds no results.
    """
    names = _names(directories)
    studies = {}
    for name, directory in zip(names, directories, strict=True):
        dataset, summary, study = _read(directory)
        if not isinstance(study, Study):
            message = f"{directory}: holds no estimates of outputs, expected studies that do, to lay side by side"
            raise StudyError(message)
        studies[name] = Results(dataset, summary, study)
    outputs = dict.fromkeys(output for results in studies.values() for output in results.outputs)
    context = {
        "count": len(studies),
        "studies": tables.costs(studies),
        "outputs": [(output, tables.estimates(studies, output), _compared(studies, output)) for output in outputs],
    }
    write_text(out, _render("comparison.html.jinja", context))
    return out


def _read(directory: Path) -> tuple[xr.Dataset, dict[str, Any], AnyStudy]:
    dataset = read_dataset(directory)
    summary = read_summary(directory)
    if summary is None:
        message = f"{directory}: holds no summary.json, expected the directory of a finished study"
        raise FileNotFoundError(message)
    try:
        return dataset, summary, parse(tomllib.loads(dataset.attrs["config"]))
    except StudyError as error:
        made = dataset.attrs.get("tissuq", "unknown")
        message = f"{directory}: is no study of this version of tissuq, it was made by version {made} ({error.args[0]})"
        raise StudyError(message) from None


def _render(template: str, context: dict[str, Any]) -> str:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(context)


def _context(results: Results) -> dict[str, Any]:
    """Everything that the template of a report shows."""
    dataset, summary = results.dataset, results.summary
    sampled, differentiated = "values" in dataset, "derivative" in dataset
    field_lines, drawn = _bodies(dataset)
    return {
        "title": f"Study {summary['study']}",
        "method": str(type(results.study.method).__doc__).partition("\n")[0],
        "amount": f"{summary['stopped']}; {tables.solves(summary)}, {summary['failed']:,} failed",
        "stability": words.stability(summary["stability"]) if "stability" in summary else None,
        "note": summary.get("note"),
        "findings": findings(dataset),
        "model": list(model_in_words(results.study)),
        "parameters": tables.parameters(results),
        "nominal": tables.nominal(results),
        "references": tables.references(results) if "row_method" in dataset else None,
        "errors": [(o, _errors(results, o)) for o in results.outputs] if "row_method" in dataset else [],
        "moments": tables.moments(results) if "mean" in dataset else None,
        "gains": list(tables.gains(dataset)),
        "quantiles": tables.quantiles(results) if "quantiles" in dataset else None,
        "total_errors": tables.total_errors(results) if "total_error" in dataset else None,
        "meshes": tables.meshes(results) if "mesh_samples" in dataset else None,
        "differences": [_differences(results, o) for o in results.outputs] if "mesh_samples" in dataset else [],
        "expansion": tables.expansion(results) if "multi_index" in dataset else None,
        "levels": tables.levels(results) if "level_change" in dataset else None,
        "controlled": tables.controlled(results) if "level_change" in dataset else None,
        "levels_drawn": [_picture(plots.levels(dataset), LEVELS_DRAWN)] if "level_change" in dataset else [],
        **_sobol(results),
        "bounds": [_bounds(results, output) for output in results.outputs] if "total_bound" in dataset else [],
        "charts": [(output, _charts(dataset, output)) for output in results.outputs] if sampled else [],
        "has_body": results.study.body is not None,
        "field_lines": field_lines,
        "bodies": drawn,
        "sensitivities": [(o, tables.sensitivities(results, o)) for o in results.outputs] if differentiated else [],
        "tornados": [_tornado(dataset, o) for o in results.outputs] if differentiated else [],
        "field_norms": tables.field_norms(results) if "field_derivative_rms" in dataset else None,
        "failures": tables.failures(results) if summary["failures"] else None,
        "failures_line": tables.failures_line(summary),
        "times": list(tables.times(summary)),
        "provenance": list(tables.provenance(summary)),
        "config": dataset.attrs["config"],
    }


def _inversion(dataset: xr.Dataset, summary: dict[str, Any], study: AnyStudy) -> dict[str, Any]:
    """Everything that the template of an inversion shows."""
    from workflows.report import inversion_report

    found = inversion_report.context(dataset, study)
    for one in found["sets"]:
        one["pictures"] = [_picture(*drawn) for drawn in one["pictures"]]
    here = _of_all(dataset, summary, study)
    count = dataset.sizes["data_set"]
    if count > 1 and "data_sets" in summary:
        here["amount"] = f"{count} data sets, {summary['failed']} failed; {tables.solves(summary)}"
    return here | found


def _comparison(dataset: xr.Dataset, summary: dict[str, Any], study: AnyStudy) -> dict[str, Any]:
    """Everything that the template of a comparison of models shows."""
    from workflows.report import selection_report
    from workflows.studies.selection import Comparison

    assert isinstance(study, Comparison)
    return {
        **_of_all(dataset, summary, study),
        "charts": [
            (heading, [_picture(*drawn) for drawn in shown]) for heading, shown in selection_report.pictures(dataset)
        ],
        **selection_report.context(dataset, study),
    }


def _of_all(dataset: xr.Dataset, summary: dict[str, Any], study: AnyStudy) -> dict[str, Any]:
    """What these templates show alike."""
    return {
        "title": f"Study {summary['study']}",
        "findings": findings(dataset),
        "method": str(type(study.method).__doc__).partition("\n")[0],
        "amount": f"{tables.solves(summary)}, {summary['failed']:,} failed",
        "failed_line": tables.failures_line(summary) if summary["failures"] else "none failed",
        "times": list(tables.times(summary)),
        "provenance": list(tables.provenance(summary)),
        "config": dataset.attrs["config"],
    }


def _picture(ax: Axes, caption: str) -> Picture:
    wide = ax.figure.get_figure(root=True).get_size_inches()[0] > HALF
    return Picture(base64.b64encode(plots.png(ax)).decode(), caption, wide=wide)


def _charts(dataset: xr.Dataset, output: str) -> list[Picture]:
    if "density" in dataset:
        return [
            _picture(plots.histogram(dataset, output), f"Density of {output} by the expansion, mean and quantiles.")
        ]
    return [
        _picture(plots.histogram(dataset, output), f"Samples of {output}: density, mean and quantiles."),
        _picture(plots.convergence(dataset, output), f"Running mean of {output} with its 95 % confidence band."),
        _picture(plots.standard_error(dataset, output), f"Standard error of the mean of {output}."),
    ]


def _sobol(results: Results) -> dict[str, Any]:
    """Sobol' indices: tables and pictures by output, shares of all outputs side by side, and those of the field."""
    dataset = results.dataset
    if "sobol_first" not in dataset:
        return {"sobol": [], "stacked": None, "field_sobol": None}
    by_output = []
    for output in results.outputs:
        shown = [tables.sobol(results, output)]
        if "sobol_second" in dataset:
            shown.append(tables.second_order(results, output))
        caption = f"Indices of {output} with 95 % confidence intervals{_largest_of(dataset)}."
        pictures = [_picture(plots.index_bars(dataset, output), caption)]
        if dataset.sizes.get("index_round", 0) > 1:
            caption = f"Indices of {output} against the number of samples, with 95 % confidence bands."
            pictures.append(_picture(plots.index_convergence(dataset, output), caption))
        by_output.append((output, shown, pictures))
    return {
        "sobol": by_output,
        "stacked": _picture(plots.index_shares(dataset), "Shares of the variance: parameters alone, and the rest."),
        "field_sobol": tables.field_sobol(results) if "field_sobol_first" in dataset else None,
    }


def _bounds(results: Results, output: str) -> tuple[str, list[tables.Table], list[Picture]]:
    """Sensitivity of an output from derivatives: tables and pictures."""
    dataset = results.dataset
    summary = f"{output} against its leading direction: a curve, if that direction is all that matters."
    spectrum = f"Eigenvalues of the active subspace of {output} with 95 % ranges."
    return (
        output,
        [tables.bounds(results, output), tables.active_subspace(results, output)],
        [_picture(plots.active_summary(dataset, output), summary), _picture(plots.spectrum(dataset, output), spectrum)],
    )


def _differences(results: Results, output: str) -> tuple[str, str, Table, list[Picture]]:
    dataset = results.dataset
    pictures = [
        _picture(plots.mesh_variance(dataset, output), f"Variance of {output} and of its difference between meshes."),
        _picture(plots.mesh_mean(dataset, output), f"Mean of {output} and of its difference between meshes."),
        _picture(plots.mesh_samples(dataset, output), "Samples on every mesh: taken, and best for other errors."),
        _picture(plots.mesh_cost(dataset, output), "Predicted time of sampling, without linearisations."),
    ]
    return output, tables.rates(results, output), tables.differences(results, output), pictures


def _errors(results: Results, output: str) -> list[tuple[str, tables.Table, list[Picture]]]:
    """Tables and pictures of a comparison of methods."""
    costs: dict[str, plots.Cost] = {"the number of solves": "solves", "processor time": "cpu_seconds"}
    words: dict[str, plots.Estimated] = {"mean": "mean", "standard deviation": "std"}
    shown = []
    for word, estimated in words.items():
        pictures = [
            _picture(
                plots.errors(results.dataset, output, estimated, against),
                f"Error of the {word} of {output} against {cost}.",
            )
            for cost, against in costs.items()
        ]
        shown.append((word, tables.errors(results, output, estimated), pictures))
    return shown


def _tornado(dataset: xr.Dataset, output: str) -> Picture:
    return _picture(plots.tornado(dataset, output), f"Change of {output}, to first order{_largest_of(dataset)}.")


def _largest_of(dataset: xr.Dataset) -> str:
    """Say that bars are not drawn of all parameters."""
    count = dataset.sizes["parameter"]
    return f", the {plots.BARS} largest of {count}" if count > plots.BARS else ""


def _bodies(dataset: xr.Dataset) -> tuple[list[str], list[Picture]]:
    """Pictures of the deformed body, and what is to be said beside them."""
    if "cell_nodes" not in dataset:
        return ["This study keeps no displacement field."], []
    captions = _body_captions(dataset)
    drawn = bodies.pictures(dataset, list(captions))
    if drawn is None:
        return [NO_BODY], []
    where = "its mean displacement" if "field_mean" in dataset else "the displacement at the mean parameters"
    lines = [f"Deformed by {where}, in true scale; the grey lines are the undeformed body."]
    return lines, [Picture(base64.b64encode(drawn[name]).decode(), caption) for name, caption in captions.items()]


def _body_captions(dataset: xr.Dataset) -> dict[str, str]:
    """Return what of the body is drawn, and what the picture shows."""

    def largest(field: str) -> str:
        return f"at most {number(float(np.linalg.norm(dataset[field].to_numpy(), axis=1).max()))} m"

    if "field_mean" in dataset:
        captions = {
            "mean": f"Mean displacement, {largest('field_mean')}.",
            "std": f"Standard deviation of the displacement, {largest('field_std')}. Orange lines: the edges of the "
            "body where every component is one standard deviation larger, and smaller, than its mean.",
        }
    else:
        captions = {"nominal": f"Displacement at the mean parameters, {largest('field_nominal')}."}
    if "field_derivative" in dataset:
        effects = dataset["field_derivative_rms"] * dataset["parameter_std"]
        strongest = dataset["parameter"].to_numpy()[np.argsort(-effects.to_numpy())][:DERIVATIVES_DRAWN]
        for name in strongest:
            captions[f"derivative {name}"] = f"What one standard deviation of {name} moves, to first order."
    if "dominating" in dataset:
        strongest = dataset["parameter"].to_numpy()[np.argsort(-dataset["field_sobol_total"].to_numpy())]
        for name in strongest[:MAPS_DRAWN]:
            captions[f"sobol_first {name}"] = f"First-order index of the displacement for {name}, node by node."
            captions[f"sobol_total {name}"] = f"Total index of the displacement for {name}, node by node."
        captions["dominating"] = "The parameter with the largest total index, node by node."
    if "factor" in dataset:
        for field in dataset["random_field"].to_numpy():
            for i, factor in enumerate(dataset["factor"].sel(random_field=field).to_numpy()):
                ends = f"{number(float(factor.min()), 3)} to {number(float(factor.max()), 3)}"
                captions[f"factor {field} {i}"] = (
                    f"Realisation {i + 1} of the random factor '{field}', {ends}, on the undeformed body."
                )
    return captions


def _names(directories: Sequence[Path]) -> list[str]:
    """Name directories by their last part, or in full where that is not unique."""
    times = Counter(directory.resolve().name for directory in directories)
    names = [d.resolve().name if times[d.resolve().name] == 1 else str(d) for d in directories]
    return names if len(set(names)) == len(names) else [f"{i}: {name}" for i, name in enumerate(names, start=1)]


def _compared(studies: dict[str, Results], output: str) -> list[Picture]:
    """Mean and standard deviation beside each other; nothing where no study estimates them."""
    datasets = {n: r.dataset for n, r in studies.items() if output in r.outputs and "mean" in r.dataset}
    if not datasets:
        return []
    return [
        _picture(plots.comparison(datasets, output, "mean"), f"Mean of {output}, with 95 % confidence intervals."),
        _picture(plots.comparison(datasets, output, "std"), f"Standard deviation of {output}, likewise."),
    ]
