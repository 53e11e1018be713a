"""Studies of designs: from files to results, as inputs of other studies, on ranks, and what is refused."""

import json
import subprocess
import sys
import time

import numpy as np
import pytest
import xarray as xr
from mpi4py import MPI
from scipy.stats import multivariate_normal

from tests.launch import ROOT, TISSUQ, assert_same_bits, environment, in_process, tissuq_on_two_ranks
from tests.launch import run as on_ranks
from uq.findings import findings
from workflows.config.mistakes import StudyError
from workflows.config.study import document, load, parse
from workflows.run.run import run
from workflows.studies.design import known, values_of

MODULE = """
import numpy as np

G = np.random.default_rng(1).standard_normal((12, 3)) * 10.0 ** np.linspace(-1, 1, 12)[:, None]

def value(p):
    return (G @ p).tolist()

def slopes(p):
    return G.tolist()
"""
NAMES = [f"y{i}" for i in range(12)]
PYTHON = """
[model]
kind = "python"
function = "line.value"
jacobian = "line.slopes"
parameters = {{ a = 1.0, b = 2.0, c = 0.0 }}
outputs = [{outputs}]
[parameters]
{parameters}
[method]
kind = "design"
noise = {{ absolute = 0.5 }}
{method}
"""
NORMAL = "\n".join(f'{name} = {{ kind = "normal", mean = 1, std = {i + 1} }}' for i, name in enumerate("abc"))
CUBE = """
[model]
kind = "specimen"
body = {{ kind = "box", size = [0.05, 0.05, 0.05], cells = [2, 2, 2], degree = 1 }}
material = {{ kind = "neo-hookean-coupled", mu = 1e3, lmbda = 2e3 }}
inclusions = [{{ name = "lump", x = 0.02, y = 0.025, z = 0.03, radius = 0.015, contrast = 3, width = 0.02 }}]
observed = [{{ on = "x-max" }}, {{ on = "z-max" }}]
[[model.cases]]
name = "shear"
clamp = ["z-min"]
displacements = [{{ on = "z-max", x = 0.004, y = 0, z = 0 }}]
[[model.cases]]
name = "pull"
clamp = ["z-min"]
displacements = [{{ on = "z-max", x = 0, y = 0, z = 0.004 }}]
outputs = [{{ name = "grip", kind = "reaction", on = "z-max", component = "z" }}]
{more}
"""
PRIORS = """
[parameters]
"inclusions.lump.x" = {{ kind = "uniform", lower = 0.015, upper = 0.035 }}
"material.mu" = {{ kind = "log-normal", mean = 1e3, std = 300 }}
[method]
kind = "design"
noise = {{ relative = 0.01 }}
draws = 2
{method}
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "line", raising=False)
    (tmp_path / "line.py").write_text(MODULE)
    return tmp_path


def line(folder, method="number = 4", parameters=NORMAL):
    outputs = ", ".join(f'{{ name = "{name}" }}' for name in NAMES)
    path = folder / "line.toml"
    path.write_text(PYTHON.format(outputs=outputs, parameters=parameters, method=method))
    return path


def cube(folder, method, more=""):
    path = folder / "cube.toml"
    path.write_text(CUBE.format(more="") + more + PRIORS.format(method=method))
    return path


def exact(chosen, std=(1, 2, 3)):
    """Information of outputs of the line, and covariance of the parameters after them."""
    scope = {}
    exec(MODULE, scope)
    A = scope["G"][chosen] * np.array(std) / 0.5
    P = np.eye(3) + A.T @ A
    return np.linalg.slogdet(P)[1] / 2, np.linalg.inv(P) * np.outer(std, std)


@pytest.mark.slow
def test_a_linear_model_is_the_closed_form_with_any_ranks(folder, looked_at):
    path = line(folder)
    study = load(path)
    assert parse(document(study)) == study
    for ranks, tissuq, words in ((1, in_process, []), (2, tissuq_on_two_ranks, ["--no-report"])):
        done = tissuq("run", path, "--out", folder / f"out-{ranks}", "--quiet", *words)
        assert done.returncode == 0, done.stderr
    assert_same_bits(folder / "out-1", folder / "out-2")
    found = xr.load_dataset(folder / "out-2" / "results.nc")
    chosen = found["chosen"].to_numpy()
    for n in range(4):
        assert float(found["information"][n]) == pytest.approx(exact(chosen[: n + 1])[0], rel=1e-9)
    np.testing.assert_allclose(found["posterior_std"], np.sqrt(np.diag(exact(chosen)[1])), rtol=1e-9)
    best = max(range(12), key=lambda i: exact([i])[0])
    assert chosen[0] == best
    assert (found["random_upper"].to_numpy()[:4] <= found["information"].to_numpy() + 1e-9).all()
    summary = json.loads((folder / "out-1" / "summary.json").read_text())
    design = summary["design"]
    assert [one["name"] for one in design["chosen"]] == [NAMES[i] for i in chosen]
    assert design["random_equal"] is None or design["random_equal"] >= 4
    assert "Which observations tell most" in (folder / "out-1" / "report.html").read_text()
    looked_at(folder / "out-1")
    table = (folder / "out-1" / "design.csv").read_text().splitlines()
    assert [row.split(",")[1] for row in table[1:]] == [NAMES[i] for i in chosen]


def test_a_posterior_is_a_prior(folder):
    """The next observations, with draws of what the first ones left, are those of the closed form."""
    first = load(line(folder, "number = 2")).run()
    chosen = first["chosen"].to_numpy()
    covariance = exact(chosen)[1]
    draws = np.random.default_rng(3).multivariate_normal(np.ones(3), covariance, 4000)
    table = "a,b,c\n" + "\n".join(",".join(map(repr, row)) for row in draws.tolist()) + "\n"
    (folder / "draws.csv").write_text(table)
    path = line(folder, "number = 1", 'from = "draws.csv"')
    study = load(path)
    assert parse(document(study)) == study
    assert "digest" in document(study)["parameters"]["from"]
    found = study.run()
    now = exact(chosen)[0]
    best = max(range(12), key=lambda i: exact([*chosen, i])[0])
    assert int(found["chosen"][0]) == best
    assert float(found["information"][0]) == pytest.approx(exact([*chosen, best])[0] - now, rel=0.1)


@pytest.mark.slow
def test_variances_of_parameters_and_predictions(folder):
    by_parameters = load(line(folder, 'number = 2\ncriterion = "parameters"')).run()
    chosen = by_parameters["chosen"].to_numpy()
    left = np.diag(exact(chosen)[1]) / np.array([1, 4, 9])
    assert float(by_parameters["worth"][-1]) == pytest.approx(1 - left.mean(), rel=1e-9)
    goal = load(line(folder, 'number = 1\ncriterion = "predictions"\ngoals = ["y0"]')).run()
    assert "y0" not in goal["candidate"].values
    scope = {}
    exec(MODULE, scope)
    g = scope["G"][0]

    def taken(i):
        return 1 - g @ exact([i])[1] @ g / (g**2 @ np.array([1, 4, 9]))

    best = max(range(1, 12), key=taken)
    assert str(goal["candidate"][int(goal["chosen"][0])].item()) == NAMES[best]
    assert float(goal["worth"][0]) == pytest.approx(taken(best), rel=1e-9)


UNCERTAIN = "\n".join(NORMAL.splitlines()[:2]) + "\n[uncertain]\n"


@pytest.mark.slow
def test_what_is_uncertain_is_an_unknown_of_which_nothing_is_asked(folder):
    """As if c had a prior, and only a and b counted; goals depend on it too."""
    found = load(line(folder, parameters=UNCERTAIN + "c = 3")).run()
    chosen = found["chosen"].to_numpy()
    left = [exact(chosen[: n + 1])[1][:2, :2] for n in range(4)]
    told = [np.log(4 / np.linalg.det(C)) / 2 for C in left]
    np.testing.assert_allclose(found["information"], told, rtol=1e-9)
    np.testing.assert_allclose(found["posterior_std"], np.sqrt(np.diag(left[-1])), rtol=1e-9)
    alone = [np.log(4 / np.linalg.det(exact([i])[1][:2, :2])) / 2 for i in range(12)]
    np.testing.assert_allclose(found["candidate_information"], alone, rtol=1e-8)
    assert chosen[0] == np.argmax(alone)
    assert not [one for one in findings(found) if one.severity == "error"]
    by_parameters = load(line(folder, 'number = 2\ncriterion = "parameters"', UNCERTAIN + "c = 3")).run()
    variances = np.diag(exact(by_parameters["chosen"].to_numpy())[1])[:2]
    assert float(by_parameters["worth"][-1]) == pytest.approx(1 - (variances / [1, 4]).mean(), rel=1e-9)
    goals = 'number = 2\ncriterion = "predictions"\ngoals = ["y0"]'
    whole, some = (load(line(folder, goals, block)).run() for block in (NORMAL, UNCERTAIN + "c = 3"))
    np.testing.assert_allclose(some["worth"], whole["worth"], rtol=1e-9)
    np.testing.assert_array_equal(some["chosen"], whole["chosen"])


def test_scales_that_are_uncertain_together_say_nothing_of_goals(folder):
    """Against dense matrices: a scale is an error of what is measured, and of nothing that is predicted."""
    block = UNCERTAIN + 'c = { std = 3, group = "one" }\n"data.scale" = { relative = 0.4, group = "one" }'
    method = 'number = 2\ndraws = 1\ncriterion = "predictions"\ngoals = ["y11"]'
    found = load(line(folder, method, block)).run()
    scope = {}
    exec(MODULE, scope)
    G = scope["G"]
    together = 3 * G[:, 2] - 0.4 * (G @ [1, 1, 0])
    A, goal = np.column_stack([G[:, :2] * [1, 2], together]) / 0.5, np.append(G[11, :2] * [1, 2], 3 * G[11, 2])
    rows = A[found["chosen"].to_numpy()]
    worth = [1 - goal @ np.linalg.inv(np.eye(3) + rows[:n].T @ rows[:n]) @ goal / (goal @ goal) for n in (1, 2)]
    np.testing.assert_allclose(found["worth"], worth, rtol=1e-9)


@pytest.mark.fem
def test_chosen_points_are_what_other_studies_take(folder):
    path = cube(folder, "number = 6\ncosts = { 'pull.grip' = 1.5 }\nnoises = { '*.grip' = { relative = 0.02 } }")
    assert run(load(path), "cube", folder / "out", quiet=True, report=False) == 0
    found = xr.load_dataset(folder / "out" / "results.nc")
    names = found["candidate"].values[found["chosen"].to_numpy()]
    assert "pull.grip" in names  # displacements alone say nothing of the modulus where all that acts is a displacement
    assert {len(one) for one in (set(names), names)} == {6}
    assert float(found["cost"][-1]) == 6.5
    # The chosen ones as the observations of a study that makes data, and these as the data of an inversion.
    text = (folder / "out" / "observed.toml").read_text()
    made = CUBE.format(more="").replace('observed = [{ on = "x-max" }, { on = "z-max" }]', text)
    (folder / "make.toml").write_text(made + '[method]\nkind = "synthesize"\nnoise = { relative = 0.01 }\n')
    assert run(load(folder / "make.toml"), "make", folder / "made", quiet=True, report=False) == 0
    data = (folder / "made" / "data" / "make.csv").read_text()
    inversion = cube(folder, "").read_text().split("[method]")[0] + (
        '[data]\nfiles = ["made/data/make.csv"]\n[method]\nkind = "invert"\n'
    )
    (folder / "invert.toml").write_text(inversion)
    study = load(folder / "invert.toml")
    assert len(study.measurements[0].places_of_points) == 5
    # The form to be filled in has the same rows, and is a table of data once it is.
    form = (folder / "out" / "observed.csv").read_text().splitlines()
    places = {tuple(np.round([float(x) for x in row.split(",")[:3]], 6)) for row in form[2:] if row[0] != ","}
    rows = [row for row in data.splitlines() if not row.startswith("#")]
    assert places == {tuple(np.round([float(x) for x in row.split(",")[:3]], 6)) for row in rows[1:] if row[0] != ","}
    filled = [
        ",".join([*row.split(",")[:3], "1e-4,1e-4,1e-4", *row.split(",")[6:]])
        if row[0] != ","
        else row.replace("grip,,", "grip,0.3,")
        for row in form[2:]
    ]
    (folder / "filled.csv").write_text("\n".join([*form[:2], *filled]) + "\n")
    (folder / "invert.toml").write_text(inversion.replace("made/data/make.csv", "filled.csv"))
    assert len(load(folder / "invert.toml").measurements[0].places_of_points) == 5


@pytest.mark.fem
def test_whole_load_cases_are_observations(folder):
    found = load(cube(folder, 'number = 1\neach = "case"')).run()
    assert found["candidate"].values.tolist() == ["shear", "pull"]
    alone = found["candidate_information"].to_numpy()
    assert int(found["chosen"][0]) == int(alone.argmax())


@pytest.mark.fem
@pytest.mark.parametrize(("cell", "degree"), [("hexahedron", 2), ("tetrahedron", 1)])
def test_candidates_are_known_before_there_is_a_mesh(folder, cell, degree):
    """Names and numbers of candidates, as those of the model: faces share edges, a point may be at several places."""
    path = cube(folder, "number = 1")
    text = path.read_text().replace("degree = 1", f'degree = {degree}, cell = "{cell}"')
    more = '{ on = "y-min", components = "xz", cases = ["pull"] }, { at = [[0.01, 0.02, 0.03]], name = "inside" }'
    path.write_text(text.replace('{ on = "z-max" }]', f'{{ on = "z-max" }}, {more}]'))
    study = load(path)
    model = study.spec.build(MPI.COMM_SELF, study.inputs.names)
    made, before = values_of(study.spec, model), known(study.spec)
    for one, other in ((before.labels, made.labels), (before.tests, made.tests), (before.names, made.names)):
        assert one.tolist() == other.tolist()
    for each in ("value", "point", "place", "case", "output"):
        method = study.method.model_copy(update={"each": each})
        assert len(method.candidates(before)[0].names) == len(method.candidates(made)[0].names), each


@pytest.mark.few(4)
@pytest.mark.parametrize(
    ("method", "said"),
    [
        ("number = 32", "method.number: more than there are candidates, expected at most 31; given 32"),
        ('number = 16\neach = "place"', "method.number: more than there are candidates, expected at most 16"),
        ('number = 3\neach = "case"', "method.number: more than there are candidates, expected at most 2; given 3"),
        ("number = 2\ncosts = { 'pul.*' = 2 }", "method.costs: 'pul.*' is the name of no candidate, such as shear."),
        ("number = 2\nnoises = { 'pull.gri' = { absolute = 2 } }", "method.noises: 'pull.gri' is the name of no value"),
        ("number = 2\ncriterion = 'predictions'\ngoals = ['grip']", "method.goals: 'grip' is the name of no value"),
        ("number = 2\ncriterion = 'predictions'\ngoals = ['*']", "method.number: more than there are candidates"),
        ("budget = 1\ncosts = { '*' = 3 }", "method.budget: expected at least the cost of the cheapest candidate, 3"),
    ],
)
def test_check_refuses_what_candidates_do_not_have(folder, method, said):
    """Of a cube, by its cells, without a mesh."""
    done = in_process("check", cube(folder, method.replace("number = 16", "number = 17")))
    assert done.returncode == 2
    assert said in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr


@pytest.mark.fem
def test_errors_of_the_mesh_are_told_and_count_as_noise(folder):
    """They are those of the model at the medians, and what counts is √(σ² + e²)."""
    one = "number = 3\nseed = 2"
    found = load(cube(folder, one)).run()
    study = load(cube(folder, one))
    model = study.spec.build(MPI.COMM_SELF, study.inputs.names)
    middle = study.inputs.points(np.full((1, 2), 0.5))[0]
    right = model.solve(middle).mesh_error().outputs
    np.testing.assert_allclose(found["value_mesh_error"], right, rtol=1e-6, atol=1e-9 * np.abs(right).max())
    text = next(finding.text for finding in findings(found) if "err by more than the noise" in finding.text)
    names, which = found["candidate"].values.tolist(), found["value_candidate"].to_numpy()
    size = [np.sqrt(np.mean((right / found["value_sigma"].to_numpy())[which == k] ** 2)) for k in range(len(names))]
    assert f"at {(np.array(size) > 1).sum()} of 31 candidates" in text
    noisy = load(cube(folder, one + "\nmesh_error = 'noise'")).run()
    np.testing.assert_allclose(noisy["value_sigma"], np.hypot(found["value_sigma"], right), rtol=1e-6)
    assert float(noisy["information"][-1]) < float(found["information"][-1])
    assert not [one for one in findings(noisy) if one.severity == "warning" and "err by more" in one.text]
    without = load(cube(folder, one + "\nmesh_error = false")).run()
    assert "value_mesh_error" not in without
    np.testing.assert_array_equal(without["information"], found["information"])


BUMPS = """
import numpy as np

