"""Studies: reading, checking, writing."""

import json
import tomllib
from functools import cache
from pathlib import Path

import pytest

from forward.bodies.geometry import Box
from forward.hyperelastic import Hyperelastic
from forward.observables.largest import MaxDisplacement
from forward.terms.loads import Gravity
from uq.inputs.distributions import Normal, Uniform
from uq.methods.monte_carlo import MonteCarlo
from workflows.__main__ import main
from workflows.config.mistakes import StudyError
from workflows.config.study import differences, document, dump, load, parse, schema
from workflows.run.plan import plan
from workflows.starter import KINDS, starter
from workflows.studies.sampling import Study

CONFIGS = sorted((Path(__file__).parent.parent.parent.parent / "configs").glob("*.toml"))
shipped = cache(load)


def blocks():
    return tomllib.loads((Path(__file__).parent.parent.parent.parent / "configs" / "tiny.toml").read_text())


@pytest.mark.parametrize("path", CONFIGS, ids=lambda p: p.stem)
def test_shipped_studies_are_valid_and_survive_their_own_dump(path):
    study = shipped(path)
    assert parse(tomllib.loads(dump(study))) == study
    assert path.read_text().startswith("# "), "a shipped study begins with what it shows and how long it takes"


@pytest.mark.unit
@pytest.mark.parametrize(
    "kind",
    [
        "monte-carlo",
        "sensitivity-monte-carlo",
        "quasi-monte-carlo",
        "multilevel-monte-carlo",
        "multifidelity",
        "local-sensitivity",
        "chaos",
        "multilevel-chaos",
        "sobol",
        "derivative-based",
        "compare",
    ],
)
def test_starters_are_valid(kind):
    assert parse(tomllib.loads(starter(kind))).method.kind == kind


@pytest.mark.unit
def test_chaos_needs_independent_parameters():
    names = list(blocks()["parameters"])
    control = blocks() | {"method": {"kind": "quasi-monte-carlo", "samples": 32, "control": "chaos"}}
    assert parse(control).planned == 1 + 7 + 32
    with pytest.raises(StudyError, match=r"independent parameters.* for method\.control"):
        parse(control | {"correlations": [{"between": names, "value": 0.3}]})
    document_ = blocks() | {"method": {"kind": "chaos", "samples": 9}}
    assert parse(document_).planned == 10
    assert parse(document_ | {"method": {"kind": "chaos", "fit": "projection", "max_order": 3}}).planned == 26
    with pytest.raises(StudyError, match="correlations: polynomial chaos needs independent parameters"):
        parse(document_ | {"correlations": [{"between": names, "value": 0.3}]})


@pytest.mark.unit
@pytest.mark.parametrize("kind", ["sobol", "derivative-based"])
def test_indices_need_independent_parameters(kind):
    names = list(blocks()["parameters"])
    document_ = blocks() | {"method": {"kind": kind, "samples": 64}}
    assert parse(document_).planned == 65
    with pytest.raises(StudyError, match=r"correlations: .*need independent parameters"):
        parse(document_ | {"correlations": [{"between": names, "value": 0.3}]})


@pytest.mark.unit
def test_groups_are_of_known_parameters():
    method = {"kind": "sobol", "design": "saltelli", "samples": 64, "groups": {"load": ["loads.gravity.density"]}}
    document_ = blocks() | {"method": method}
    assert parse(document_).planned == 1 + 64 * 5
    assert parse(document_ | {"method": method | {"second_order": True}}).planned == 1 + 64 * 7
    with pytest.raises(StudyError, match=r"method\.groups: .*did you mean 'material.D1'"):
        parse(document_ | {"method": method | {"groups": {"stiffness": ["material.D2"]}}})


@pytest.mark.unit
def test_a_study_is_a_few_lines_of_python():
    model = Hyperelastic(
        body=Box(size=(0.1, 0.02, 0.02), cells=(4, 1, 1)),
        material={"kind": "neo-hookean", "C1": 1e4, "D1": 1e5},
        clamp=("x-min",),
        loads=(Gravity(density=1000.0),),
        outputs=(MaxDisplacement(name="sag"),),
    )
    study = Study(model=model, parameters={"material.C1": Uniform(lower=5e3, upper=2e4)}, method=MonteCarlo(samples=10))
    assert parse(document(study)) == study


