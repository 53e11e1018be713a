"""Posteriors by a reduced model, corrected and checked by full solves, against those by the body itself."""

import numpy as np
import pytest

from forward.pointwise import FunctionModel
from forward.reduced.spec import Reduced
from inverse.criticism.doubts import reduced_off
from inverse.data.outputs import stated
from inverse.methods.infer import Problem
from inverse.methods.invert import Invert
from inverse.methods.invert_few import invert_few
from inverse.methods.stand_ins import Agreement, Corrected, invert_by_reduced
from tests import launch
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.hdf5 import stored_dataset
from uq.evaluation.request import Request
from uq.inputs.distributions import Normal
from uq.inputs.random_parameters import Inputs
from workflows.__main__ import main
from workflows.config.mistakes import StudyError
from workflows.config.study import differences, document, load

STUDY = """
[model]
kind = "hyperelastic"
formulation = "displacement"
body = { kind = "box", size = [0.1, 0.05, 0.03], cells = [2, 1, 1], cell = "hexahedron", degree = 1 }
material = { kind = "neo-hookean", C1 = 1000, D1 = 3000 }
fields = [{ of = "stiffness", length = 0.05, std = 0.2, modes = 1 }]
clamp = ["x-min"]
loads = [{ kind = "gravity", density = 1000 }]
outputs = [
    { name = "end", kind = "displacement", at = [0.1, 0.0, 0.03], component = "z" },
    { name = "middle", kind = "displacement", at = [0.05, 0.0, 0.03], component = "z" },
]
[parameters]
"material.C1" = { kind = "uniform", lower = 700, upper = 1300 }
[data]
outputs = { end = [-0.0955, -0.0951], middle = -0.0452 }
noise = { absolute = 2e-4 }
[method]
kind = "invert"
samples = 32
starts = 1
mesh_error = false
"""
SPECIMEN = """
[model]
kind = "specimen"
formulation = "displacement"
body = { kind = "box", size = [0.1, 0.05, 0.03], cells = [2, 1, 1], cell = "hexahedron", degree = 1 }
material = { kind = "neo-hookean", C1 = 1100, D1 = 3000 }
cases = [
    { name = "hang", clamp = ["x-min"], loads = [{ kind = "gravity", density = 950 }] },
    { name = "pull", clamp = ["x-min"], displacements = [{ on = "x-max", x = 0.01 }], outputs = [{ name = "grip", kind = "reaction", on = "x-max", component = "x" }] },
]
observed = [{ at = [[0.1, 0.0, 0.03], [0.05, 0.0, 0.03]] }]
"""  # noqa: E501
MADE = SPECIMEN + '[method]\nkind = "synthesize"\nnoise = { relative = 0.02 }\nseed = 3\n'
OF_SPECIMEN = (
    SPECIMEN
    + """
[parameters]
"material.C1" = { kind = "uniform", lower = 700, upper = 1300 }
"loads.gravity.density" = { kind = "uniform", lower = 900, upper = 1100 }
[data]
files = ["data"]
[method]
kind = "invert"
samples = 32
starts = 1
mesh_error = false
"""
)
SMALL = ["--set", "method.snapshots=8", "--set", "method.unseen=2", "--set", "method.rounds=0"]
BY_REDUCED = ["--set", "method.reduced={file='model.npz',solves=12}"]


def ran(folder, out, *words):
    """Run a study in this process."""
    return main(["run", str(folder / "study.toml"), "--out", str(folder / out), "--quiet", "--no-report", *words])


