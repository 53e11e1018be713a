"""The answer before everything else, in numbers that people read."""

import html
import json
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from scipy import integrate, stats

from forward.findings import FREE, Finding
from forward.readable import and_error, interval, percent, quantity, rounded, scale, size, spoken
from tests.workflows.report.test_report import solve, study, study_of, write
from uq.findings import add
from workflows.report import blocks
from workflows.report.page import render, write_report
from workflows.report.sections import answer, inversions
from workflows.report.sections.frame import gravest, told
from workflows.results import summary
from workflows.run import closing

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.mark.parametrize(
    ("value", "error", "unit", "text"),
    [
        (0.122790, 4.1e-4, "m", "12.28 cm"),
        (0.12279, 4.3e-8, "m", "12.2790 cm"),
        (-0.0035, 1e-4, "m", "−3.50 mm"),
        (2.345e6, 2e3, "Pa", "2.3450 MPa"),
        (2.345e6, 4e3, "Pa", "2.345 MPa"),
        (543.2, 120.0, "Pa", "540 Pa"),
        (812.3, 15.0, "Pa", "812 Pa"),
        (3.2e-6, 1e-7, "J", "3.20 µJ"),
        (7.8e-6, 3e-7, "m³", "7.80 cm³"),
        (7.8e-6, 0.0, "kg/m³", "7.8 × 10⁻⁶ kg/m³"),
        (73.739, 0.005, "1", "73.739"),
        (0.0, 0.0, "m", "0 m"),
        (0.99999, 1e-6, "m", "99.9990 cm"),
        (float("nan"), 1.0, "m", "–"),
        (0.0012345678, float("inf"), "m", "1.2 mm"),
    ],
)
def test_numbers_are_read_without_counting_zeros(value, error, unit, text):
    assert quantity(value, error, unit).replace("\u00a0", " ") == text
    if error == float("inf"):
        assert and_error(value, error, unit).replace("\u00a0", " ") == "1.2 ± ∞ mm"


def test_units_fit_over_thirty_powers_of_ten():
    """What is written is the number, in every unit."""
    for unit in ("m", "Pa", "N", "J", "m²", "m³", "N/m", "1", "kg"):
        for value in 3.7 * 10.0 ** np.arange(-15, 16):
            one, name = scale(value, unit)
            assert (one == 1.0) == (name == unit)
            assert rounded(value / one, 0.01 * value / one) != "0"


def test_intervals_and_shares_are_short():
    assert interval(0.11012, 0.13712, "m", 0.1228) == "11.0–13.7\u00a0cm"
    assert interval(-0.2, 0.31, "1", 0.1) == "−0.20 to 0.31"
    assert size(3.3e-4, "m") == "330\u00a0µm"
    assert [percent(x).replace("\u00a0", " ") for x in (0.7123, 0.032, 1e-9, 0.99999, 1.0)] == [
        "71 %",
        "3.2 %",
        "below 0.1 %",
        "above 99.9 %",
        "100 %",
    ]
    assert spoken("loads.gravity.density") == "gravity density"
    assert spoken("E") == "E"


def test_the_answer_is_on_the_first_screen(tmp_path):
    dataset = solve(study())
    page = html.unescape(write_report(write(tmp_path / "out", dataset)).read_text()).replace("\u00a0", " ")
    places = [page.index(f'<section id="{name}">') for name in ("header", "answer", "body", "distribution", "moments")]
    assert places == sorted(places)
    sag = dataset.sel(output="sag")
    low, high = np.quantile(sag["values"], (0.025, 0.975))
    said = quantity(float(sag["mean"]), float(sag["mean_error"]), "m").replace("\u00a0", " ")
    assert f'<p class="value">{said}</p>' in page
    assert f"95 %: {interval(low, high, 'm', float(sag['mean']))}".replace("\u00a0", " ") in page
    assert "if gravity density and D1 are uncertain?" in page
    assert "driven, to first order, by gravity density (" in page


def test_intervals_of_an_expansion_are_those_of_its_density():
    dataset = solve(study(kind="chaos", samples=8, fields=False))
    one = dataset.sel(output="sag")
    rng = np.random.default_rng(0)
    normal = rng.normal(3e5, 2e4, 400_000)
    exact = np.quantile(0.1 * (rng.uniform(600, 900, 400_000) / 750) ** 2 / (normal / 3e5), (0.025, 0.975))
    _, curve = answer.distribution(one, "m")
    low, high = one["density_edge"].to_numpy()[[0, -1]]
    np.testing.assert_allclose(low + (high - low) * np.array(curve.inside), exact, rtol=0.01)