@pytest.mark.unit
def test_what_a_starter_mentions_can_be_used():
    text = starter("monte-carlo")
    text = text.replace("hexahedron", "tetrahedron")
    blocks_ = ("inclusions", "displacements", "solver", "adapt")
    used = "\n".join(
        line.removeprefix("# ") if line.startswith(tuple(f"# {block} = " for block in blocks_)) else line
        for line in text.splitlines()
    )
    model = parse(tomllib.loads(used)).model
    assert model.inclusions[0].label == "tumour"
    assert model.adapt.outputs == ("sag",)
    assert {"inclusions.tumour.contrast", "inclusions.tumour.x", "displacements.x-max.x"} <= set(model.scalars)


def mistakes(change):
    document_ = blocks()
    change(document_)
    with pytest.raises(StudyError) as caught:
        parse(document_)
    return caught.value.args


def put(*way):
    *steps, last, value = way

    def change(document_):
        here = document_
        for step in steps:
            here = here[step]
        here[last] = value

    return change


@pytest.mark.unit
@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (put("method", "sampels", 5), "method.sampels: unknown key; did you mean 'samples'?"),
        (put("model", "bodi", {}), "model.bodi: unknown key; did you mean 'body'?"),
        (put("modle", {}), "modle: unknown key; did you mean 'model'?"),
        (put("method", "samples", 0), "method.samples: input should be greater than or equal to 2; given 0"),
        (put("method", "samples", "many"), "method.samples: input should be a valid integer; given 'many'"),
        (put("method", "kind", "mote-carlo"), "kind: unknown kind; did you mean 'monte-carlo'?; given 'mote-carlo'"),
        (put("method", "kind", "inverted"), "method.kind: unknown kind; did you mean 'invert'?"),
        (lambda d: d["method"].pop("kind"), "method.kind: missing"),
        (put("model", "body", "liver.msh"), "model.body: expected a table, { key = value }; given 'liver.msh'"),
        (put("model", "loads", 0, {"kind": "gravty"}), "model.loads[0].kind: unknown kind; did you mean 'gravity'?"),
        (put("model", "clamp", "x-min"), "model.clamp: expected a list; given 'x-min'"),
        (put("model", "outputs", []), "model.outputs: list should have at least 1 item, not 0; given []"),
        (put("model", "outputs", 0, "component", "w"), "model.outputs[0].component: input should be 'x', 'y', 'z' or"),
        (put("model", "clamp", ["x-mim"]), "model.clamp[0]: unknown boundary; did you mean 'x-min'?; given 'x-mim'"),
        (
            put("parameters", "inclusions.tumour.x", {"kind": "normal", "mean": 0.1, "std": 0.1}),
            "parameters: not a number of the model",
        ),
        (put("model", "clamp", []), "model.clamp: nothing holds the body along x, y, z"),
        (
            put("model", "material", "D1", -1.0),
            "model.material: not stable at rest: κ = 2 D1 = -2 Pa, expected more than 0",
        ),
        (put("model", "material", "D2", 1.0), "model.material.D2: unknown key; did you mean"),
        (put("model", "body", "size", [0.28, 0.0, 0.087]), "model.body.size[1]: input should be greater than 0"),
        (put("model", "body", "degree", 3), "model.body.degree: input should be 1 or 2; given 3"),
        (
            put("parameters", "material.D2", {"kind": "uniform", "lower": 1.0, "upper": 2.0}),
            "did you mean 'material.D1'",
        ),
        (
            put("parameters", "material.D1", {"kind": "normal", "mean": -1e5, "std": 1e5}),
            "parameters: 84.1 % of the values are impossible; at the medians, material: not stable at rest: κ = 2 D1",
        ),
        (
            put("parameters", "loads.gravity.density", {"kind": "uniform", "lower": -1.0, "upper": 2.0}),
            "parameters.loads.gravity.density: reaches -1, where the model is impossible",
        ),
        (
            put("parameters", "material.D1", {"kind": "uniform", "lower": 2.0, "upper": 1.0}),
            "parameters.material.D1: lower = 2 and upper = 1, expected lower < upper",
        ),
        (put("parameters", {}), "parameters: "),
        (put("correlations", [{"between": ["a", "b"], "value": 0.5}]), "correlations: correlation of 'a'"),
        (lambda d: d.pop("method"), "method: missing"),
        (lambda d: d["model"].pop("body"), "model.body: missing"),
        (
            lambda d: d["model"]["outputs"].append(d["model"]["outputs"][0]),
            "model.outputs: 2 of them are called 'uy_max'",
        ),
        (put("model", "loads", 0, "direction", [0, 0, 0]), "model.loads[0].direction: has length zero"),
    ],
)
def test_one_line_for_a_mistake(change, expected):
    lines = mistakes(change)
    assert len(lines) == 1, lines
    assert "\n" not in lines[0]
    assert expected in lines[0]