AT = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])

def value(p):
    if p[0] > 2:
        raise ValueError("beyond")
    return (np.tanh(20 * (p[0] - AT))).tolist() + [0.001 * p[0]]

def slopes(p):
    return [[20 / np.cosh(20 * (p[0] - a)) ** 2] for a in AT] + [[0.001]]
"""


def test_draws_that_disagree_fail_or_are_told_little_are_findings(tmp_path, monkeypatch):
    """Each output sees the unknown only where its bump is."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "bumps", raising=False)
    (tmp_path / "bumps.py").write_text(BUMPS)
    outputs = ", ".join(f'{{ name = "y{i}" }}' for i in range(6))
    (tmp_path / "bumps.toml").write_text(f"""
[model]
kind = "python"
function = "bumps.value"
jacobian = "bumps.slopes"
parameters = {{ a = 0.0 }}
outputs = [{outputs}]
[parameters]
a = {{ kind = "normal", mean = 0, std = 1.5 }}
[method]
kind = "design"
noise = {{ absolute = 0.01 }}
draws = 64
number = 6
""")
    assert run(load(tmp_path / "bumps.toml"), "bumps", tmp_path / "out", quiet=True, report=False) == 3
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["failed"] > 0
    texts = {one["severity"]: one["text"] for one in summary["findings"]}
    assert f"The model has no answer at {summary['failed']} of 64 draws" in json.dumps(summary["findings"])
    assert "From observation 6 of 6 on, each adds less than" in texts["note"]
    two = load(tmp_path / "bumps.toml", ["method.number=1"]).run()
    assert "What is best depends on the unknowns" in two.attrs["findings"]