def test_small_densities_are_densities():
    values = stats.norm(5, 2).rvs(4000, random_state=1)
    at, curve = blocks.smooth(values)
    scaled = curve / integrate.trapezoid(curve, at)
    np.testing.assert_allclose(scaled, stats.norm(5, 2).pdf(at), atol=0.02)


def test_small_densities_of_one_sign_end_at_zero():
    draws = -stats.lognorm(0.7, scale=70).rvs(4000, random_state=1)
    at, curve = inversions._new_specimens(draws, logarithmic=True)
    assert (np.diff(at) > 0).all()
    assert at[-1] < 0
    scaled = curve / integrate.trapezoid(curve, at)
    np.testing.assert_allclose(scaled, stats.lognorm(0.7, scale=70).pdf(-at), atol=0.15 * scaled.max())


@pytest.mark.parametrize("value", [3.0, 0.0, 0.1, -1e5 / 3])
def test_a_small_density_of_one_value_is_drawn(value):
    """One point copied, the last digit of whose mean is rounding; and a lattice without length."""
    at, curve = blocks.smooth(np.full(400, value))
    found = blocks.curve_of(at, curve, (value, value), "m", value)
    assert np.isfinite(curve).all()
    assert found.inside == pytest.approx((0.5, 0.5))
    assert blocks.curve_of(np.full(48, value), curve, (value, value), "m", value).inside == (0.0, 0.0)


def test_a_small_density_holds_an_interval_that_reaches_beyond_its_samples():
    at, curve = np.linspace(2.0, 4.0, 5), np.array([0.0, 1.0, 2.0, 1.0, 0.0])
    found = blocks.curve_of(at, curve, (1.0, 3.5), "m", 3.0)
    drawn = found.heights
    assert found.inside == pytest.approx((0.0, 2.5 / 3))
    assert found.ends == ("1.0", "4.0\N{NO-BREAK SPACE}m")
    assert drawn[0] == 0
    assert np.argmax(drawn) / (len(drawn) - 1) == pytest.approx(2 / 3, abs=0.02)


@pytest.mark.parametrize("kind", ["local-sensitivity", "sobol", "derivative-based", "monte-carlo"])
def test_every_kind_answers(tmp_path, kind):
    case = study_of({"kind": kind} if kind == "local-sensitivity" else {"kind": kind, "samples": 64})
    page = write_report(write(tmp_path / "out", solve(case))).read_text()
    assert page.count('<p class="value">') == 2
    assert ("moved, by one standard deviation of" in page) == (kind == "local-sensitivity")
    assert ("<li>driven by" in page) == (kind in ("sobol", "derivative-based"))


def test_a_comparison_of_methods_names_the_best(tmp_path):
    rows = {
        "a": [{"cost": 10, "cpu_seconds": 1.0, "error": 1e-3}],
        "b": [{"cost": 10, "cpu_seconds": 1.0, "error": 1e-5}],
    }
    of = xr.Dataset({"unit": ("output", ["m"])}, {"output": ["tip"]})
    card = answer.compared(answer.Results(of, {"methods": json.loads(json.dumps(rows))}, None))
    assert "mean of tip" in card.question
    assert [(one.name, one.value) for one in card.answers if one.leads] == [("b", "10\u00a0µm")]


@pytest.mark.parametrize(
    ("trust", "source", "by"), [(summary.NEITHER, answer.LAPLACE, ", by Laplace"), (0, answer.LAPLACE, "")]
)
def test_numbers_that_nothing_stands_in_place_of_are_said_to_be_by_laplace(trust, source, by):
    names = ("mean", "mode", "lower", "upper", "prior_mean")
    one = xr.Dataset(dict.fromkeys(names, 1.0) | {"std": 0.1, "prior_std": 1.0, "true": np.nan})
    found = answer._unknown(one.assign(trust=trust, source=source), "material.C1", "Pa")
    assert (found.name, found.value) == (f"C1{by}", "1.00\u00a0Pa")