def results(folder, out):
    return stored_dataset(folder / out / "results.nc").isel(data_set=0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An inversion by the body, and a reduced model over its priors by the command."""
    place = tmp_path_factory.mktemp("by-reduced")
    (place / "study.toml").write_text(STUDY)
    made = ["reduce", place / "study.toml", *SMALL, "--out", place / "made", "--output", place / "model.npz"]
    assert main([*map(str, made), "--quiet", "--no-report"]) == 0
    assert ran(place, "direct") in {0, 3}
    return place


@pytest.mark.fem
def test_the_posterior_is_that_of_the_body_by_few_of_its_solves(folder):
    assert ran(folder, "reduced", *BY_REDUCED) in {0, 3}
    found, direct = results(folder, "reduced"), results(folder, "direct")
    np.testing.assert_allclose(found["mode"], direct["mode"], atol=0.01 * float(direct["std"].min()), rtol=1e-4)
    assert (np.abs(found["mean"] - direct["mean"]) < 0.1 * direct["std"]).all()
    np.testing.assert_allclose(found["std"], direct["std"], rtol=0.1)
    error = 3 * float(np.hypot(found["log_evidence_error"], direct["log_evidence_error"]))
    assert abs(float(found["log_evidence"] - direct["log_evidence"])) < error + 0.02
    assert float(found["reduced_share"]) > 0.95
    assert int(found["solves"]) <= 13
    assert int(direct["solves"]) > 38
    assert found["reduced_shift"].dims == ("parameter",)
    assert "is that of the body" in found.attrs["findings"]


@pytest.mark.fem
def test_what_cannot_stand_for_the_body_is_refused_in_one_line(folder):
    study = folder / "study.toml"
    reduced = "method.reduced=model.npz"
    with pytest.raises(StudyError, match="has other loads"):
        load(study, [reduced, "model.loads=[{kind='gravity',density=1000,direction=[1,0,0]}]"])
    with pytest.raises(StudyError, match=r"material.D1 = 2000, but the model was made with 3000"):
        load(study, [reduced, "model.material.D1=2000"])
    with pytest.raises(StudyError, match="has other body"):
        load(study, [reduced, "model.body.cells=[3,1,1]"])
    with pytest.raises(StudyError, match=r"'loads.gravity.density' kept its value"):
        load(study, [reduced, "parameters={'loads.gravity.density'={kind='uniform',lower=900,upper=1100}}"])
    with pytest.raises(StudyError, match="without the outputs other"):
        load(study, [reduced, "model.outputs=[{name='other',kind='max-displacement'}]", "data.outputs={other=0.01}"])
    with pytest.raises(StudyError, match="cannot be read"):
        load(study, ["method.reduced=nowhere.npz"])
    wider = "parameters={'material.C1'={kind='uniform',lower=700,upper=2000}}"
    assert any("was trained from" in one.text for one in load(study, [reduced, wider]).findings)


@pytest.mark.slow
@pytest.mark.fem
def test_a_specimen_has_a_reduced_model_for_each_load_case(tmp_path):
    (tmp_path / "made.toml").write_text(MADE)
    (tmp_path / "study.toml").write_text(OF_SPECIMEN)
    study, quiet = str(tmp_path / "study.toml"), ["--quiet", "--no-report"]
    assert main(["run", str(tmp_path / "made.toml"), "--out", str(tmp_path / "made"), *quiet]) == 0
    (tmp_path / "made" / "data").rename(tmp_path / "data")
    with pytest.raises(StudyError, match="expected one of: hang, pull"):
        load(tmp_path / "study.toml", ["method={kind='reduce'}"])
    for case in ("hang", "pull"):
        made = ["reduce", study, *SMALL, "--set", f"method.case={case}", "--output", str(tmp_path / f"{case}.npz")]
        assert main([*made, "--out", str(tmp_path / case), *quiet]) == 0
    assert Reduced(file=str(tmp_path / "pull.npz")).scalars.keys() == {"material.C1"}
    with pytest.raises(StudyError, match='hang = "FILE", pull = "FILE"'):
        load(tmp_path / "study.toml", ["method.reduced=hang.npz"])
    with pytest.raises(StudyError, match="hang: made of another body, which has other"):
        load(tmp_path / "study.toml", ["method.reduced={file={hang='pull.npz',pull='pull.npz'}}"])
    assert ran(tmp_path, "direct") in {0, 3}
    by_both = ["--set", "method.reduced={file={hang='hang.npz',pull='pull.npz'},solves=12}"]
    assert ran(tmp_path, "reduced", *by_both) in {0, 3}
    found, direct = results(tmp_path, "reduced"), results(tmp_path, "direct")
    np.testing.assert_allclose((found["mode"] - direct["mode"]) / direct["std"], 0, atol=0.01)
    assert (np.abs(found["mean"] - direct["mean"]) < 0.2 * direct["std"]).all()
    assert float(found["reduced_share"]) > 0.9
    assert int(found["solves"]) <= 13


@pytest.mark.fem
@pytest.mark.slow
def test_batches_with_a_corrected_mesh_and_unknown_noise(folder):
    """Each data set is checked by itself; what finer meshes say is corrected as it is without a reduced model."""
    for name, end in (("a", -0.0955), ("b", -0.092)):
        (folder / f"{name}.csv").write_text(f"output,value\nend,{end}\nend,{end + 4e-4}\nmiddle,{0.473 * end}\n")
    words = ["data={files=['a.csv','b.csv'],noise={absolute=2e-4}}", "method.mesh_error=correct", "method.samples=32"]
    words.append("method.noise={kind='log-normal',mean=1,std=0.5}")
    sets = [part for word in words for part in ("--set", word)]
    assert ran(folder, "batch", *sets, *BY_REDUCED) in {0, 3}
    assert ran(folder, "batch-direct", *sets) in {0, 3}
    found, direct = (stored_dataset(folder / out / "results.nc") for out in ("batch", "batch-direct"))
    np.testing.assert_allclose((found["mode"] - direct["mode"]) / direct["std"], 0, atol=0.05)
    assert (found["reduced_share"] > 0.9).all()
    assert (found["solves"] < 15).all()
    assert found["mesh_corrected"].all()
    np.testing.assert_allclose(found["mesh_error"], direct["mesh_error"], rtol=0.05)


@pytest.mark.fem
def test_the_file_counts_by_what_it_holds(folder, tmp_path):
    study = folder / "study.toml"
    (tmp_path / "elsewhere.npz").write_bytes((folder / "model.npz").read_bytes())
    one, other = load(study, ["method.reduced=model.npz"]), load(study, [f"method.reduced={tmp_path}/elsewhere.npz"])
    assert one.identity() == other.identity()
    assert differences(document(one), document(other)) == []
    with pytest.raises(StudyError, match="has changed since the study was begun"):
        load(study, [f"method.reduced={{file='model.npz',digest='{'0' * 16}'}}"])


@pytest.mark.fem
@pytest.mark.mpi
def test_the_same_bytes_on_two_groups_of_ranks(folder):
    assert ran(folder, "one", *BY_REDUCED) in {0, 3}
    words = ["--out", folder / "two", "--no-report", *BY_REDUCED]
    made = launch.tissuq_on_two_ranks("run", folder / "study.toml", *words)
    assert made.returncode in {0, 3}, made.stderr
    assert (folder / "one" / "results.nc").read_bytes() == (folder / "two" / "results.nc").read_bytes()


INPUTS = Inputs({"a": Normal(mean=0.0, std=1.0), "b": Normal(mean=1.0, std=0.5)})
A = np.array([[1.0, 2.0], [0.5, -1.0], [3.0, 0.2]])
SIGMA = np.array([0.1, 0.1, 0.2])
DATA = stated({"u": 1.2, "v": -0.4, "w": 1.5}, "uvw").with_sigma(np.array(SIGMA))


def model(bend=0.0, twist=0.0, ripple=0.0):
    """A line with a curved part, and one that waves."""

    def outputs(p):
        return A @ p + bend * p[0] ** 2 + twist * p[1] + ripple * np.sin(40 * p)[[0, 1, 0]]

    def slopes(p):
        more = ripple * 40 * np.cos(40 * p)
        waves = np.array([[more[0], 0], [0, more[1]], [more[0], 0]])
        return A + np.array([2 * bend * p[0], twist]) + waves

    return FunctionModel(outputs, INPUTS.names, tuple("uvw"), slopes)


def by_reduced(body, reduced, **settings):
    """Invert with one function in place of another; no file is read."""
    method = Invert.model_construct(**(Invert().model_dump() | {"starts": 1, "samples": 256} | settings))
    method.__dict__["reduced"] = type("Solves", (), {"solves": 24})()
    return invert_by_reduced(INPUTS, SerialEvaluate(body), reduced, Problem(DATA, method, finer=None))


def direct(body):
    return invert_few(INPUTS, SerialEvaluate(body), Problem(DATA, Invert(starts=1, samples=256), finer=None)).dataset


def test_a_wrong_reduced_model_is_corrected_to_the_exact_posterior():
    """Linear errors are corrected by one solve with derivatives, curved ones by those at draws."""
    body = model(bend=0.05)
    found, expected = by_reduced(body, model(bend=0.1, twist=0.4)), direct(body)
    np.testing.assert_allclose(found["mean"], expected["mean"], atol=0.05 * float(expected["std"].min()))
    np.testing.assert_allclose(found["std"], expected["std"], rtol=0.05)
    assert abs(float(found["log_evidence"] - expected["log_evidence"])) < 0.05
    assert float(found["reduced_share"]) > 0.98
    assert float(found["solves"]) < 30


def test_where_no_line_corrects_it_the_weights_say_so():
    found = by_reduced(model(), model(ripple=0.3))
    share, shift = float(found["reduced_share"]), found["reduced_shift"].to_numpy()
    assert share < 0.5
    assert int(found["reduced_rounds"]) == 3
    (doubt,) = reduced_off(share, dict(zip(INPUTS.names, shift, strict=True)), int(found["solves"]))
    assert doubt.severity == "error"
    assert [one.severity for one in reduced_off(0.7, {"a": 0.4}, 30)] == ["warning"]
    assert [one.severity for one in reduced_off(0.97, {"a": 0.04}, 30)] == ["note"]


def test_agreement_of_gaussians_is_in_closed_form():
    """Draws of N(0, 1) against N(a, 1) times a factor: share e^(−a²), shift a, log of the factor."""
    rng, a = np.random.default_rng(1), 0.3
    x = rng.standard_normal((200_000, 1))
    found = Agreement.of(0.7 + a * x[:, 0] - a**2 / 2, x, np.ones(1))
    np.testing.assert_allclose([found.share, found.shift[0], found.log_ratio], [np.exp(-(a**2)), a, 0.7], atol=0.01)
    assert 0.3 < found.error / np.sqrt(np.expm1(a**2) / len(x)) < 3
    nothing = Agreement.of(np.full(8, -np.inf), x[:8], np.ones(1))
    assert nothing.share == 0


def test_corrections_change_as_little_as_suits_the_solves():
    start = Corrected(SerialEvaluate(model()), np.zeros(2), np.zeros(3), np.zeros((3, 2)))
    rng = np.random.default_rng(2)
    points, T = rng.standard_normal((12, 2)), rng.standard_normal((3, 2))
    left = 0.2 + points @ T.T
    better = start.nearer(points, left, np.array([1.0, 3.0]))
    np.testing.assert_allclose(better.at(points), left, atol=1e-12)
    few = start.nearer(points[:1], left[:1], np.ones(2))
    np.testing.assert_allclose(few.at(points[:1]), left[:1], atol=1e-12)
    found = better(Request(points, tangents=True))
    np.testing.assert_allclose(found.outputs, points @ A.T + left, atol=1e-12)
    np.testing.assert_allclose(found.tangents[0], A + T, atol=1e-10)