CURVES = """
import numpy as np

X = np.linspace(0.2, 2, 10)

def straight(p):
    return (p[0] * X).tolist()

def bent(p):
    return (p[0] * X + p[1] * X**2).tolist()
"""
SLOPES = """
def by_a(p):
    return X[:, None].tolist()

def by_both(p):
    return np.column_stack([X, X**2]).tolist()
"""
TWO = """
[model]
kind = "python"
outputs = [{outputs}]
[candidates.straight]
model = {{ function = "curves.straight", parameters = {{ a = 1.0 }} }}
parameters.a = {{ kind = "normal", mean = 1, std = 0.5 }}
[candidates.bent]
model = {{ function = "curves.bent", parameters = {{ a = 1.0, b = 0.1 }} }}
parameters.a = {{ kind = "normal", mean = 1, std = 0.5 }}
parameters.b = {{ kind = "normal", mean = 0.3, std = 0.1 }}
weight = 3
[method]
kind = "design"
criterion = "models"
each = "value"
noise = {{ absolute = 0.05 }}
draws = 256
number = 3
"""


@pytest.mark.slow
def test_models_are_told_apart_as_in_monte_carlo(tmp_path, monkeypatch, looked_at):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "curves", raising=False)
    (tmp_path / "curves.py").write_text(CURVES)
    outputs = ", ".join(f'{{ name = "y{i}" }}' for i in range(10))
    (tmp_path / "two.toml").write_text(TWO.format(outputs=outputs))
    study = load(tmp_path / "two.toml")
    assert parse(document(study)) == study
    for ranks in (None, 2):
        command = ["run", tmp_path / "two.toml", "--quiet", *(["--no-report"] if ranks is None else [])]
        done = on_ranks(ranks, TISSUQ, *command, "--out", tmp_path / f"out-{ranks}")
        assert done.returncode == 0, done.stderr
    assert_same_bits(tmp_path / "out-None", tmp_path / "out-2")
    assert "Expected ln Bayes factor" in (tmp_path / "out-2" / "report.html").read_text()
    looked_at(tmp_path / "out-2")
    found = xr.load_dataset(tmp_path / "out-2" / "results.nc")
    X = np.linspace(0.2, 2, 10)[found["chosen"].to_numpy()]
    roots = [0.5 * X[:, None], np.column_stack([0.5 * X, 0.1 * X**2])]
    models = [
        multivariate_normal(mean, root @ root.T + 0.0025 * np.eye(3))
        for mean, root in zip((X, X + 0.3 * X**2), roots, strict=True)
    ]
    for k, other in ((0, 1), (1, 0)):
        y = models[k].rvs(20_000, random_state=k)
        factors = models[k].logpdf(y) - models[other].logpdf(y)
        error = 4 * factors.std() / np.sqrt(len(y)) + 0.02 * factors.mean()  # and that of the moments of 256 draws
        assert float(found["log_bayes_factor"][k, other]) == pytest.approx(factors.mean(), abs=error)
    told = 0.25 * float(found["log_bayes_factor"][0, 1]) + 0.75 * float(found["log_bayes_factor"][1, 0])
    assert float(found["worth"][-1]) == pytest.approx(told, rel=1e-9)