def test_the_terminal_says_how_many_answers_it_leaves_to_the_report(monkeypatch):
    found = blocks.Card("How?", [blocks.Answer(f"a{k}", "1 m", ()) for k in range(answer.TILES + 3)])
    monkeypatch.setitem(answer.CARDS, "many", lambda results: found)
    monkeypatch.setattr(answer, "gravest", lambda results: [])
    *listed, last = closing.answers(xr.Dataset({"many": 1.0}), {}, None)
    assert listed == [f"a{k}: 1 m" for k in range(answer.TILES)]
    assert last == "The other 3 are in the tables of the report."


@pytest.mark.parametrize(("words", "at_once"), [(0, 1), (9, 1), (10, 2), (80, 3)])
def test_answers_beyond_the_first_words_are_folded(words, at_once):
    card = blocks.Card("How much?", [blocks.Answer(f"a{k}", "1 m", ("± 2 mm",)) for k in range(3)], words=words + 2)
    assert [len(part) for part in card.parts] == [at_once, 3 - at_once]
    page = render("x", [("answer", [card])])
    assert page.count("<summary>") == (at_once < 3)
    assert not any(blocks.Card("How much?").parts)


@pytest.mark.parametrize(("notes", "shown"), [(5, 5), (6, 4), (20, 4)])
def test_the_end_of_a_run_is_twelve_lines_and_notes_are_what_gives_way(monkeypatch, notes, shown):
    monkeypatch.setattr(closing, "answers", lambda *given: [f"a{k}: 1 m" for k in range(3)])
    said = [("warning", "w0"), ("warning", "w1"), *(("note", f"n{k}") for k in range(notes))]
    summary = {"findings": [{"severity": one, "text": text} for one, text in said], "failed": 0, "solves": 1}
    summary |= {"wall_seconds": 1.0, "cpu_seconds": 1.0, "own_seconds": 0.0, "evaluations": 1}
    lines = closing.closing_words(xr.Dataset(), summary, None).splitlines()
    assert lines[:2] == ["warning: w0", "warning: w1"]
    assert sum(line.startswith("note: ") for line in lines) == shown
    assert len(lines) <= 11
    assert lines[-1] == (f"notes: {notes - shown} more in summary.json" if notes > shown else f"note: n{notes - 1}")


def test_what_is_known_keeps_its_digits_beside_a_wide_posterior():
    """The truth and the prior are given, so no posterior says how exactly they are known: 450 Pa is not 400 Pa."""
    posterior = {"mean": 540.0, "std": 120.0, "lower": 282.0, "upper": 719.0}
    known = {"prior_mean": 500.0, "prior_std": 250.0, "true": 450.0}
    lines = "\n".join(answer._unknown(xr.Dataset(posterior | known), "material.C1", "Pa").lines).replace("\u00a0", " ")
    assert "truth 450 Pa, inside" in lines
    assert "prior 500 ± 250 Pa" in lines


def test_what_is_to_be_read_first_stands_before_the_numbers():
    """Errors, that a best model is a bad one, that the error of the mesh is not known; no notes."""
    of = [
        Finding("mesh-unknown", "warning", {"why": "too large"}),
        Finding("mesh-unknown", "note", {"why": "it has no mesh"}),
        Finding("best-of-bad", "warning", {"best": "a", "wrong": "follow one another"}),
        Finding("no-mesh", "warning", {"kind": "python"}),
    ]
    results = SimpleNamespace(dataset=xr.Dataset())
    add(results.dataset, *of)
    said = gravest(results)
    assert [one.severity for one in said] == ["warning", "warning"]
    assert sorted(one.text.partition(":")[0] for one in said) == [
        "Best of bad models",
        "The error of the mesh is not known",
    ]


@pytest.mark.parametrize(
    ("text", "read", "folded"),
    [
        ("It errs. " + "Here is why and what to do about it. " * 4, "It errs.", "Here is why"),
        ("It errs. Take more cells.", "It errs. Take more cells.", ""),
        ("One sentence alone, " + "as long as it may be, " * 8 + "stays.", "One sentence alone", ""),
    ],
)
def test_of_a_long_finding_the_first_sentence_is_read_at_once(text, read, folded):
    found = told(Finding(FREE, "warning", {"text": text.strip()}))
    assert found.tone == "warning"
    assert found.text.startswith(read)
    assert found.more.startswith(folded)
    assert bool(found.more) == bool(folded)
    assert f"{found.text} {found.more}".strip() == text.strip()