@pytest.mark.unit
def test_all_mistakes_are_reported_together():
    def change(document_):
        document_["method"]["sampels"] = 5
        document_["model"]["material"]["C1"] = "soft"
        document_["model"]["body"]["cell"] = "brick"
        document_["parameters"]["material.D1"]["kind"] = "bta"

    assert [line.split(":")[0] for line in mistakes(change)] == [
        "model.body.cell",
        "model.material.C1",
        "parameters.material.D1.kind",
        "method.sampels",
    ]


def test_the_plan_says_the_form():
    studies = {path.stem: shipped(path) for path in CONFIGS}
    assert {
        name for name, study in studies.items() if isinstance(study, Study) and study.spec.meshed and study.spec.mixed
    } == {
        "artery",
        "breast",
        "cook",
        "organ",
        "beam-wide",
        "compression",
        "indentation-forward",
    }  # κ/μ ≤ 5.7 in the last
    plain, mixed = (plan(parse(blocks(), [f"model.formulation={form}"])) for form in ("auto", "mixed"))
    assert "displacement form" in plain[1]
    assert "mixed form: displacements and pressures" in mixed[1]


def test_the_plan_warns_of_a_transition_narrower_than_a_cell():
    document_ = blocks()
    body = document_["model"]["body"]
    edge = max(size / n for size, n in zip(body["size"], body["cells"], strict=True))
    inclusion = {"name": "tumour", "kind": "sphere", "x": 0, "y": 0, "z": 0, "radius": 0.01, "contrast": 10.0}
    warned = []
    for width in (0.99 * edge, 1.01 * edge):
        document_["model"]["inclusions"] = [inclusion | {"width": width}]
        warned.append([line for line in plan(parse(document_)) if line.startswith("warning")])
    assert len(warned[0]) == 1
    assert "inclusions.tumour.width" in warned[0][0]
    assert warned[1] == []


@pytest.mark.unit
def test_overrides():
    study = parse(blocks(), ["method.samples=7", "model.loads.gravity.density=800", "parameters.material.D1.a=3"])
    assert study.method.samples == 7
    assert study.model.loads[0].density == 800
    assert study.parameters["material.D1"].a == 3
    assert parse(blocks(), ["method.kind=monte-carlo"]).method.kind == "monte-carlo"
    for quoted in ('parameters."material.D1".a=3', "parameters.'material.D1'.a=3", '"parameters"."material.D1"."a"=3'):
        assert parse(blocks(), [quoted]).parameters["material.D1"].a == 3
    new = parse(blocks(), ['parameters."material.C1"={ kind = "uniform", lower = 9e3, upper = 11e3 }'])
    assert new.parameters["material.C1"].lower == 9e3


@pytest.mark.unit
@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("method.samples", "expected KEY=VALUE"),
        ("=3", "expected KEY=VALUE"),
        ("method.samples.x=1", "'samples' is a value, not a block"),
        ("model.loads.wind.density=1", "no element is called 'wind'"),
        ("method.sampels=1", "did you mean 'samples'"),
        ('parameters."material.C9".a=3', r"parameters\.material\.C9\.kind: missing"),
    ],
)
def test_bad_overrides(assignment, message):
    with pytest.raises(StudyError, match=message):
        parse(blocks(), [assignment])