def test_models_are_told_apart_less_where_something_is_uncertain(tmp_path, monkeypatch):
    """Its errors are among what each model predicts; candidates without such a number have none."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "curves", raising=False)
    (tmp_path / "curves.py").write_text(CURVES + SLOPES)
    outputs = ", ".join(f'{{ name = "y{i}" }}' for i in range(10))
    text = TWO.format(outputs=outputs).replace('curves.straight"', 'curves.straight", jacobian = "curves.by_a"')
    text = text.replace('curves.bent"', 'curves.bent", jacobian = "curves.by_both"')
    text = text.replace('parameters.b = { kind = "normal", mean = 0.3, std = 0.1 }\n', "").replace("b = 0.1", "b = 0.3")
    (tmp_path / "two.toml").write_text(text + "[uncertain]\nb = 0.1\n")
    study = load(tmp_path / "two.toml")
    assert parse(document(study)) == study
    found = study.run()
    X = np.linspace(0.2, 2, 10)[found["chosen"].to_numpy()]
    roots = [0.5 * X[:, None], np.column_stack([0.5 * X, 0.1 * X**2])]
    means, covariances = (X, X + 0.3 * X**2), [root @ root.T + 0.0025 * np.eye(3) for root in roots]
    for k, other in ((0, 1), (1, 0)):
        inverse, gap = np.linalg.inv(covariances[other]), means[k] - means[other]
        logs = [np.linalg.slogdet(covariances[i])[1] for i in (other, k)]
        told = (np.trace(inverse @ covariances[k]) - 3 + gap @ inverse @ gap + logs[0] - logs[1]) / 2
        assert float(found["log_bayes_factor"][k, other]) == pytest.approx(told, rel=0.02)  # moments of 256 draws


@pytest.mark.slow
@pytest.mark.fem
def test_materials_are_told_apart_by_displacements(tmp_path):
    case = CUBE.format(more="").replace('material = { kind = "neo-hookean-coupled", mu = 1e3, lmbda = 2e3 }\n', "")
    one, two = "mooney-rivlin", "neo-hookean"
    text = (
        case
        + f"""
