"""Reports in a real browser: nothing fails, nothing is fetched, bodies turn, sliders move what Python computes."""

import json

import numpy as np
import pytest

from tests.browser import browser, executable
from tests.workflows.report.test_report import CUBE, solve, study, write
from uq.surrogates.expansion import Expansion
from workflows.report.page import write_report

pytestmark = pytest.mark.skipif(executable() is None, reason="no Chromium is installed (Debian: chromium)")
VIEWER = "document.querySelector('.viewer').viewer"


@pytest.fixture(scope="module")
def page():
    with browser() as found:
        yield found


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
    folder = tmp_path_factory.mktemp("reports")
    kinds = {"chaos": expanded, "sampled": solve(study()), "local": None}
    case = study().model_dump(mode="json", exclude_none=True) | {"method": {"kind": "local-sensitivity"}}
    from workflows.config.study import parse

    kinds["local"] = solve(parse(case))
    return {name: write_report(write(folder / name, dataset)) for name, dataset in kinds.items()}


@pytest.mark.parametrize("width", [1280, 390])
@pytest.mark.parametrize("name", ["chaos", "sampled", "local"])
def test_reports_open_without_a_fault(page, reports, name, width):
    for options in ({}, {"dark": True}, {"printed": True}):
        page.open(reports[name], width, **options)
        assert page.errors == []
        assert [url for url in page.requests if not url.startswith(("file:", "data:", "blob:"))] == []
        assert page.run("document.querySelector('.viewer').dataset.why || 'ready'") == "ready"
        # Nothing is wider than the window, and what cannot be read is not there.
        assert options.get("printed") or page.run("document.documentElement.scrollWidth") <= width
        assert page.run("getComputedStyle(document.querySelector('.stills')).display !== 'none'") == bool(
            options.get("printed")
        )


def test_a_body_turns_and_can_be_used_without_a_mouse(page, reports, tmp_path):
    page.open(reports["sampled"])
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
    page.open(reports["sampled"])
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
    page.open(reports["sampled"])
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
