"""Reports in a real browser: nothing fails, nothing is fetched, bodies turn, sliders move what Python computes."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from forward.pointwise import FunctionModel
from tests.browser import executable, without_fault
from tests.workflows.report.test_report import CUBE, HEXAHEDRON, solve, study, study_of, write
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import Normal, Uniform
from uq.inputs.draws import Draws
from uq.inputs.random_parameters import Inputs
from uq.methods.chaos import Chaos
from uq.surrogates.expansion import Expansion
from workflows.report.blocks import Folded, Heading, Table, Text
from workflows.report.page import render, write_report
from workflows.report.scene.scene import Quantity, Scene
from workflows.report.scene.sliders import sliders
from workflows.report.sections.bodies import turning

pytestmark = pytest.mark.skipif(executable() is None, reason="no Chromium is installed (Debian: chromium)")
VIEWER = "document.querySelector('.viewer').viewer"


@pytest.fixture
def page(chromium):
    return chromium


@pytest.fixture(scope="module")
def expanded():
    """Results with an expansion of outputs and of a field that is linear in the outputs."""
    dataset = solve(study(kind="chaos", samples=12))
    shape = -0.1 * CUBE[:, :1] * np.array([0.2, 1.0, 0.0])
    first = dataset["coefficients"].to_numpy()[:, 0]
    return dataset.assign(
        field_coefficients=(("term", "node", "component"), 10 * first[:, None, None] * shape),
        field_mean=(("node", "component"), 10 * first[0] * shape),
        field_loo_error=0.01,
    )


@pytest.fixture(scope="module")
def reports(tmp_path_factory, expanded):
    """Reports by name, each made when it is first asked for."""
    folder = tmp_path_factory.mktemp("reports")
    local = {"kind": "local-sensitivity"}
    kinds = {"chaos": lambda: expanded, "sampled": lambda: solve(study()), "local": lambda: solve(study_of(local))}

    class Reports(dict):
        def __missing__(self, name):
            self[name] = write_report(write(folder / name, kinds[name]()))
            return self[name]

    return Reports()


@pytest.mark.few(1)
@pytest.mark.parametrize("name", ["chaos", "sampled", pytest.param("local", marks=pytest.mark.slow)])
def test_reports_open_without_a_fault(page, reports, name):
    """Those of other kinds of studies are looked at where these are tested."""
    without_fault(page, reports[name])
    for media in ("print", ""):
        page.call("Emulation.setEmulatedMedia", media=media)
        shown = page.run("getComputedStyle(document.querySelector('.stills')).display")
        assert (shown != "none") == (media == "print")


def test_what_is_wrong_with_a_report_is_found(page, tmp_path):
    (tmp_path / "report.html").write_text("<h1>x</h1><div style='width: 500px'>x</div>")
    with pytest.raises(AssertionError, match="390"):
        without_fault(page, tmp_path / "report.html")
    for wrong in ("<script>throw new Error('x')</script>", "<img src='http://127.0.0.1:9/x.png' alt='x'>", "<img>"):
        (tmp_path / "report.html").write_text(f"<h1>x</h1>{wrong}")
        with pytest.raises(AssertionError):
            without_fault(page, tmp_path / "report.html")


def test_a_body_turns_and_can_be_used_without_a_mouse(page, reports, tmp_path):
    page.open(reports["chaos"])
    page.run("document.querySelector('canvas').scrollIntoView({block: 'center'})")
    shots = [page.screenshot(tmp_path / "0.png", "canvas")]
    box = page.run(
        "(() => { const b = document.querySelector('canvas').getBoundingClientRect(); return [b.x, b.y]; })()"
    )
    page.drag(box[0] + 200, box[1] + 200, 120, 40)
    shots.append(page.screenshot(tmp_path / "1.png", "canvas"))
    page.run("document.querySelector('canvas').dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowLeft'}))")
    shots.append(page.screenshot(tmp_path / "2.png", "canvas"))
    page.run("document.querySelector('.quantity').value = 1")
    page.run("document.querySelector('.quantity').dispatchEvent(new Event('change'))")
    shots.append(page.screenshot(tmp_path / "3.png", "canvas"))
    assert len(set(shots)) == len(shots)
    assert page.run("document.querySelector('canvas').getAttribute('aria-label').length > 20")


def test_the_body_fills_its_picture(page, reports):
    page.open(reports["chaos"])
    script = f"""(() => {{ const v = {VIEWER}; v.paint();
      const c = v.canvas, g = v.gl, p = new Uint8Array(4 * c.width * c.height);
      g.readPixels(0, 0, c.width, c.height, g.RGBA, g.UNSIGNED_BYTE, p);
      let low = c.height, high = 0; for (let i = 0; i < c.width * c.height; i++) if (p[4 * i + 3]) {{
        const y = Math.floor(i / c.width); low = Math.min(low, y); high = Math.max(high, y); }}
      return (high - low) / c.height; }})()"""
    assert page.run(script) > 0.8


def test_sliders_give_what_python_gives(page, reports, expanded):
    page.open(reports["chaos"])
    expansion = Expansion.of(expanded)
    points = np.array([[600.0, 2.8e5], [777.0, 3.05e5], [900.0, 3.1e5], [650.0, 3.0e5]])
    rounding = page.run(f"{VIEWER}.expansion.field.rounding")
    assert 0 < rounding < 1e-5
    for point, outputs, field in zip(points, expansion.outputs(points), expansion.displacements(points), strict=True):
        at = json.dumps(dict(zip(expansion.parameters, point.tolist(), strict=True)))
        found = page.run(f"{VIEWER}.at({at})")["outputs"]
        np.testing.assert_allclose([one["mean"] for one in found], outputs, rtol=1e-12, atol=1e-15)
        moved = np.reshape(page.run(f"Array.from({VIEWER}.motion)"), (-1, 3))
        assert np.abs(moved - field).max() <= rounding


def test_what_is_not_fixed_stays_random(page, reports, expanded):
    """The conditional mean, deviation and interval are those of samples with one parameter fixed."""
    page.open(reports["chaos"])
    expansion, rng = Expansion.of(expanded), np.random.default_rng(1)
    found = page.run(f"{VIEWER}.at({{'material.D1': 2.8e5}})")["outputs"]
    values = expansion.outputs(np.column_stack([rng.uniform(600, 900, 200_000), np.full(200_000, 2.8e5)]))
    np.testing.assert_allclose([o["mean"] for o in found], values.mean(axis=0), rtol=1e-3)
    np.testing.assert_allclose([o["std"] for o in found], values.std(axis=0), rtol=5e-3)
    ends = np.quantile(values, (0.025, 0.975), axis=0).T
    np.testing.assert_allclose([o["interval"] for o in found], ends, rtol=5e-3)
    field = expansion.displacements(np.column_stack([rng.uniform(600, 900, 20_000), np.full(20_000, 2.8e5)]))
    deviations = page.run(f"Array.from({VIEWER}.expansion.deviations(8))")
    np.testing.assert_allclose(deviations, np.linalg.norm(field.std(axis=0), axis=1), rtol=0.02, atol=1e-9)


@pytest.mark.slow
def test_a_slider_moves_the_body_and_says_where_it_extrapolates(page, reports, tmp_path):
    page.open(reports["chaos"])
    before = page.screenshot(tmp_path / "a.png", "canvas")
    move = (
        "(([path, value]) => {{ const r = document.querySelector(`input[data-path='${{path}}']`);"
        " r.value = value; r.dispatchEvent(new Event('input')); }})({})"
    )
    page.run(move.format(json.dumps(["loads.gravity.density", 890])))
    assert page.screenshot(tmp_path / "b.png", "canvas") != before
    assert page.run("document.querySelector('.sliders .warning').hidden")
    low = page.run(f"{VIEWER}.expansion.parameters[1].low")
    page.run(move.format(json.dumps(["material.D1", low])))
    assert "Extrapolated: D1" in page.run("document.querySelector('.sliders .warning').textContent")
    page.run("document.querySelector('.sliders > button').click()")
    assert page.run("document.querySelector('.sliders .warning').hidden")
    assert page.errors == []


def test_tables_are_sorted_and_saved(page, reports):
    page.open(reports["chaos"])
    table = "[...document.querySelectorAll('#local-sensitivities table')][0]"
    column = f"[...{table}.tBodies[0].rows].map((row) => row.cells[0].textContent)"
    page.run(f"{table}.tHead.rows[0].cells[0].querySelector('button').click()")
    up = page.run(column)
    page.run(f"{table}.tHead.rows[0].cells[0].querySelector('button').click()")
    assert page.run(column) == up[::-1]
    assert page.run(f"{table}.csv()").splitlines()[0].startswith("parameter,")
    assert page.run("document.querySelectorAll('figure .tools button').length") == page.run(
        "document.querySelectorAll('figure > img').length"
    )


def test_numbers_of_different_units_are_sorted(page, tmp_path):
    cells = ["28.9 ± 0.1 mm", "3.1 cm", "(2.0 ± 0.1) × 10⁻⁴ m", "−1 kPa", "–", "2 mm³"]
    parts = [("x", [Heading("x", 1), Table(["number", "which"], [[cell, str(i)] for i, cell in enumerate(cells)])])]
    (tmp_path / "report.html").write_text(render("x", parts))
    page.open(tmp_path / "report.html")
    page.run("document.querySelector('th button').click()")
    order = page.run("[...document.querySelector('table').tBodies[0].rows].map((r) => r.cells[1].textContent)")
    assert order == ["3", "5", "2", "0", "1", "4"]  # in SI units; what is missing stays below


def test_folded_notes_are_printed_and_units_stay_with_their_numbers(page, tmp_path):
    folded = [Folded("a", [Text("12 mm ± 3 % of 5 moons")]), Folded("b", [Text("y")], printed=False)]
    (tmp_path / "report.html").write_text(render("x", [("x", [Heading("x", 1), *folded])]))
    page.open(tmp_path / "report.html")
    opened = "[...document.querySelectorAll('details')].map((d) => d.open)"
    page.run("dispatchEvent(new Event('beforeprint'))")
    assert page.run(opened) == [True, False]
    page.run("dispatchEvent(new Event('afterprint'))")
    assert page.run(opened) == [False, False]
    assert page.run("document.querySelector('p').textContent") == "12\u00a0mm ±\u00a03\u00a0% of 5 moons"


def test_the_keyboard_reaches_all_controls(page, reports):
    """By Tab from one to the next: the body, its quantity, a slider, a sorted table, a saved picture."""
    page.open(reports["chaos"])
    seen = set()
    for _ in range(60):
        for kind in ("keyDown", "keyUp"):
            page.call("Input.dispatchKeyEvent", type=kind, key="Tab", code="Tab", windowsVirtualKeyCode=9)
        seen.add(page.run("document.activeElement.tagName + '.' + (document.activeElement.type || '')"))
    assert {"CANVAS.", "SELECT.select-one", "INPUT.range", "INPUT.checkbox", "BUTTON.button"} <= seen


SHAPE = -0.1 * CUBE[:, :1] * np.array([0.2, 1.0, 0.0])


def turned(folder, dataset, inputs, field, quantities):
    """Write a page with a body and the sliders of an expansion."""
    told = sliders(
        dataset, SimpleNamespace(given=inputs.marginals, inputs=inputs, correlations=(), units_of=lambda _: {})
    )
    assert told is not None
    scene = Scene(CUBE, np.array(HEXAHEDRON), 12, np.eye(3)[2], field, quantities, sliders=told)
    (folder / "report.html").write_text(render("x", [("body", [Heading("x", 1), turning(scene, "a body")])]))
    return folder / "report.html"


def dependent():
    """An expansion in one independent parameter and two with correlated draws, and a body of 8 nodes that it moves."""
    rng = np.random.default_rng(4)
    z = rng.multivariate_normal([0, 0], [[1, 0.8], [0.8, 1]], size=600)
    draws = Draws(("material.C1", "material.C2"), [2e4, 4e4] + z * [2e3, 3e3], np.full(600, 1 / 600), 600.0)
    inputs = Inputs({"loads.gravity.density": Uniform(lower=600.0, upper=900.0)}, draws=draws)

    def function(x):
        return np.array([x[0] * (x[1] + 2 * x[2]) / 1e7, (x[2] / 4e4) ** 2])

    def jacobian(x):
        return np.array([[(x[1] + 2 * x[2]) / 1e7, x[0] / 1e7, 2 * x[0] / 1e7], [0, 0, 2 * x[2] / 16e8]])

    model = FunctionModel(function, inputs.names, ("sag", "push"), jacobian)
    dataset = Chaos(samples=40, max_order=2, fields=False).run(inputs, SerialEvaluate(model))
    coefficients = dataset["coefficients"].to_numpy()[:, 0][:, None, None] * SHAPE
    fields = {"field_coefficients": (("term", "node", "component"), coefficients), "unit": ("output", ["m", "m"])}
    return dataset.assign(fields), inputs


def test_what_depends_on_a_fixed_parameter_follows_it(page, tmp_path):
    """Outputs where all is fixed are Python's; conditional means and deviations those of the Gaussian of the draws."""
    dataset, inputs = dependent()
    expansion = Expansion.of(dataset)
    field = dataset["field_coefficients"][0].to_numpy()
    size = Quantity("Mean displacement", np.linalg.norm(field, axis=1), "m")
    page.open(turned(tmp_path, dataset, inputs, field, [size]))
    assert page.errors == []
    names = expansion.parameters
    for point in ([700.0, 2.1e4, 4.3e4], [620.0, 1.8e4, 3.9e4]):
        found = page.run(f"{VIEWER}.at({json.dumps(dict(zip(names, point, strict=True)))})")["outputs"]
        np.testing.assert_allclose([o["mean"] for o in found], expansion.outputs(np.array([point]))[0], rtol=1e-12)
        moved = np.reshape(page.run(f"Array.from({VIEWER}.motion)"), (-1, 3))
        rounding = page.run(f"{VIEWER}.expansion.field.rounding")
        assert np.abs(moved - expansion.displacements(np.array([point]))[0]).max() <= rounding
    # C2 = v: C1 follows by C_12/C_22 (v − mean), and keeps 1 − ρ² of its variance.
    v = 4.4e4
    found = page.run(f"{VIEWER}.at({{'material.C2': {v}}})")["outputs"]
    covariance = np.cov(inputs.draws.values.T)
    middle, second = inputs.draws.values.mean(axis=0)
    first = middle + covariance[0, 1] / covariance[1, 1] * (v - second)
    left = covariance[0, 0] - covariance[0, 1] ** 2 / covariance[1, 1]
    assert found[0]["mean"] == pytest.approx(750 * (first + 2 * v) / 1e7, rel=2e-3)
    std = np.sqrt(300**2 / 12 * (first + 2 * v) ** 2 + (750**2 + 300**2 / 12) * left) / 1e7
    assert found[0]["std"] == pytest.approx(std, rel=0.03)
    assert found[1]["std"] == pytest.approx(0, abs=1e-9)  # it depends on C2 alone
    assert page.run(f"{VIEWER}.expansion.follows(1)") == pytest.approx(first, rel=2e-3)
    deviations = page.run(f"Array.from({VIEWER}.expansion.deviations(8))")
    np.testing.assert_allclose(deviations, std * np.linalg.norm(SHAPE, axis=1), rtol=0.03, atol=1e-6)
    # Nothing fixed: the moments of the study. Two values that no draw has together: it says so.
    found = page.run(f"{VIEWER}.at({{}})")["outputs"]
    np.testing.assert_allclose([o["mean"] for o in found], dataset["coefficients"][0], rtol=1e-12)
    outside = f"{VIEWER}.at({{'material.C1': 2.4e4, 'material.C2': 3.5e4}}) && {VIEWER}.expansion.outside().length"
    assert page.run(outside) == 2
    assert page.run(outside.replace("3.5e4", "4.5e4")) == 0