[candidates.{one}]
model.material = {{ kind = "{one}", C1 = 100, C2 = 400, D1 = 1e3 }}
parameters."material.C1" = {{ kind = "normal", mean = 100, std = 20 }}
[candidates.{two}]
model.material = {{ kind = "{two}", C1 = 500, D1 = 1e3 }}
parameters."material.C1" = {{ kind = "normal", mean = 500, std = 20 }}
[method]
kind = "design"
criterion = "models"
noise = {{ relative = 0.001 }}
draws = 8
number = 3
"""
    )
    (tmp_path / "cube.toml").write_text(text)
    assert run(load(tmp_path / "cube.toml"), "cube", tmp_path / "out", quiet=True, report=False) == 0
    assert (tmp_path / "out" / "observed.toml").exists()
    found = xr.load_dataset(tmp_path / "out" / "results.nc")
    assert (np.diff(found["worth"]) > 0).all()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (('criterion = "models"\n', ""), "method.criterion: there are candidates, expected 'models'"),
        (("parameters.b", "parameters.c"), "candidates.bent.parameters: not a number of the model"),
    ],
)
def test_candidates_that_cannot_be_told_apart(tmp_path, monkeypatch, change, said):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "curves.py").write_text(CURVES)
    outputs = ", ".join(f'{{ name = "y{i}" }}' for i in range(10))
    (tmp_path / "two.toml").write_text(TWO.format(outputs=outputs).replace(*change))
    with pytest.raises(StudyError) as error:
        load(tmp_path / "two.toml")
    assert len(error.value.args) == 1, error.value.args
    assert said in error.value.args[0]


FIELD = """
[model]
kind = "specimen"
body = { kind = "box", size = [1.0, 1.0, 1.0], cells = [2, 2, 2], degree = 1 }
material = { kind = "neo-hookean-coupled", mu = 1e3, lmbda = 2e3 }
fields = [{ of = "stiffness", length = 0.5, std = 0.6, basis = "nodes" }]
observed = [{ on = "x-max" }, { on = "z-max" }]
[[model.cases]]
name = "shear"
clamp = ["z-min"]
loads = [{ kind = "traction", on = "z-max", direction = [1, 0, 0], size = 100 }]
[[model.cases]]
name = "pull"
clamp = ["z-min"]
loads = [{ kind = "traction", on = "z-max", direction = [0, 0, 1], size = 100 }]
outputs = [{ name = "top", kind = "mean-displacement", on = "z-max", component = "z" }]
[method]
kind = "design"
noise = { relative = 0.01 }
"""


def dense(study, found):
    """Whitened rows of all values of a field's study at the median field, and the prior's root, as matrices."""
    spec = study.spec
    model, prior = spec.build(MPI.COMM_SELF, spec.coefficients), spec.fields[0].prior(spec.body)
    N = len(model.parameters)
    slopes = model.solve(np.zeros(N)).adjoint(np.eye(len(model.outputs)))
    root = prior.root(np.eye(N)).T
    return slopes @ root, root, prior.matern.mass, found["value_sigma"].to_numpy()


@pytest.mark.few(1)
@pytest.mark.fem
@pytest.mark.parametrize("criterion", ["information", "parameters", "predictions"])
def test_fields_are_told_what_dense_matrices_say(tmp_path, criterion):
    goals = '\ngoals = ["pull.top"]' if criterion == "predictions" else ""
    (tmp_path / "field.toml").write_text(FIELD + f'number = 3\ndraws = 1\ncriterion = "{criterion}"{goals}\n')
    study = load(tmp_path / "field.toml")
    assert parse(document(study)) == study
    found = study.run()
    slopes, root, mass, sigma = dense(study, found)
    A, which = slopes / sigma[:, None], found["value_candidate"].to_numpy()

    def after(chosen):
        rows = A[np.isin(which, chosen)]
        return np.eye(A.shape[1]) + rows.T @ rows

    def worth(chosen):
        P = after(chosen)
        if criterion == "information":
            return np.linalg.slogdet(P)[1] / 2
        goal = slopes[[list(found["value"].values).index("pull.top")]] if goals else root
        weights = 1.0 if goals else mass
        C = goal @ np.linalg.inv(P) @ goal.T
        return 1 - (weights * np.diag(C)).sum() / (weights * (goal**2).sum(axis=1)).sum()

    chosen = found["chosen"].to_numpy()
    assert 0 <= float(found["left_out"]) < 0.05  # directions with λ < 0.1
    for n in range(3):
        assert float(found["worth"][n]) == pytest.approx(worth(chosen[: n + 1]), rel=5e-3)
    every = range(found.sizes["candidate"])
    assert worth(chosen[:1]) > 0.999 * max(worth([i]) for i in every)
    left = root @ np.linalg.inv(after(chosen)) @ root.T
    share = 1 - (mass * np.diag(left)).sum() / (mass * np.diag(root @ root.T)).sum()
    assert float(found["field_variance_told"][-1]) == pytest.approx(share, rel=5e-3)


@pytest.mark.few(1)
@pytest.mark.fem
@pytest.mark.parametrize("criterion", ["information", "predictions"])
def test_of_fields_what_is_uncertain_is_told_as_dense_matrices_say(tmp_path, criterion):
    """Loads and points that err, which few points of one face cannot tell from a stiffness."""
    goals = '\ngoals = ["pull.top"]' if criterion == "predictions" else ""
    stated = '[uncertain]\n"loads.traction.size" = { relative = 0.2 }\n"data.scale" = 0.1\n"data.shift.z" = 0.05\n'
    (tmp_path / "field.toml").write_text(FIELD + f'number = 3\ndraws = 1\ncriterion = "{criterion}"{goals}\n' + stated)
    study = load(tmp_path / "field.toml")
    found = study.run()
    slopes, _, _, sigma = dense(study, found)
    spec, which, goal = study.spec, found["value_candidate"].to_numpy(), found["value"].values == "pull.top"
    sizes = [f"cases.{name}.loads.traction.size" for name in ("shear", "pull")]
    model = spec.build(MPI.COMM_SELF, (*spec.coefficients, *sizes))
    solution = model.solve(np.append(np.zeros(len(spec.coefficients)), [100.0, 100.0]))
    outputs, N = np.asarray(solution.outputs), len(spec.coefficients)
    by_load = 20 * solution.tangent(np.eye(2, N + 2, N)).sum(axis=0)
    step, places = 1e-5, found["value_place"].to_numpy()
    inside = np.where(places[:, 2] > 0.5, -1.0, 1.0)[:, None] * [0, 0, step]
    axes, cases = [int(one) for one in model.axes], model.cases.tolist()
    moved = model.observing(np.nan_to_num(places + inside), axes, cases)
    there = np.asarray(moved.solve(np.append(np.zeros(N), [100.0, 100.0])).outputs)
    by_place = 0.05 * np.where(np.isfinite(places[:, 2]), (there - outputs) / np.nan_to_num(inside[:, 2], nan=1.0), 0.0)
    scale = np.where(np.isfinite(places[:, 2]), 0.1 * outputs, 0.0)
    errors = np.column_stack([by_load, np.where(goal, 0, scale), np.where(goal, 0, by_place)])
    whole, n = np.hstack([slopes, errors]), slopes.shape[1]

    def left(chosen, columns):
        rows = whole[np.isin(which, chosen)][:, columns] / sigma[np.isin(which, chosen), None]
        return np.eye(rows.shape[1]) + rows.T @ rows

    def worth(chosen):
        if criterion == "information":
            logs = [np.linalg.slogdet(left(chosen, some))[1] for some in (slice(None), slice(n, None))]
            return (logs[0] - logs[1]) / 2
        row = whole[goal][0]
        return 1 - row @ np.linalg.inv(left(chosen, slice(None))) @ row / (row @ row)

    chosen = found["chosen"].to_numpy()
    for k in range(3):
        assert float(found["worth"][k]) == pytest.approx(worth(chosen[: k + 1]), rel=5e-3)


@pytest.mark.fem
@pytest.mark.slow
def test_draws_of_a_field_are_found_by_a_restart_and_shared_by_ranks(tmp_path):
    (tmp_path / "field.toml").write_text(FIELD + "number = 3\ndraws = 4\n")
    command = [TISSUQ, "run", tmp_path / "field.toml", "--no-report", "--quiet", "--out"]
    whole = on_ranks(None, *command, tmp_path / "whole")
    assert whole.returncode == 0, whole.stderr
    out = tmp_path / "out"
    with subprocess.Popen(list(map(str, [*command, out])), env=environment(), cwd=ROOT) as begun:
        while begun.poll() is None and not list(out.glob("evaluations/*.block")):
            time.sleep(0.02)
        begun.kill()
    assert not (out / "summary.json").exists()
    done = on_ranks(2, TISSUQ, "run", tmp_path / "field.toml", "--quiet", "--out", out)
    assert done.returncode == 0, done.stderr
    assert_same_bits(tmp_path / "whole", out)
    assert "Share of the variance" in (out / "report.html").read_text()


@pytest.mark.fem
def test_directions_that_are_left_out_are_a_finding(tmp_path):
    (tmp_path / "field.toml").write_text(FIELD + "number = 3\ndraws = 1\nrank = 4\n")
    study = load(tmp_path / "field.toml")
    found = study.run()
    slopes, _, _, sigma = dense(study, found)
    rows = np.isin(found["value_candidate"], found["chosen"])
    A = (slopes / sigma[:, None])[rows]
    missed = np.linalg.slogdet(np.eye(A.shape[1]) + A.T @ A)[1] / 2 - float(found["information"][-1])
    assert 0 < missed < 1.5 * float(found["left_out"])
    assert "directions beyond the 4 that are kept" in found.attrs["findings"]


def test_a_field_is_unknown_alone(tmp_path):
    more = FIELD.replace(
        "[method]", '[parameters]\n"material.mu" = { kind = "normal", mean = 1e3, std = 10 }\n[method]'
    )
    (tmp_path / "field.toml").write_text(more + "number = 3\n")
    with pytest.raises(StudyError, match="a field of nodal values is unknown alone"):
        load(tmp_path / "field.toml")


@pytest.mark.parametrize(
    ("method", "said"),
    [
        ("number = 13", "method.number: more than there are candidates, expected at most 12; given 13"),
        ("", "expected number, how many observations, or budget, what they may cost"),
        ("number = 1\ncriterion = 'predictions'", "expected the names of values that are predicted"),
        ("number = 1\ngoals = ['y1']", "expected criterion = 'predictions'"),
        ("number = 1\ncriterion = 'models'", "method.criterion: one model, expected several as candidates"),
        ("number = 1\neach = 'pont'", "method.each: input should be 'value', 'point'"),
    ],
)
def test_designs_that_cannot_be(folder, method, said):
    with pytest.raises(StudyError) as error:
        load(line(folder, method))
    assert len(error.value.args) == 1, error.value.args
    assert said in error.value.args[0]


@pytest.mark.parametrize(
    ("method", "said"),
    [
        ("number = 2\ncosts = { z = 2 }", "method.costs: 'z' is the name of no candidate, such as y0, y1, y2"),
        ("number = 2\nnoises = { z = { absolute = 2 } }", "'z' is the name of no value of the model, such as y0"),
        ("budget = 0.5", "method.budget: expected at least the cost of the cheapest candidate, 1; given 0.5"),
        ("number = 1\ncriterion = 'predictions'\ngoals = ['*']", "method.number: more than there are candidates"),
    ],
)
def test_names_that_fit_nothing_are_one_line(folder, method, said):
    with pytest.raises(StudyError) as error:
        load(line(folder, method))
    assert len(error.value.args) == 1, error.value.args
    assert said in error.value.args[0]


def test_other_studies_do_not_import_designs():
    code = "import sys, workflows.studies.sampling; print([name for name in sys.modules if 'design' in name])"
    assert on_ranks(None, sys.executable, "-c", code).stdout.strip() == "[]"