@pytest.mark.unit
@pytest.mark.parametrize(
    ("content", "message"),
    [(None, "cannot be read: No such file"), (b"[model", "not valid TOML"), (b"\xff\xfe", "not a text file")],
)
def test_unreadable_files(tmp_path, content, message):
    path = tmp_path / "study.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(StudyError, match=message):
        load(path)


@pytest.mark.unit
def test_differences_name_the_place():
    old, new = blocks(), blocks()
    new["method"]["samples"] = 99
    new["parallel"] = {"ranks_per_model": 2}
    new["correlations"] = []
    assert differences(old, new) == ["method.samples: 24 → 99"]


@pytest.mark.unit
def test_tails_may_not_reach_the_impossible():
    study = blocks()
    study["parameters"]["material.D1"] = {"kind": "normal", "mean": 3e5, "std": 2e4}
    assert parse(study).parameters["material.D1"] == Normal(mean=3e5, std=2e4)


@pytest.mark.unit
def test_tails_of_no_material_are_told():
    """A draw there is a failed sample: `check` says how many. A constant may be negative if its material is stable."""
    study = blocks()
    study["parameters"]["material.D1"] = {"kind": "normal", "mean": 3e5, "std": 1.5e5}
    told = [one for one in parse(study).findings if "stable at rest" in one.text]
    assert [one.severity for one in told] == ["warning"]
    assert told[0].text.startswith("2.3 % of the samples are of materials that are not stable at rest")
    study["parameters"]["material.D1"]["std"] = 1e4
    study["parameters"]["material.C2"] = {"kind": "uniform", "lower": -5e3, "upper": 1e4}
    assert parse(study).findings == ()


@pytest.fixture(scope="module")
def validator():
    import jsonschema

    found = schema()
    jsonschema.Draft202012Validator.check_schema(found)
    return jsonschema.Draft202012Validator(found)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda p: p.stem)
def test_shipped_studies_fit_the_schema(validator, path):
    validator.validate(tomllib.loads(path.read_text()))


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "invert"])  # which needs a file
def test_starters_and_dumps_fit_the_schema(validator, kind):
    validator.validate(tomllib.loads(starter(kind)))
    validator.validate(document(parse(tomllib.loads(starter(kind)))))


@pytest.mark.parametrize(
    "change",
    [
        put("method", "sampels", 5),
        put("model", "body", "degree", 3),
        put("model", "material", "D1", "stiff"),
        put("model", "material", "kind", "jelly"),
        put("parameters", "material.D1", {"kind": "uniform", "lower": 0.0}),
        put("model", {"kind": "python", "function": "f", "parameters": {}, "outputs": []}),
        put("method", {"kind": "compare", "methods": [{"kind": "monte-carlo", "budgets": [8], "samples": 8}]}),
    ],
)
def test_the_schema_refuses_mistakes(validator, change):
    document_ = blocks()
    change(document_)
    assert not validator.is_valid(document_)


def test_the_command_prints_the_schema(capsys, validator):
    assert main(["schema"]) == 0
    assert json.loads(capsys.readouterr().out) == validator.schema


@pytest.mark.unit
def test_a_displacement_larger_than_the_body_is_questioned():
    document_ = blocks()
    document_["model"]["displacements"] = [{"on": "x-max", "x": 3e-3, "y": -3.0}]
    document_["parameters"]["displacements.x-max.x"] = {"kind": "uniform", "lower": 0.0, "upper": 2.0}
    texts = [finding.text for finding in parse(document_).findings if finding.text.startswith("displacements.")]
    assert [text.partition(":")[0] for text in texts] == [
        "displacements.x-max.y reaches −3 m, more than the length of the body, 28 cm",
        "displacements.x-max.x reaches 2 m, more than the length of the body, 28 cm",
    ]
    assert any("displacements.x-max.y reaches" in line for line in plan(parse(document_)))


@pytest.mark.unit
def test_a_byte_order_mark_is_no_mistake(tmp_path):
    study = tmp_path / "study.toml"
    study.write_text(starter("chaos"), encoding="utf-8-sig")
    assert load(study).method.kind == "chaos"
