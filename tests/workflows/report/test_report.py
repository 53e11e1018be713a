"""Reports and pictures from small results in the layout of a study, without a finite-element model."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from matplotlib.figure import Figure

from forward import readable
from forward.model import WORK, SolveError
from forward.pointwise import FunctionModel
from uq.estimators.indices import field_indices
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import LogNormal, Normal, Uniform
from workflows.config.study import dump, parse
from workflows.report import bodies, plots
from workflows.report.page import compare, write_report
from workflows.report.plots import outputs, posterior
from workflows.report.plots.figure import ON_DEEP, png_of
from workflows.report.sections.frame import model_in_words
from workflows.results.directory import above_rounding, blank_where_still, label, node_fields, write_dataset
from workflows.results.summary import summarise

CUBE = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
HEXAHEDRON = [[0, 4, 6, 2, 1, 5, 7, 3]]
PNG = b"\x89PNG"


def study(**method):
    return parse(
        {
            "model": {
                "kind": "hyperelastic",
                "body": {"kind": "box", "size": [1.0, 1.0, 1.0], "cells": [1, 1, 1], "degree": 1},
                "material": {"kind": "mooney-rivlin", "C1": 1e4, "C2": 2e5, "D1": 3e5},
                "clamp": ["x-min"],
                "loads": [{"kind": "gravity", "direction": [0, -1, 0], "density": 750.0}],
                "outputs": [
                    {"name": "sag", "kind": "max-displacement", "component": "y"},
                    {"name": "<i>v$_1$ & w", "kind": "volume-change"},
                ],
            },
            "parameters": {
                "loads.gravity.density": {"kind": "uniform", "lower": 600.0, "upper": 900.0},
                "material.D1": {"kind": "normal", "mean": 3e5, "std": 2e4},
            },
            "method": {"kind": "sensitivity-monte-carlo", "samples": 60, "seed": 7} | method,
        }
    )


def study_of(method):
    """The same study with a method of another kind."""
    return parse({**study().model_dump(mode="json", exclude_none=True), "method": method})


def test_inclusions_in_words():
    blocks = study().model_dump(exclude_none=True)
    ball = {"name": "tumour", "x": 0.5, "y": 0.5, "z": 0.5, "radius": 0.2, "contrast": 4.0, "width": 0.1}
    blocks["model"]["inclusions"] = [ball]
    blocks["parameters"] = {"inclusions.tumour.radius": {"kind": "uniform", "lower": 0.1, "upper": 0.3}}
    said = dict(model_in_words(parse(blocks)))["inclusions"]
    assert said == ["tumour (sphere): x = 0.5 m, y = 0.5 m, z = 0.5 m, radius = random, contrast = 4, width = 0.1 m"]
    assert readable.per("m", "1") == "m"


def function(point):
    density, bulk = point[0] / 750, point[1] / 3e5
    return np.array([0.1 * density**2 / bulk, -0.02 * density * bulk])


def jacobian(point):
    density, bulk = point[0] / 750, point[1] / 3e5
    by_density = np.array([0.2 * density / bulk, -0.02 * bulk]) / 750
    by_bulk = np.array([-0.1 * density**2 / bulk**2, -0.02 * density]) / 3e5
    return np.column_stack([by_density, by_bulk])


def fragile(point):
    if point[0] > 880:
        raise SolveError("stopped at <b>40 %</b> of the load")
    return function(point)


def solve(case, of=function):
    """The dataset of a study whose model is a formula."""
    model = FunctionModel(of, case.inputs.names, tuple(o.name for o in case.model.outputs), jacobian)
    dataset = case.method.run(case.inputs, SerialEvaluate(model))
    fields = ["nominal"] if case.method.kind == "local-sensitivity" else ["nominal", "mean", "std"]
    if getattr(case.method, "fields", True):
        motion = -0.1 * CUBE[:, :1] * np.array([0.2, 1.0, 0.0])
        dataset = dataset.assign({f"field_{name}": (("node", "component"), motion) for name in fields})
        dataset["field_derivative"] = (("parameter", "node", "component"), np.array([motion, -motion]) / 750)
        dataset["field_derivative_rms"] = ("parameter", [1.5e-3, 2e-6])
    dataset = label(dataset, {o.name: o.unit for o in case.model.outputs}, CUBE, HEXAHEDRON, 12)
    dataset.attrs |= {"study": "cube", "method": case.method.kind, "config": dump(case)}
    return dataset


def write(directory: Path, dataset: xr.Dataset) -> Path:
    """Write results as a run leaves them."""
    directory.mkdir()
    write_dataset(directory / "results.nc", dataset)
    lost = dataset["points"].to_numpy()[~dataset["ok"].to_numpy()] if "ok" in dataset else []
    failures = [
        {"parameters": dict(zip(dataset.parameter.values, map(float, p), strict=True)), "reason": "<b>40 %</b> only"}
        for p in lost
    ]
    summary = {
        "study": "cube",
        "method": dataset.attrs["method"],
        "status": "complete",
        "stopped": dataset.attrs.get("stopped", "one linearisation"),
        **({"note": dataset.attrs["note"]} if "note" in dataset.attrs else {}),
        "evaluations": 1 + dataset.sizes.get("sample", 0),
        "failed": len(failures),
        "failures": failures,
        "wall_seconds": 250.0,
        "cpu_seconds": 12.2,
        "work": dict.fromkeys(WORK, 122),
        **summarise(dataset),
        "provenance": {
            "date": "2024-02-03T04:05:06+00:00",
            "seed": 7,
            "ranks": 2,
            "groups": 2,
            "processor": "x86_64",
            "commit": "0123456789ab",
            "versions": {"python": "3.11.2", "tissuq": "0.1.0"},
        },
    }
    (directory / "summary.json").write_text(json.dumps(summary))
    return directory


@pytest.fixture(scope="module")
def sampled():
    return solve(study())


def test_report_tells_what_was_computed_and_found(tmp_path, sampled, undrawn):
    page = write_report(write(tmp_path / "out", sampled)).read_text()
    sag = sampled.sel(output="sag")
    for text in (
        "Study cube",
        "Compressible Mooney–Rivlin",
        "24 displacements",
        "x-min clamped",
        "uniform: lower = 600, upper = 900",
        "kg/m³",
        readable.and_error(float(sag["mean"]), float(sag["mean_error"]), "m"),
        readable.and_error(float(sag["std"]), float(sag["std_error"]), "m"),
        readable.and_error(float(sag["plain_mean"]), float(sag["plain_mean_error"]), "m"),
        readable.and_error(float(sag["quantiles"][0]), float(sag["quantiles_error"][0]), "m"),
        f"worth {readable.number(float(sag['variance_ratio']), 3)} plain samples for the mean",
        "2.6667 × 10⁻⁴ m/(kg/m³)",
        "root mean square of the derivative",
        "None failed.",
        "4 min 10 s",
        "122; 2.0 a solve",
        "2024-02-03 04:05:06 UTC",
        "0123456789ab",
        "2 in 2 groups",
        "[model.body]",
    ):
        assert text in page, text
    assert page.count("<figure>") == 2 + 2 * 2 + 2 + 2  # error budgets, charts, bodies, tornado charts
    assert "plain Monte Carlo is better" not in page


def test_report_is_one_file(tmp_path, sampled, undrawn):
    page = write_report(write(tmp_path / "out", sampled)).read_text()
    page = page.replace("http://www.w3.org/2000/svg", "")  # a name, not an address
    sources = re.findall(r'\bsrc="([^,"]*)', page)
    assert set(sources) == {"data:image/png;base64", "data:image/svg+xml;base64"}
    assert not re.search(r"<(link|iframe)|<script src|url\((?!#)|@import|\bhref=|fetch\(|https?://", page)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["report.html", "results.nc", "summary.json"]


def test_failed_solves_are_listed_and_text_is_escaped(tmp_path, undrawn):
    page = write_report(write(tmp_path / "out", solve(study(), fragile))).read_text()
    failed = page.count("&lt;b&gt;40 %&lt;/b&gt; only")
    assert failed > 0
    assert f"{failed} of 61 solves failed." in page
    assert "samples have no answer" in page
    assert "None failed" not in page
    assert "&lt;i&gt;v$_1$ &amp; w" in page
    assert "<i>" not in page
    assert "<b>" not in page


def test_control_variate_that_hurts_is_called_so(tmp_path, sampled, undrawn):
    worse = sampled.assign(variance_ratio=("output", [0.4, 30.0]))
    page = write_report(write(tmp_path / "out", worse)).read_text()
    assert "worth 0.4 plain samples" in page
    assert page.count("For the mean, plain Monte Carlo is better.") == 1


@pytest.mark.parametrize(
    ("control", "words_"),
    [
        ("none", "with Sobol"),
        ("tangent", "points and the control variate"),
        ("chaos", "fitted to 7 separate samples"),
    ],
)
def test_quasi_monte_carlo_is_reported(tmp_path, undrawn, control, words_):
    method = {"kind": "quasi-monte-carlo", "samples": 64, "control": control}
    dataset = solve(parse({**study().model_dump(mode="json", exclude_none=True), "method": method}))
    page = write_report(write(tmp_path / "out", dataset)).read_text()
    sag = dataset.sel(output="sag")
    for text in (
        "Quasi-Monte Carlo: independent scrambles",
        "64 samples (16 scrambles of 4 Sobol",
        "scatter of 16 independent scrambles",
        "a 95 % interval is ± 2.13 of them",
        words_,
        readable.and_error(float(sag["mean"]), float(sag["mean_error"]), "m"),
        readable.and_error(float(sag["std"]), float(sag["std_error"]), "m"),
        f"worth {readable.number(float(sag['variance_ratio']), 3)} plain samples for the mean",
    ):
        assert text in page, text
    assert page.count("<figure>") == 2 + 2 * 2 + 2 + 2


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("samples", [16, 64])
def test_quasi_monte_carlo_is_drawn(samples):
    method = {"kind": "quasi-monte-carlo", "samples": samples, "fields": False, "seed": 7}
    dataset = solve(parse({**study().model_dump(mode="json", exclude_none=True), "method": method}))
    for output in dataset.output.values:
        for draw in (plots.convergence, plots.histogram, plots.tornado):
            assert plots.png(draw(dataset, output)).startswith(PNG)
    line = plots.convergence(dataset, "sag").lines[0]
    assert line.get_ydata()[-1] == pytest.approx(dataset["mean"].sel(output="sag").item())
    assert line.get_xdata()[-1] == samples


def test_expansion_has_its_terms_and_indices(tmp_path, undrawn):
    case = study(kind="chaos", samples=8)
    dataset = solve(case)
    page = write_report(write(tmp_path / "out", dataset)).read_text()
    for told in ("Polynomial chaos", "leave-one-out error", "Sobol", "Density of"):
        assert told in page
    assert "Running mean" not in page
    shares = summarise(dataset)["sobol"]["sag"]["loads.gravity.density"]
    assert set(shares) == {"first", "first_error", "total", "total_error"}
    assert 0 < shares["first"] <= shares["total"] <= 1
    assert case.planned == 9


@pytest.mark.parametrize("design", ["chaos", "saltelli"])
def test_sobol_indices_are_reported(tmp_path, undrawn, design):
    groups = {"both": ["loads.gravity.density", "material.D1"]}
    case = study_of({"kind": "sobol", "design": design, "samples": 64, "second_order": True, "groups": groups})
    dataset = solve(case)
    variance = np.linspace(0, 1, 8)
    maps = field_indices(variance, 0.5 * np.array([variance, variance]), np.array([0.8, 0.6])[:, None] * variance)
    dataset = dataset.assign(maps)
    for name in ("field_sobol_first_error", "field_sobol_total_error"):
        dataset[name] = (("parameter",), [0.01, 0.01])
    page = write_report(write(tmp_path / "out", dataset)).read_text()
    sag = dataset.sel(output="sag", parameter="material.D1")
    for told in (
        "The share of the variance due to a parameter alone",
        readable.with_error(float(sag["sobol_total"]), float(sag["sobol_total_error"])),
        "group both",
        "second order",
        "Generalised indices",
        "against the number of samples",
        "Total index of the displacement for material.D1",
        "The parameter with the largest total index",
    ):
        assert told in page, told
    fields = node_fields(dataset)
    assert fields["dominating"].tolist() == [-1] + 7 * [0]
    np.testing.assert_allclose(fields["sobol_total material.D1"], [0, *7 * [0.6]])
    assert set(summarise(dataset)["sobol"]["sag"]["material.D1"]) == {"first", "first_error", "total", "total_error"}


def test_bounds_are_reported(tmp_path, undrawn):
    dataset = solve(study_of({"kind": "derivative-based", "samples": 64}))
    page = write_report(write(tmp_path / "out", dataset)).read_text()
    sag = dataset.sel(output="sag", parameter="material.D1")
    for told in (
        "Sensitivity from derivatives",
        readable.with_error(float(sag["total_bound"]), float(sag["total_bound_error"])),
        "leading direction",
        "Poincaré constant",
    ):
        assert told in page, told
    assert "Generalised" not in page


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "method",
    [
        {"kind": "sobol", "samples": 12},
        {"kind": "sobol", "design": "saltelli", "samples": 64},
        {"kind": "derivative-based", "samples": 32},
    ],
)
def test_indices_are_drawn(method):
    dataset = solve(study_of({**method, "fields": False}))
    pictures = [plots.index_bars, plots.index_convergence]
    if method["kind"] == "derivative-based":
        pictures = [plots.index_bars, plots.active_summary]
    for output in dataset.output.values:
        for draw in pictures:
            assert plots.png(draw(dataset, output)).startswith(PNG)
    bars = plots.index_shares(dataset).patches
    assert sum(bar.get_width() for bar in bars) == pytest.approx(2, abs=0.3)


@pytest.mark.parametrize(
    "shown", ["", "Standard deviation", "Total index of the displacement for material.D1", "The parameter with"]
)
def test_bodies_are_drawn_for_notebooks(sampled, shown):
    variance = np.linspace(0, 1, 8)
    maps = field_indices(variance, np.array([variance, 0 * variance]), np.array([variance, 0.1 + 0 * variance]))
    drawn = bodies.body(sampled.assign(maps), shown)
    assert png_of(drawn, drawn.dpi).startswith(PNG)
    assert drawn.axes[1].get_ylabel().startswith(shown)


def test_what_can_be_drawn_of_a_body_is_said(sampled):
    with pytest.raises(KeyError, match="expected one of: Mean displacement, Standard deviation of the displacement, "):
        bodies.body(sampled, "Pressure")


def test_levels_are_told_and_drawn(tmp_path, undrawn):
    case = study(kind="multilevel-chaos", samples=16, max_levels=3)
    dataset = solve(case)
    page = write_report(write(tmp_path / "out", dataset)).read_text()
    for told in ("Polynomial chaos", "<h2>Levels</h2>", "change of the moments", "Sobol"):
        assert told in page
    assert case.planned == 49


def test_local_study_has_sensitivities_only(tmp_path, undrawn):
    case = parse({**study().model_dump(mode="json", exclude_none=True), "method": {"kind": "local-sensitivity"}})
    page = write_report(write(tmp_path / "out", solve(case))).read_text()
    assert "Local sensitivities" in page
    assert "Mean and standard deviation" not in page
    assert page.count("<figure>") == 2 + 2  # bodies, tornado charts


def test_study_without_fields_has_no_bodies(tmp_path, undrawn):
    page = write_report(write(tmp_path / "out", solve(study(kind="monte-carlo", fields=False)))).read_text()
    assert "stores no displacement field" in page
    assert "plain samples" not in page


def test_bodies_need_no_graphics_library(tmp_path, sampled, undrawn, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista", None)
    page = write_report(write(tmp_path / "out", sampled)).read_text()
    assert page.count('<div class="viewer"') == 1
    assert page.count("<figure>") == 2 + 2 * 2 + 2 + 2


@pytest.mark.parametrize(
    ("missing", "words"),
    [
        ("results.nc", r"results\.nc is missing, although the study is finished; `tissuq run` .* makes it again"),
        ("summary.json", r"holds no summary\.json, expected the directory of a finished study"),
    ],
)
def test_missing_results_are_named(tmp_path, sampled, missing, words):
    out = write(tmp_path / "out", sampled)
    (out / missing).unlink()
    with pytest.raises(FileNotFoundError, match=words):
        write_report(out)


@pytest.mark.parametrize(
    ("content", "words"), [(b"hello", r"results\.nc: is damaged"), (None, r"results\.nc: holds no results of a study")]
)
def test_foreign_results_are_refused(tmp_path, sampled, content, words):
    out = write(tmp_path / "out", sampled)
    if content is None:
        xr.Dataset({"x": 1.0}).to_netcdf(out / "results.nc", engine="h5netcdf")
    else:
        (out / "results.nc").write_bytes(content)
    with pytest.raises(FileNotFoundError, match=words):
        write_report(out)


def test_what_cannot_be_reported_is_one_line(tmp_path, sampled, undrawn, capsys):
    from workflows.__main__ import main

    one, other = (str(write(tmp_path / name, sampled)) for name in ("one", "other"))
    for arguments, message in (
        ([one, "--out", str(tmp_path / "x.html")], "x.html: is the file of a comparison, expected several directories"),
        (
            [one, other, "--out", str(tmp_path / "no" / "x.html")],
            "x.html: cannot be written: No such file or directory",
        ),
    ):
        assert main(["report", *arguments]) == 2
        said = capsys.readouterr().err
        assert message in said
        assert said.count("\n") == 1
    old = sampled.assign_attrs(config=sampled.attrs["config"].replace("samples", "draws"), tissuq="0.0.1")
    assert main(["report", str(write(tmp_path / "old", old))]) == 2
    assert (
        "not a study of this version of tissuq, it was made by version 0.0.1 (method.draws" in capsys.readouterr().err
    )


def test_comparison_puts_studies_side_by_side(tmp_path, sampled, undrawn):
    plain = solve(study(kind="monte-carlo"))
    places = [write(tmp_path / "controlled", sampled), write(tmp_path / "plain", plain)]
    page = compare(places, tmp_path / "comparison.html").read_text()
    for dataset, name in ((sampled, "controlled"), (plain, "plain")):
        sag = dataset.sel(output="sag")
        assert f">{name}<" in page
        assert readable.and_error(float(sag["mean"]), float(sag["mean_error"]), "m") in page
        assert readable.and_error(float(sag["std"]), float(sag["std_error"]), "m") in page
    assert page.count("<figure>") == 2 * 2
    assert page.count("12 s") == 2
    assert "<i>" not in page


def test_directories_of_one_name_are_told_apart(tmp_path, sampled, undrawn):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    places = [write(tmp_path / "a" / "out", sampled), write(tmp_path / "b" / "out", sampled)]
    page = compare(places, tmp_path / "comparison.html").read_text()
    assert all(f">{place}<" in page for place in places)


@pytest.mark.parametrize("coefficient", ["one", "optimal"])
@pytest.mark.parametrize("of", [function, fragile])
def test_convergence_ends_at_the_estimate(coefficient, of):
    dataset = solve(study(coefficient=coefficient, fields=False), of)
    n = int(dataset["ok"].sum())
    for output in dataset.output.values:
        for controlled, name in ((True, "mean"), (False, "plain_mean")):
            last = outputs.running_estimates(dataset, output, [2, n], controlled=controlled)[-1]
            expected = dataset.sel(output=output)
            np.testing.assert_allclose(last.mean, expected[name], rtol=1e-12)
            np.testing.assert_allclose(last.mean_error, expected[f"{name}_error"], rtol=1e-9)


def test_pictures_have_axes_with_units(sampled):
    assert plots.histogram(sampled, "sag").get_xlabel() == "sag (m)"
    assert plots.histogram(sampled, "sag").get_ylabel() == "density (1/m)"
    assert plots.convergence(sampled, "sag").get_ylabel() == "running mean of sag (m)"
    assert plots.tornado(sampled, "sag").get_xlabel() == "change of sag (m)"
    assert plots.comparison({"a": sampled}, "sag", "std").get_xlabel() == "standard deviation of sag (m), 95 % interval"


def test_histogram_is_a_density(sampled):
    bars = plots.histogram(sampled, "sag").patches
    assert sum(bar.get_width() * bar.get_height() for bar in bars) == pytest.approx(1)


@pytest.mark.filterwarnings("error")
def test_an_output_that_does_not_vary_is_drawn(sampled):
    still = sampled.assign(values=xr.full_like(sampled["values"], 0.1)).drop_vars("variance_ratio")
    assert plots.png(plots.convergence(still, "sag")).startswith(PNG)


def test_a_value_far_off_does_not_make_millions_of_bins(sampled):
    values = sampled["values"].copy()
    values[0] = 1e12
    assert len(plots.histogram(sampled.assign(values=values), "sag").patches) <= 200


def test_tornado_has_the_strongest_parameter_on_top(sampled):
    ax = plots.tornado(sampled, "sag")
    named = zip(ax.get_yticks(), (tick.get_text() for tick in ax.get_yticklabels()), strict=True)
    assert [name for _, name in sorted(named)] == ["D1", "gravity density"]


def test_pictures_draw_where_they_are_told(sampled):
    left, right = Figure().subplots(1, 2)
    assert plots.convergence(sampled, "sag", left) is left
    assert plots.histogram(sampled, "sag", right) is right
    assert plots.png(left).startswith(PNG)


def test_figures_of_thousands_of_marks_stay_small():
    """Marks of many sizes are no paths each."""
    ax = plots.axes()
    x = np.linspace(0, 1, 400)
    ax.scatter(x, x**2, s=1 + 20 * x)
    drawn = plots.svg(ax)
    assert b"<image" in drawn
    assert len(drawn) < 100_000
    assert plots.svg(ax) == drawn


def test_figures_are_dark_on_dark_pages():
    """What is black or white on paper has no colour of its own, but for what is written on colours."""
    ax = plots.axes()
    ax.set_title("black")
    ax.bar([1], [2], color="#0b6bb8", edgecolor="white")
    ax.annotate("on a colour", (1, 1), color=ON_DEEP)
    drawn = plots.svg(ax).decode()
    assert "prefers-color-scheme: dark" in drawn
    assert not {"#000000", "#ffffff"} & set(re.findall(r"#\w{6}", drawn))
    assert {"#0b6bb8", ON_DEEP} <= set(re.findall(r"#\w{6}", drawn))


@pytest.mark.filterwarnings("error")
def test_two_samples_of_a_linear_model_are_drawn():
    dataset = solve(study(samples=2, fields=False), lambda p: np.array([p[0] / 750, 0.0]))
    for output in dataset.output.values:
        for draw in (plots.convergence, plots.histogram, plots.tornado):
            assert plots.png(draw(dataset, output)).startswith(PNG)


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (0.122790298, 4.92e-5, "0.12279 ± 0.00005"),
        (0.5, 0.0996, "0.50 ± 0.10"),
        (0.827, 0.119, "0.83 ± 0.12"),
        (0.827, 0.367, "0.8 ± 0.4"),
        (-24059.7, 351.2, "−24,060 ± 350"),
        (1.23456e-7, 2.3e-9, "(1.235 ± 0.023) × 10⁻⁷"),
        (7.6543e8, 1.2e6, "(7.654 ± 0.012) × 10⁸"),
        (0.0, 0.012, "0.000 ± 0.012"),
        (2.5, 0.0, "2.5 ± 0"),
        (1.5, float("nan"), "1.5 ± –"),
    ],
)
def test_values_are_rounded_to_their_errors(value, error, text):
    assert readable.with_error(value, error) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.123456, "0.1235"),
        (1e4, "10,000"),
        (44721.36, "44,720"),
        (-6.92951e-8, "−6.93 × 10⁻⁸"),
        (0.00099999, "0.001"),
        (0, "0"),
        (None, "–"),
        (float("inf"), "∞"),
    ],
)
def test_numbers_are_rounded(value, text):
    assert readable.number(value) == text


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.2288, "0.23 s"), (34.9, "35 s"), (99.7, "1 min 40 s"), (11100, "3 h 05 min")]
)
def test_times_are_readable(seconds, text):
    assert readable.duration(seconds) == text


def test_no_error_is_below_rounding():
    """Printed with fifteen digits at most, and kept as what rounding leaves."""
    assert readable.with_error(0.1, 1e-31) == "0.100000000000000 ± 0.000000000000001"
    assert readable.with_error(-1541.02, 1e-20) == "−1,541.02000000000 ± 0.00000000001"
    found = above_rounding(
        xr.Dataset(
            {
                "mean": ("output", [2.0, 0.0, np.nan]),
                "mean_error": ("output", [1e-30, 0.0, 1.0]),
                "std": ("output", [1e-20, 1.0, 1.0]),
                "std_error": ("output", [1e-40, 0.5, np.nan]),
                "sobol_first": (("output", "parameter"), [[1e-8], [0.5], [0.0]]),
                "sobol_first_error": (("output", "parameter"), [[1e-30], [0.1], [0.0]]),
            }
        )
    )
    np.testing.assert_array_equal(found["mean_error"], [2.0**-51, 0.0, 1.0])
    np.testing.assert_array_equal(found["std_error"], [2.0**-51, 0.5, np.nan])
    np.testing.assert_array_equal(found["sobol_first_error"], [[2.0**-52], [0.1], [2.0**-52]])


def test_maps_of_indices_are_blank_where_nothing_varies():
    """A node whose standard deviation is rounding has no indices, in results and in pictures."""
    found = blank_where_still(
        xr.Dataset(
            {
                "field_std": (("node", "component"), [[1e-17, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.0, 0.2]]),
                "node_sobol_total": (("parameter", "node"), [[0.7, 0.0, 0.4], [0.3, 0.0, 0.6]]),
            }
        )
    )
    np.testing.assert_array_equal(found["node_sobol_total"], [[np.nan, np.nan, 0.4], [np.nan, np.nan, 0.6]])


def test_axes_hold_the_posterior():
    """Not the prior, which is a hundred times as wide and of which points with next to no weight are left."""
    rng = np.random.default_rng(0)
    values = np.concatenate([rng.normal(5.0, 0.1, 500), rng.uniform(-100, 100, 200)])
    weights = np.concatenate([np.full(500, 1.0), np.full(200, 1e-6)])
    low, high = posterior.span(values, weights)
    assert 4.4 < low < 4.8
    assert 5.2 < high < 5.6
    order = np.argsort(values)
    assert posterior.span(values[order[::-1]], weights[order[::-1]]) == (low, high)
    assert posterior.span(np.ones(3), np.ones(3))[0] < 1 < posterior.span(np.ones(3), np.ones(3))[1]


def test_report_imports_nothing_that_draws():
    heavy = "{'matplotlib', 'pyvista', 'vtkmodules', 'jinja2', 'mpi4py', 'dolfinx'}"
    code = f"import sys, workflows.report.page; print({heavy} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


@pytest.mark.parametrize(
    ("unit", "of_a_length", "number"),
    [("Pa", "m/Pa", "2 Pa"), ("1", "m", "2"), ("kg/m³", "m/(kg/m³)", "2 kg/m³"), ("m", "m/m", "2 m")],
)
def test_units_in_words(unit, of_a_length, number):
    assert readable.per("m", unit) == of_a_length
    assert readable.with_unit(readable.number(2.0), unit) == number


@pytest.mark.parametrize(
    ("prior", "at", "std"),
    [
        (Normal(mean=5e3, std=5e2), 9.95e3, 39.0),  # ten deviations away
        (Uniform(lower=5e3, upper=9.5e3), 9.497e3, 2.7),  # at an end
        (LogNormal(mean=1e3, std=5e2), 2e3, 1e2),
    ],
)
def test_axes_of_posteriors_hold_the_posterior(prior, at, std):
    z = np.linspace(-5.6, 5.6, 1001)
    values, slopes = prior.from_normal(z)
    density = np.exp(-(z**2) / 2) / np.maximum(slopes, 1e-300)
    draws = at + std * np.random.default_rng(0).standard_normal(500)
    if prior.support is not None:
        draws = draws[draws < prior.support[1]]
    columns = {"mode": at, "mean": at, "std": std, "laplace_std": std, "prior_std": 5e2, "true": np.nan}
    one = xr.Dataset(
        {name: (("parameter",), [value]) for name, value in columns.items()}
        | {"draw": (("draw_n", "parameter"), draws[:, None])},
        coords={"parameter": ["material.C1"]},
    ).assign(chains=0, effective=100.0)
    ax = plots.inversion.marginals(one, {"material.C1": (values, density)})
    low, high = ax.get_xlim()
    assert low < np.quantile(draws, 0.003) < np.quantile(draws, 0.997) <= high
    assert high - low < 20 * std
    if prior.support is not None:
        assert high <= prior.support[1]


def test_many_load_cases_have_colours_of_one_scale():
    """As the steps of a path; the first and the last are named."""
    cases = [f"force.{k}" for k in range(1, 13)]
    one = xr.Dataset(
        {
            "eigenvalue": ("direction", [90.0, 0.5]),
            "alone_eigenvalue": (("case", "direction"), np.outer(np.arange(1, 13), [6.0, 0.1])),
        },
        {"case": cases},
    )
    ax = plots.inversion.spectrum(one)
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["all together", "force.1", "force.12"]
    assert len(ax.lines) == 14