@pytest.mark.slow
def test_many_parameters_have_sliders_the_most_important_first(page, tmp_path):
    d = 40
    inputs = Inputs({f"material.c{i}": Normal(mean=1.0, std=0.1) for i in range(d)})
    slopes = 1.0 / (1 + np.abs(np.arange(d) - 30))  # c30 matters most
    model = FunctionModel(lambda x: np.array([slopes @ x]), inputs.names, ("y",), lambda x: slopes[None, :])
    dataset = Chaos(samples=8, max_order=1, fields=False).run(inputs, SerialEvaluate(model))
    still = Quantity("x", np.ones(8), "m")
    page.open(turned(tmp_path, dataset.assign(unit=("output", ["m"])), inputs, 0 * CUBE, [still]))
    order = page.run("[...document.querySelectorAll('.slider input[type=range]')].map((r) => r.dataset.path)")
    assert len(order) == d
    assert order[0] == "material.c30"
    assert set(order[1:3]) == {"material.c29", "material.c31"}
    assert page.run("document.querySelectorAll('.rows > .slider').length") == 6  # the others are folded
    x = np.linspace(0.9, 1.1, d)
    found = page.run(f"{VIEWER}.at({json.dumps(dict(zip(inputs.names, x.tolist(), strict=True)))})")["outputs"]
    assert found[0]["mean"] == pytest.approx(slopes @ x, rel=1e-12)
