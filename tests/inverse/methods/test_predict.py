"""What inversions predict: linear chains by closed forms, few parameters and fields, meshes, ranks, kills, mistakes."""

import json
import subprocess
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from mpi4py import MPI

from forward.pointwise import FunctionModel
from inverse.data.noise import Noise
from inverse.fields.field_posterior import FieldPosterior
from inverse.fields.low_rank import Beside, LowRankPosterior
from inverse.fields.newton_cg import find_mode
from inverse.methods.predict import after_field, before_field
from tests.launch import TISSUQ, assert_same_bits, environment, in_process, run, run_script, tissuq_on_two_ranks
from uq.evaluation.hdf5 import stored_dataset
from uq.findings import keep_unknown
from workflows.__main__ import main
from workflows.config.mistakes import StudyError
from workflows.config.study import document, load, parse
from workflows.run.plan import plan
from workflows.studies.predicted import findings as said_of

# --- fields, by closed forms -----------------------------------------------------------------------------------------

RNG = np.random.default_rng(3)
SIZE, DATA, GOALS = 60, 25, 4
ROOT = np.tril(RNG.uniform(0, 1, (SIZE, SIZE))) / 8 + np.eye(SIZE) / 4
SEEN, GOAL = RNG.standard_normal((DATA, SIZE)), RNG.standard_normal((GOALS, SIZE))
SIGMA = 0.3
PRIOR = SimpleNamespace(variance=(ROOT**2).sum(axis=1), root=lambda x: x @ ROOT.T, root_transposed=lambda g: g @ ROOT)


def linear(matrix):
    names = tuple(f"m{i}" for i in range(SIZE))
    return FunctionModel(lambda m: matrix @ m + 1, names, tuple(map(str, range(len(matrix)))), lambda m: matrix)


@pytest.mark.few(1)
@pytest.mark.parametrize("more", [[], ["data.outputs={}", "data.files='sets'"]], ids=["alone", "side by side"])
def test_what_is_too_uncertain_for_first_order_is_sampled(folder, more):
    """As if it were one more unknown, and so with the same numbers; also in what is predicted."""
    text = (folder / "wider.toml").read_text().replace(".wider", ".bent").replace(".bent_other", ".wider_other")
    (folder / "bent.toml").write_text(text)
    known = 's = { kind = "normal", mean = 2.0, std = 0.4 }\n\n[data]'
    (folder / "known.toml").write_text(text.replace("s = 0.4\n", "").replace("\n[data]", known))
    (folder / "sets").mkdir(exist_ok=True)
    for name in ("one", "two"):
        (folder / "sets" / f"{name}.csv").write_text("output,value,sigma\nu,0.4,0.05\nw,3.1,0.31\nw,2.9,0.29\n")
    found, right = (folder / f"{name}-{len(more)}" for name in ("bent", "known"))
    more = [*more, "method.samples=512"]
    assert ran(folder / "bent.toml", found, *more) == ran(folder / "known.toml", right, *more) == 0
    one, other = (results(out).isel(data_set=-1) for out in (found, right))
    for name in ("mode", "mean", "std", "lower", "upper", "log_evidence"):
        of = other[name].sel(parameter=["a", "b"]) if "parameter" in other[name].dims else other[name]
        np.testing.assert_allclose(one[name], of, rtol=2e-3, err_msg=name)  # the searches end a little apart
    assert float(one["uncertain_mean"][0]) == pytest.approx((other["mean"].values[2] - 2) / 0.4, abs=0.05)
    assert float(one["uncertain_std"][0]) == pytest.approx(other["std"].values[2] / 0.4, rel=0.05)
    assert float(one["prediction_mean"][0]) == pytest.approx(float(other["prediction_mean"][0]), rel=1e-3)
    assert float(one["prediction_std"][0]) == pytest.approx(float(other["prediction_std"][0]), rel=0.02)
    (said, *_) = [one for one in findings(found) if one["code"] == "uncertain-sampled"]
    assert "s: sampled together with the parameters" in said["text"]
    assert not any(one["code"] == "uncertain-bent" for one in findings(found))


def test_a_linear_chain_from_data_to_prediction_is_exact_for_fields():
    """Against dense linear algebra, to 1e-8; pairs of draws find nothing that the gradients leave out."""
    values = SEEN @ ROOT @ RNG.standard_normal(SIZE) + 1 + SIGMA * RNG.standard_normal(DATA)
    posterior = FieldPosterior(linear(SEEN), values, Noise(np.full(DATA, SIGMA)), PRIOR)
    found = LowRankPosterior.at(find_mode(posterior, tolerance=1e-12).point, cutoff=1e-12)
    before = before_field(linear(GOAL), PRIOR, SIZE, 4, 0)
    said = after_field(linear(GOAL), found, before, 4, 0, of_mesh=True)
    prior = ROOT @ ROOT.T
    gain = prior @ SEEN.T @ np.linalg.inv(SEEN @ prior @ SEEN.T + SIGMA**2 * np.eye(DATA))
    covariance = prior - gain @ SEEN @ prior
    wide, narrow = (np.sqrt(np.diag(GOAL @ C @ GOAL.T)) for C in (prior, covariance))
    mean = GOAL @ gain @ (values - 1) + 1
    np.testing.assert_allclose(said["prediction_mean"], mean, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(said["prediction_std"], narrow, rtol=1e-8)
    np.testing.assert_allclose(said["prediction_prior_mean"], 1, rtol=1e-8)
    np.testing.assert_allclose(said["prediction_prior_std"], wide, rtol=1e-8)
    np.testing.assert_allclose(said["prediction_share"], 1 - (narrow / wide) ** 2, rtol=1e-8)
    np.testing.assert_allclose(said["prediction_upper"], mean + 1.959964 * narrow, rtol=1e-6)
    assert np.abs(said["prediction_mean_error"]).max() < 1e-10
    assert np.isnan(said["prediction_mesh_error"]).all()  # there is none


def test_what_gradients_leave_out_is_seen_in_pairs():
    """A quadratic goal, whose mean and variance under the prior are known; with one adjoint alone they are wrong."""
    names = tuple(f"m{i}" for i in range(SIZE))
    row = GOAL[0]

    def value(m):
        return np.array([row @ m + (row @ m) ** 2])

    model = FunctionModel(value, names, ("q",), lambda m: ((1 + 2 * row @ m) * row)[None])
    variance = float(((row @ ROOT) ** 2).sum())
    plain = before_field(model, PRIOR, SIZE, 0, 0)
    assert plain.mean[0] == 0
    np.testing.assert_allclose(plain.std, np.sqrt(variance), rtol=1e-10)
    seen = before_field(model, PRIOR, SIZE, 400, 0)
    assert abs(seen.mean[0] - variance) < 4 * seen.mean_error[0] < variance
    assert abs(seen.std[0] - np.sqrt(variance + 2 * variance**2)) < 4 * seen.std_error[0]


def test_what_is_uncertain_beside_a_field_is_what_the_data_have_left_of_it():
    """Jointly with the field, against dense matrices; one of three acts in what was measured alone, one in neither."""
    names = tuple(f"m{i}" for i in range(SIZE + 3))
    U, by_goal = RNG.standard_normal((3, DATA)), RNG.standard_normal((GOALS, 3))
    U[1:] *= [[2.0], [0.0]]
    goal = np.hstack([GOAL, by_goal])
    model = FunctionModel(lambda m: goal @ m + 1, names, tuple(map(str, range(GOALS))), lambda m: goal)
    values = SEEN @ ROOT @ RNG.standard_normal(SIZE) + RNG.standard_normal(3) @ U + SIGMA * RNG.standard_normal(DATA)
    noise = Noise(np.full(DATA, SIGMA), uncertain=U)
    mode = find_mode(FieldPosterior(linear(SEEN), values + 1, noise, PRIOR), tolerance=1e-12).point
    found = LowRankPosterior.at(mode, cutoff=1e-12)
    before = before_field(model, PRIOR, SIZE, 4, 0, 3)
    whole = np.hstack([SEEN, U.T])
    prior = np.block([[ROOT @ ROOT.T, np.zeros((SIZE, 3))], [np.zeros((3, SIZE)), np.eye(3)]])
    gain = prior @ whole.T @ np.linalg.inv(whole @ prior @ whole.T + SIGMA**2 * np.eye(DATA))
    covariance = prior - gain @ whole @ prior
    wide, narrow = (np.sqrt(np.diag(goal @ C @ goal.T)) for C in (prior, covariance))
    beside = Beside.of(mode)
    said = after_field(model, found, before, 4, 0, None, beside, of_mesh=False)
    np.testing.assert_allclose(said["prediction_mean"], goal @ gain @ values + 1, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(said["prediction_std"], narrow, rtol=1e-7)
    np.testing.assert_allclose(before.std, wide, rtol=1e-8)
    np.testing.assert_allclose(said["prediction_share"], 1 - (narrow / wide) ** 2, rtol=1e-7)
    # A field that is known by weighted points of that covariance, which none of its directions leaves.
    root = ROOT @ np.linalg.cholesky(
        np.eye(SIZE)
        - np.linalg.multi_dot(
            [
                (SEEN @ ROOT).T,
                np.linalg.inv(SEEN @ ROOT @ (SEEN @ ROOT).T + U.T @ U + SIGMA**2 * np.eye(DATA)),
                SEEN @ ROOT,
            ]
        )
    )
    points = np.vstack([found.mean + np.sqrt(SIZE) * root.T, found.mean - np.sqrt(SIZE) * root.T])
    weighted = points, np.full(2 * SIZE, 0.5 / SIZE)
    said = after_field(model, found, before, 0, 0, weighted, beside, of_mesh=False)
    np.testing.assert_allclose(said["prediction_std"], narrow, rtol=1e-7)


# --- few parameters, by closed forms ---------------------------------------------------------------------------------

A = np.array([[1.0, 2.0], [0.5, -1.0], [3.0, 0.2]])
MEAN, STD = np.array([1.0, -1.0]), np.array([0.5, 2.0])
LINES = f"""
import numpy as np

A = np.array({A.tolist()})


def linear(p):
    return A @ p


def slopes(p):
    return A


def other(p):
    return np.array([p[0] - p[1] + 3])


def others(p):
    return np.array([[1.0, -1.0]])


B = np.array([1.0, -2.0, 1.5])


def wider(p):
    return A @ p[:2] + B * p[2]


def wider_slopes(p):
    return np.column_stack([A, B])


def bent(p):
    return A @ p[:2] * np.exp(p[2] - 2)


def bent_slopes(p):
    return np.column_stack([A, A @ p[:2]]) * np.exp(p[2] - 2)


def wider_other(p):
    return np.array([p[0] - p[1] + 2 * p[2] + 3 * p[3]])


def wider_others(p):
    return np.array([[1.0, -1.0, 2.0, 3.0]])
"""
STUDY = """
[model]
kind = "python"
function = "predicted_lines.linear"
jacobian = "predicted_lines.slopes"
parameters = { a = 1.0, b = -1.0 }
outputs = ["u", "v", "w"]

[parameters]
a = { kind = "normal", mean = 1.0, std = 0.5 }
b = { kind = "normal", mean = -1.0, std = 2.0 }

[data]
outputs = { u = 0.4, w = [3.1, 2.9] }
noise = { absolute = 0.2, relative = 0.1 }
sigma = { u = 0.05 }

[predict]
PREDICT

[method]
kind = "invert"
samples = 1024
starts = 1
draws = 50
"""
OTHER = 'model = { function = "predicted_lines.other", jacobian = "predicted_lines.others", outputs = ["q"] }'
VALUES, ERRORS = np.array([0.4, 3.1, 2.9]), np.array([0.05, 0.31, 0.29])


WIDER = """{ function = "predicted_lines.wider_other", jacobian = "predicted_lines.wider_others", outputs = ["q"],
parameters = { a = 1.0, b = -1.0, s = 2.0, t = 0.0 } }""".replace("\n", " ")
UNCERTAIN = "[uncertain]\ns = 0.4\nt = 0.1\n"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("predict")
    of_wider = (
        STUDY.replace("linear", "wider")
        .replace("slopes", "wider_slopes")
        .replace("b = -1.0 }", "b = -1.0, s = 2.0 }", 1)
    )
    (place / "wider.toml").write_text(of_wider.replace("PREDICT", f"model = {WIDER}") + UNCERTAIN)
    (place / "predicted_lines.py").write_text(LINES)
    for name, block in (("same", ""), ("other", OTHER)):
        (place / f"{name}.toml").write_text(STUDY.replace("PREDICT", block))
    return place


def ran(study, out, *changes, report=False):
    sets = [word for change in changes for word in ("--set", change)]
    return main(["run", str(study), "--out", str(out), "--quiet", *([] if report else ["--no-report"]), *sets])


def results(out):
    return stored_dataset(out / "results.nc")


def findings(out):
    return json.loads((out / "summary.json").read_text())["findings"]


def exactly():
    B = A[[0, 2, 2]]
    covariance = np.linalg.inv(np.diag(STD**-2.0) + (B / ERRORS[:, None] ** 2).T @ B)
    return covariance @ (B.T @ (VALUES / ERRORS**2) + MEAN / STD**2), covariance


def jointly():
    """Mean and covariance of a, b, s and t after the data of the wider model; t acts in the predicted one alone."""
    scope = {}
    exec(LINES, scope)
    rows = np.column_stack([scope["wider_slopes"](None), np.zeros(3)])[[0, 2, 2]]
    prior = np.diag(np.append(STD, [0.4, 0.1]) ** 2)
    gain = prior @ rows.T @ np.linalg.inv(rows @ prior @ rows.T + np.diag(ERRORS**2))
    at = np.append(MEAN, [2.0, 0.0])
    return at + gain @ (VALUES - rows @ at), prior - gain @ rows @ prior, prior


@pytest.mark.usefixtures("undrawn")
def test_what_is_uncertain_widens_predictions_by_what_the_data_have_left_of_it(folder):
    """Of a linear model as if it were one more unknown; nothing else than its deviation is known of what is new."""
    assert ran(folder / "wider.toml", folder / "wider", "method.samples=512", report=True) == 0
    assert "What is uncertain is counted." in (folder / "wider" / "report.html").read_text()
    one = results(folder / "wider").isel(data_set=0)
    mean, covariance, prior = jointly()
    goal = np.array([1.0, -1.0, 2.0, 3.0])
    std, wide = (float(np.sqrt(goal @ C @ goal)) for C in (covariance, prior))
    assert float(one["prediction_mean"][0]) == pytest.approx(goal @ mean, abs=0.05 * std)
    assert float(one["prediction_std"][0]) == pytest.approx(std, rel=0.05)
    assert float(one["prediction_prior_std"][0]) == pytest.approx(wide, rel=0.01)
    assert one["uncertain"].values.tolist() == ["s"]
    assert float(one["uncertain_mean"][0]) == pytest.approx((mean[2] - 2) / 0.4, abs=0.05)
    assert float(one["uncertain_std"][0]) == pytest.approx(np.sqrt(covariance[2, 2]) / 0.4, rel=0.05)


def test_a_linear_chain_from_data_to_prediction_is_exact_for_few_parameters(folder, capsys, looked_at):
    """To the sampling error of the posterior's points; the terminal, summary.json and the report say it."""
    out = folder / "same"
    assert main(["run", str(folder / "same.toml"), "--out", str(out)]) == 0
    one = results(out).isel(data_set=0)
    mode, covariance = exactly()
    std = np.sqrt(np.diag(A @ covariance @ A.T))
    assert [str(goal) for goal in one["goal"].values] == ["u", "v", "w"]
    np.testing.assert_allclose(one["prediction_mean"], A @ mode, atol=0.05 * std.max())
    np.testing.assert_allclose(one["prediction_std"], std, rtol=0.06)
    np.testing.assert_allclose(one["prediction_lower"], A @ mode - 1.96 * std, atol=0.3 * std.max())
    np.testing.assert_allclose(one["prediction_prior_mean"], A @ MEAN, atol=1e-2)
    np.testing.assert_allclose(one["prediction_prior_std"], np.linalg.norm(A * STD, axis=1), rtol=1e-2)
    assert (np.abs(one["prediction_mean"] - A @ mode) < 4 * one["prediction_mean_error"]).all()
    told = json.loads((out / "summary.json").read_text())["predictions"]["v"]
    assert told["mean"] == pytest.approx(float(one["prediction_mean"][1]))
    assert 0.9 < told["share"] < 1
    assert told["mesh_error"] is None
    assert "v, predicted: 0.8" in capsys.readouterr().out
    page = (out / "report.html").read_text()
    looked_at(out)
    assert "Predictions" in page
    assert "share of the variance" in page
    assert "And what are u, v and w, which nobody measured?" in page
    assert page.count(", predicted</h2>") == 3
    assert "How many times narrower each" in page


def test_another_model_with_the_same_unknowns(folder):
    """Its outputs, and those of a linear function of them; a study reads itself."""
    assert ran(folder / "other.toml", folder / "other") == 0
    one = results(folder / "other").isel(data_set=0)
    mode, covariance = exactly()
    row = np.array([1.0, -1.0])
    std = float(np.sqrt(row @ covariance @ row))
    assert abs(float(one["prediction_mean"][0]) - (row @ mode + 3)) < 0.1 * std
    assert float(one["prediction_std"][0]) == pytest.approx(std, rel=0.06)
    study = load(folder / "other.toml")
    assert parse(document(study), folder=folder) == study
    assert any("predicts    q, by 33 solves" in line for line in plan(study, 1))


@pytest.mark.slow
def test_a_batch_predicts_from_each_posterior(folder):
    """The same of each data set as alone; the prior is solved for once."""
    (folder / "data").mkdir()
    for name, scale in (("one", 1.0), ("two", 1.1)):
        rows = f"output,value,sigma\nu,{0.4 * scale},0.05\nw,3.1,0.31\nw,2.9,0.29\n"
        (folder / "data" / f"{name}.csv").write_text(rows)
    assert ran(folder / "same.toml", folder / "batch", "data={files='data'}", "method.samples=32") == 0
    assert ran(folder / "same.toml", folder / "alone", "data={files='data/two.csv'}", "method.samples=32") == 0
    both, alone = results(folder / "batch"), results(folder / "alone")
    for name in ("prediction_mean", "prediction_std", "prediction_lower", "prediction_prior_mean"):
        np.testing.assert_allclose(both[name][1], alone[name][0], rtol=1e-12)
    assert (both["prediction_mean"][0] != both["prediction_mean"][1]).all()


@pytest.mark.mpi
@pytest.mark.slow
def test_neither_ranks_nor_kills_matter(folder, tmp_path):
    """The same bytes where a run ended among the solves for what is predicted, and two ranks went on."""
    (tmp_path / "study.toml").write_text((folder / "same.toml").read_text())
    (tmp_path / "predicted_lines.py").write_text(
        LINES + "import os, itertools\ncount, known = itertools.count(), linear\n"
        "def linear(p):\n    if next(count) > 55 and os.environ.get('KILL'): os._exit(9)\n    return known(p)\n"
    )
    command = [TISSUQ, "run", tmp_path / "study.toml", "--quiet", "--no-report", "--set", "method.samples=32", "--out"]
    words = list(map(str, [*command, tmp_path / "cut"]))
    assert subprocess.run(words, env=environment() | {"KILL": "1"}, capture_output=True, check=False).returncode == 9
    for ranks, out in ((None, "whole"), (2, "cut")):
        done = run(ranks, *command, tmp_path / out)
        assert done.returncode == 0, done.stderr
    assert_same_bits(tmp_path / "whole", tmp_path / "cut")


@pytest.mark.parametrize(
    ("block", "said"),
    [
        ("cases = [{ name = 'pull' }]", "predict.cases: a model of kind 'python' has none"),
        ("model = { outputz = ['q'] }", "predict.model.outputz: unknown key; did you mean 'outputs'?"),
        ("model = { kind = 'hyperelastic' }", "predict.model.kind: expected 'python'"),
        ("model = { outputs = [] }", "predict"),
        ("samples = 3", "predict.samples: expected at least 8"),
        ("sample = 3", "predict.sample: unknown key; did you mean 'samples'?"),
        ("model = { parameters = { c = 1.0 } }", "none of the unknown numbers (a, b)"),
    ],
)
def test_what_cannot_be_predicted(folder, block, said):
    path = folder / "wrong.toml"
    path.write_text(STUDY.replace("PREDICT", block))
    with pytest.raises(StudyError) as refused:
        load(path)
    assert said in str(refused.value)


@pytest.mark.slow
def test_an_inversion_that_predicts_nothing_has_nothing_of_it_in_its_results(folder):
    (folder / "none.toml").write_text(STUDY.replace("[predict]\nPREDICT\n", ""))
    assert ran(folder / "none.toml", folder / "none", "method.samples=32") == 0
    assert not [name for name in results(folder / "none").variables if "predict" in str(name) and "ion_" in str(name)]


# --- a specimen ------------------------------------------------------------------------------------------------------

CUBE = """
[model]
kind = "specimen"
body = { size = [1.0, 1.0, 1.0], cells = [2, 2, 2], degree = 1 }
material = { kind = "neo-hookean-coupled", mu = 1e4, lmbda = 4e4 }
cases = [{ name = "shear", clamp = ["z-min"], loads = [TRACTION, direction = [1, 0, 0] }] }]
MORE

[data]
files = ["points.csv"]
sigma = 1e-3

[predict]
observed = [{ at = [[1.0, 0.5, 1.0]], components = "xz", cases = ["pull"] }]

[[predict.cases]]
name = "pull"
clamp = ["z-min"]
loads = [TRACTION, direction = [0, 0, 1] }]
outputs = [{ name = "energy", kind = "strain-energy" }]

[[predict.cases]]
name = "shear"
outputs = [{ name = "energy", kind = "strain-energy" }]

[method]
kind = "invert"
samples = 32
starts = 1
draws = 20
mesh_error = "report"
""".replace("TRACTION", '{ kind = "traction", on = "z-max", size = 300')
NUMBER = '\n[parameters]\n"material.mu" = { kind = "log-normal", mean = 1.2e4, std = 4e3 }\n'
FIELD = 'fields = [{ of = "stiffness", length = 0.6, std = 0.4, basis = "nodes" }]\n'
POINTS = "case,x,y,z,ux,uy,uz\nshear,1,0,1,0.028,0,-0.006\nshear,0,1,1,0.028,0,0.006\nshear,1,1,0.5,0.014,0,-0.002\n"
# Finer meshes take most of the time: fewer cells, and none that are thin.
COARSE = {"forward.finer_meshes.LEAST": {1.5: 3, 1.0: 2}, "forward.bodies.tetrahedra.THINNEST": 1.0}
NAMES = ["pull.points.0.x", "pull.points.0.z", "pull.energy", "shear.energy"]


@pytest.fixture(scope="module")
def specimens(tmp_path_factory):
    place = tmp_path_factory.mktemp("specimens")
    (place / "points.csv").write_text(POINTS)
    (place / "few.toml").write_text(CUBE.replace("MORE", NUMBER))
    (place / "field.toml").write_text(CUBE.replace("MORE", FIELD))
    return place


@pytest.mark.fem
@pytest.mark.usefixtures("undrawn")
def test_predictions_know_what_the_model_does_not_explain(specimens):
    """Near points that were measured in the same load case; in another one as wide; of energies nothing."""
    errors, out = "data.errors={kind='normal',process=true}", specimens / "process"
    observed = "predict.observed=[{at=[[1.0,0.1,1.0]],components='x'}]"
    mesh, load_ = "method.mesh_error=false", "uncertain={'cases.shear.loads.traction.size'={relative=0.02}}"
    assert ran(specimens / "few.toml", out, errors, observed, mesh, load_, "predict.samples=12", report=True) in (0, 3)
    found = results(out).isel(data_set=0)
    assert found["goal"].values.tolist() == ["pull.points.0.x", "pull.energy", "shear.points.0.x", "shear.energy"]
    (pull, pulled, shear, sheared), size = found["prediction_process_std"].values, float(found["process_size"])
    plain = found["prediction_std"].values
    np.testing.assert_allclose([pulled, sheared], plain[[1, 3]], rtol=1e-9)
    wide = np.sqrt(found["unexplained_covariance"].values[0, 0])
    assert pull == pytest.approx(np.hypot(plain[0], wide), rel=0.05)
    assert size < wide
    assert plain[2] < shear < 0.7 * np.hypot(plain[2], wide)
    before, after = (abs(float(found[f"prediction_{kind}mean"][2]) - 0.028) for kind in ("", "process_"))
    assert after < 0.5 * before  # what was measured at a point nearby
    moved = (found["prediction_process_mean"] - found["prediction_mean"]).values
    np.testing.assert_allclose(moved[[0, 1, 3]], 0, atol=1e-3 * wide)
    assert found["unexplained_uncertain"].shape == (4, 1)
    assert "With what the model does not explain" in (out / "report.html").read_text()


@pytest.mark.slow
@pytest.mark.fem
def test_other_loads_and_places_of_a_specimen(specimens):
    """What is predicted is what the model gives at the posterior's points; the mesh is estimated."""
    assert ran(specimens / "few.toml", specimens / "few") in (0, 3)
    found = results(specimens / "few").isel(data_set=0)
    assert [str(goal) for goal in found["goal"].values] == NAMES
    assert [str(unit) for unit in found["goal_unit"].values] == ["m", "m", "J", "J"]
    study = load(specimens / "few.toml")
    model = study.predicted.build(MPI.COMM_SELF, ("material.mu",))
    weights, points = found["point_weight"].to_numpy(), found["point"].to_numpy()
    outputs = np.array([model.solve(point).outputs for point in points])
    mean = weights @ outputs
    std = np.sqrt(weights @ (outputs - mean) ** 2)
    np.testing.assert_allclose(found["prediction_mean"], mean, atol=1e-3 * std.max())
    np.testing.assert_allclose(found["prediction_std"][1:], std[1:], rtol=1e-2)
    assert (found["prediction_share"][1:] > 0.5).all()
    assert np.isfinite(found["prediction_mesh_error"]).all()
    said = json.loads((specimens / "few" / "summary.json").read_text())["findings"]
    assert any("the mesh is estimated to move" in one["text"] for one in said)


@pytest.mark.slow
@pytest.mark.fem
@pytest.mark.parametrize("unknown", [NUMBER, FIELD])
def test_a_load_that_is_uncertain_in_what_was_measured_and_predicted(specimens, tmp_path, unknown):
    """Few parameters: as if it were one more unknown. Of a field load and stiffness err together."""
    (tmp_path / "points.csv").write_text(POINTS)
    stated = '[uncertain]\n"loads.traction.size" = { std = 15 }\n'
    (tmp_path / "stated.toml").write_text(CUBE.replace("MORE", unknown) + stated)
    changes = ("method.mesh_error=false", "method.samples=128")
    assert ran(tmp_path / "stated.toml", tmp_path / "stated", *changes) in (0, 3)
    found = results(tmp_path / "stated").isel(data_set=0)
    assert found["uncertain"].values.tolist() == ["loads.traction.size"]
    if unknown == FIELD:
        assert ran(specimens / "field.toml", tmp_path / "plain", *changes) in (0, 3)
        plain = results(tmp_path / "plain").isel(data_set=0)
        # The energy is that of a load times a displacement, which was measured: 5 %, and by the load alone 10 %.
        by_load = 0.05 * found["uncertain_std"][0] * found["prediction_mean"][-1]
        right = np.hypot(plain["prediction_std"][-1], by_load)
        assert float(found["prediction_std"][-1]) == pytest.approx(float(right), rel=0.05)
        assert (found["prediction_prior_std"] > plain["prediction_prior_std"]).all()
        return
    sampled = NUMBER + '"loads.traction.size" = { kind = "normal", mean = 300, std = 15 }\n'
    (tmp_path / "sampled.toml").write_text(CUBE.replace("MORE", sampled))
    assert ran(tmp_path / "sampled.toml", tmp_path / "sampled", *changes) in (0, 3)
    right = results(tmp_path / "sampled").isel(data_set=0)
    for name in ("std", "mean"):
        np.testing.assert_allclose(found[name][:1], right[name][:1], rtol=0.1)
        np.testing.assert_allclose(found[f"prediction_{name}"][1:], right[f"prediction_{name}"][1:], rtol=0.1)
    np.testing.assert_allclose(found["uncertain_std"][0] * 15, right["std"][1], rtol=0.1)


@pytest.mark.slow
@pytest.mark.fem
def test_a_field_predicts_by_adjoints(specimens, monkeypatch):
    """Against draws of the stored posterior, through the model."""
    for name, value in COARSE.items():
        monkeypatch.setattr(name, value)
    assert ran(specimens / "field.toml", specimens / "field", "method.draws=150", "method.samples=32") in (0, 3)
    found = results(specimens / "field").isel(data_set=0)
    study = load(specimens / "field.toml")
    assert [str(goal) for goal in found["goal"].values] == NAMES
    model = study.predicted.build(MPI.COMM_SELF, study.model.coefficients)
    offset = np.log(study.model.fields[0].mean) - study.model.fields[0].log_std ** 2 / 2
    outputs = np.array([model.solve(values - offset).outputs for values in found["stiffness_draw"].to_numpy()])
    error = outputs.std(axis=0) / np.sqrt(len(outputs))
    assert (
        np.abs(found["prediction_mean"] - outputs.mean(axis=0)) < 4 * np.hypot(error, found["prediction_mean_error"])
    ).all()
    np.testing.assert_allclose(found["prediction_std"], outputs.std(axis=0), rtol=0.25)
    assert ((found["prediction_share"] > 0) & (found["prediction_share"] < 1)).all()
    assert (found["prediction_prior_std"] > found["prediction_std"]).all()


KILLED = """
import os, sys
from uq.evaluation.kept import KeptSolves
from workflows.__main__ import main
known, seen = KeptSolves.__call__, []

def solve(self, *given):
    seen.extend([1] if "predicted" in self.kept.label and "prior" not in self.kept.label else [])
    return os._exit(9) if len(seen) > 3 else known(self, *given)

KeptSolves.__call__ = solve
main(sys.argv[1:])
"""


def asked(study, *changes):
    words = ["run", study, "--quiet", "--no-report", "--set", "method.mesh_error=false", "--set", "method.rank=20"]
    return [*words, *(word for change in changes for word in ("--set", change)), "--out"]


@pytest.mark.slow
@pytest.mark.fem
@pytest.mark.mpi
def test_predictions_of_a_field_do_not_depend_on_groups_nor_kills(specimens, tmp_path):
    """The same bytes where a program ended amid the solves for predictions, and two groups of ranks went on."""
    words = asked(specimens / "field.toml", "predict.samples=8")
    assert run_script(None, KILLED, *words, tmp_path / "cut").returncode == 9
    assert list((tmp_path / "cut" / "evaluations").iterdir())
    assert main([*map(str, words), str(tmp_path / "whole")]) in (0, 3)
    done = tissuq_on_two_ranks(*words, tmp_path / "cut")
    assert done.returncode in (0, 3), done.stderr
    assert_same_bits(tmp_path / "whole", tmp_path / "cut")


@pytest.mark.fem
@pytest.mark.mpi
@pytest.mark.slow  # on a busy machine ranks of a tiny mesh wait for each other
@pytest.mark.parametrize("ranks", [2, 3])
def test_predictions_of_a_field_by_ranks_that_share_a_model(specimens, tmp_path, ranks):
    words = asked(specimens / "field.toml", "predict.samples=2", "model.body.cells=[1, 1, 3]")
    assert in_process(*words, tmp_path / "alone").returncode in (0, 3)
    more = ["--set", f"parallel.ranks_per_model={ranks}"]
    done = run(ranks, TISSUQ, *words, tmp_path / "shared", *more, timeout=900)
    assert done.returncode in (0, 3), done.stderr
    alone, shared = results(tmp_path / "alone"), results(tmp_path / "shared")
    names = [name for name in alone.variables if str(name).startswith("prediction_") and alone[name].dtype.kind == "f"]
    assert names
    for name in names:
        size = float(np.abs(alone[name].fillna(0)).max())
        np.testing.assert_allclose(shared[name], alone[name], rtol=0, atol=1e-9 * size, err_msg=str(name))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("predict.cases=[{name='pul'}]", "predict.cases[0].name"),
        ("predict.cases=[{name='shear'}]", "nothing is predicted in this load case"),
        ("predict.observed=[]", None),
        ("predict.observed=[{at=[[3.0, 0, 0]]}]", "outside the body"),
        ("predict.observed=[{on='z-max'}]", "expected points ('at')"),
        ("predict.observed=[{at=[[1.0, 0, 0]], cases=['shaer']}]", "did you mean 'shear'?"),
        ("predict.model={outputs=[]}", "expected predict.cases and predict.observed"),
        ("predict={cases=[{name='shear', outputs=ENERGY}, {name='shear', outputs=ENERGY}]}", "different names"),
        ("predict={}", "nothing is predicted, expected predict.cases or predict.observed"),
        ("predict.cases=[{name='shear', outputs=[{name='e', kind='strain-energi'}]}]", "did you mean 'strain-energy'?"),
    ],
)
def test_what_cannot_be_predicted_of_a_specimen(specimens, change, said):
    if said is None:
        assert load(specimens / "few.toml", [change]).predict.observed == ()
        return
    with pytest.raises(StudyError) as refused:
        load(specimens / "few.toml", [change.replace("ENERGY", "[{name='e', kind='strain-energy'}]")])
    assert said in str(refused.value)
    assert len(refused.value.args) == 1


@pytest.mark.unit
def test_estimates_of_the_mesh_of_predictions_that_failed_are_an_error():
    numbers = {"mean": [1.0, 1.0], "mean_error": [0.0, 0.0], "std": [1.0, 1.0], "mesh_error": [np.nan, np.nan]}
    found = xr.Dataset(
        {"prediction_why": "", **{f"prediction_{name}": ("goal", values) for name, values in numbers.items()}},
        {"goal": ["sag", "stress"]},
    )
    assert not list(said_of(found))  # a model without a mesh
    keep_unknown(found, ["sag", "stress"], ["sag"])
    error, note = said_of(found)
    assert (error.severity, note.severity) == ("error", "note")
    assert error.text.endswith("failed of sag.")
    assert note.text.endswith("not estimated of stress.")
