"""The public namespace: studies and models from Python, in a few lines."""

import html
import re
import sys
from importlib.metadata import version

import numpy as np
import pytest

import tissuq
from tests.launch import ROOT, on_kept_ranks, run_script
from uq.methods.chaos import Chaos

TINY = ROOT / "configs" / "tiny.toml"


def test_importing_it_imports_nothing_heavy():
    heavy = "{'dolfinx', 'mpi4py', 'petsc4py', 'ufl', 'scipy', 'numpy', 'xarray', 'pydantic', 'matplotlib'}"
    done = run_script(None, f"import sys, tissuq; print(sorted({heavy} & set(sys.modules)))")
    assert done.stdout.strip() == "[]", done.stderr


def test_every_name_is_there():
    assert dir(tissuq) == sorted([*tissuq.__all__, "__version__"])
    assert tissuq.__version__ == version("tissuq")
    for name in tissuq.__all__:
        assert getattr(tissuq, name) is not None
    with pytest.raises(AttributeError, match="did you mean 'Study'"):
        _ = tissuq.Studdy


@pytest.mark.fem
def test_a_study_in_memory_is_that_of_the_command(tmp_path, monkeypatch, undrawn):
    study = tissuq.load(TINY, ["method.samples=8", "model.body.cells=[2, 1, 1]"])
    found = study.run()
    kept = tissuq.run(study, tmp_path / "study")
    for name in found.variables:
        assert found[name].to_numpy().tobytes() == kept[name].to_numpy().tobytes()
    again = tissuq.run(study, tmp_path / "study")  # finished: it is read
    np.testing.assert_array_equal(again["mean"], kept["mean"])
    assert sorted(path.name for path in (tmp_path / "study").iterdir()) == [
        "evaluations.h5", "fields", "results.nc", "study.toml", "summary.json",
    ]  # fmt: skip
    assert tissuq.plots.histogram(found, "uy_max").get_xlabel()
    assert tissuq.findings(found) == tissuq.findings(kept)
    for one in (found, kept):
        shown = one.tissuq.show()
        assert "uy_max: " in repr(shown)
        assert "<canvas" in html.unescape(shown._repr_html_())
        assert "image/svg+xml" in one.tissuq.plot()._repr_mimebundle_()
        assert one.tissuq.to_pandas().loc["uy_max", "mean_error"] == float(found["mean_error"].sel(output="uy_max"))
        grid = one.tissuq.to_pyvista()
        assert grid.n_cells == found.sizes["cell"]
        np.testing.assert_array_equal(grid["mean (m)"], found["field_mean"].to_numpy())
    assert "9 solves, 0 failed" in repr(kept.tissuq.show("header"))
    for name in ("answr", "header"):  # the second only of a directory
        with pytest.raises(tissuq.Error, match=f"'{name}' is no section of the report; did you mean 'answer'"):
            found.tissuq.show(name)
    alone = found.copy()  # beside results of another study
    alone.encoding.clear()
    monkeypatch.chdir(tmp_path / "study")
    with pytest.raises(tissuq.Error, match="'header' is no section"):
        alone.tissuq.show("header")
    with pytest.raises(tissuq.Error, match="no posterior in results of 'sensitivity-monte-carlo'"):
        found.tissuq.to_arviz()
    with pytest.raises(tissuq.Error, match="no whole results"):
        found[["mean"]].drop_attrs().tissuq.show()


@pytest.mark.fem
@pytest.mark.mpi
def test_under_mpirun_the_first_rank_has_the_results():
    script = (
        "import sys, tissuq; from mpi4py import MPI; "
        "found = tissuq.run(tissuq.load(sys.argv[1], ['method.samples=8'])); "
        "print(MPI.COMM_WORLD.rank, sorted(map(str, found.data_vars))[:1])"
    )
    done = on_kept_ranks(2, script, TINY)
    assert done.returncode == 0, done.stderr
    first, second = sorted(line for line in done.stdout.splitlines() if line[:2] in {"0 ", "1 "})
    assert first != "0 []"
    assert second == "1 []"


@pytest.mark.fem
def test_a_model_by_the_names_of_its_numbers():
    model = tissuq.Model(tissuq.load(TINY).model)
    first = model.solve({"material.C1": 9e3})
    assert set(first) == {"uy_max", "ux_max"}
    step = 1.0
    ends = [model.solve({"material.C1": 9e3 + h}, near=first) for h in (-step, step)]
    slope = (ends[1]["uy_max"] - ends[0]["uy_max"]) / (2 * step)
    assert first.gradient("uy_max")["material.C1"] == pytest.approx(slope, rel=1e-5)
    np.testing.assert_array_equal(np.lexsort(np.round(model.nodes, 9).T[::-1]), np.arange(len(model.nodes)))
    np.testing.assert_allclose(
        first.displacement_at(model.nodes[[0, 7, -1]]), first.displacement[[0, 7, -1]], atol=1e-14
    )
    finer = tissuq.Model(tissuq.load(TINY).model.refined(1)).solve({"material.C1": 9e3})
    assert first["uy_max"] < finer["uy_max"] < first["uy_max"] + first.mesh_error["uy_max"]  # which errs as much less
    assert finer["uy_max"] - first["uy_max"] > 0.5 * first.mesh_error["uy_max"]
    assert -first.displacement[:, 1].min() == pytest.approx(first["uy_max"])
    middle = model.nodes[[0, -1]].mean(axis=0)
    assert first.displacement_at(middle).shape == (1, 3)
    with pytest.raises(ValueError, match="outside the mesh"):
        first.displacement_at([1.0, 0.0, 0.0])
    with pytest.raises(KeyError, match=r"did you mean 'material\.C"):
        model.solve({"material.C3": 1.0})
    with pytest.raises(KeyError, match=r"did you mean 'uy_max'"):
        first.gradient("uy_mx")
    assert "uy_max = " in repr(first)


def test_a_python_function_is_a_model_too(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(ROOT / "configs"), *sys.path])
    model = tissuq.Model(tissuq.load(ROOT / "configs" / "own-model.toml").model)
    found = model.solve({"load": 2.0})
    assert found["tip"] == pytest.approx(2 * model.solve()["tip"])
    assert model.nodes is None
    assert found.mesh_error == {}
    with pytest.raises(ValueError, match="no body"):
        _ = found.displacement


BODY = {
    "body": {"kind": "box", "size": np.array([0.1, 0.02, 0.02]), "cells": [6, 2, 2]},
    "clamp": ["x-min"],
    "material": {"kind": "neo-hookean", "C1": 1e4, "D1": 2e5},
    "loads": [{"kind": "gravity", "density": 1000.0}],
    "outputs": [{"name": "sag", "kind": "max-displacement", "component": "z"}],
}
GIVEN = {"material.C1": {"kind": "log-normal", "mean": 1e4, "std": 2e3}}


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda: tissuq.Study(modle=BODY), "method: missing\nmodle: unknown key; did you mean 'model'?"),
        (lambda: tissuq.Study(model=BODY, method={"kind": "inwert"}), "did you mean 'invert'?; given 'inwert'"),
        (lambda: tissuq.Study(model=BODY, method={"kind": "invert", "samples": 0.5}), "data: missing"),
        (lambda: tissuq.Hyperelastic(**BODY | {"clamp": "x-min"}), "clamp: expected a list; given 'x-min'"),
        (lambda: tissuq.Specimen(**BODY), "clamp: unknown key"),
        (lambda: tissuq.Model(BODY | {"kind": "hyperelastc"}), "did you mean 'hyperelastic'"),
        (lambda: tissuq.Model(BODY, ["material.C2"]), "did you mean 'material.C1'"),
        (lambda: tissuq.load("nothing.toml"), "nothing.toml: cannot be read: No such file"),
        (lambda: tissuq.read("nothing"), "nothing: holds no results.nc"),
        (lambda: tissuq.load(TINY, ["method.kind='chaos'", "method.smaples=3"]), "did you mean 'samples'"),
    ],
)
def test_what_is_wrong_is_said_in_lines_by_one_kind_of_exception(wrong, said):
    with pytest.raises(tissuq.Error) as caught:
        wrong()
    assert said in str(caught.value)


def test_every_exception_of_the_program_is_one():
    apart = {"Error", "Diverged", "TimeLimitError", "RefusalError"}  # of control flow, and of requests to a server
    for file in (
        one for package in ("forward", "uq", "inverse", "workflows", "tissuq") for one in (ROOT / package).rglob("*.py")
    ):
        for name, bases in re.findall(r"^class (\w+)\(([^)]*(?:Error|Exception))\):", file.read_text(), re.MULTILINE):
            assert name in apart or not {"Exception", "ValueError", "OSError"} & {bases}, (file, name)


def test_a_study_takes_functions_of_the_session_and_blocks_as_objects(tmp_path):
    def twice(p):
        return 2 * p

    model = tissuq.Model({"kind": "python", "function": twice, "parameters": {"a": 1.0}, "outputs": ["y"]})
    study = tissuq.Study(
        model=model.spec, parameters={"a": {"kind": "normal", "mean": 1, "std": 0.1}}, method=Chaos(samples=8)
    )
    assert study.run()["mean"].item() == pytest.approx(2.0)
    with pytest.raises(tissuq.Error, match="is a function of this session"):
        study.run(tmp_path / "kept")


def test_a_posterior_for_arviz_is_that_of_the_file(tmp_path, monkeypatch):
    import arviz

    monkeypatch.setattr(sys, "path", [str(ROOT / "configs"), *sys.path])
    study = tissuq.Study(
        model=tissuq.load(ROOT / "configs" / "own-model.toml").model,
        parameters={"E": {"kind": "log-normal", "mean": 1e6, "std": 2e5}},
        data={"outputs": {"tip": 7.5e-3}, "sigma": {"tip": 1e-4}},
        method={"kind": "invert", "samples": 32},
    )
    found = study.run(tmp_path / "inverted")
    kept, made = arviz.from_netcdf(tmp_path / "inverted" / "results.nc"), found.tissuq.to_arviz()
    for group in ("posterior", "prior", "log_likelihood", "observed_data"):
        assert made[group].equals(kept[group]), group
    assert found.tissuq.to_pandas().index.names == ["data_set", "parameter"]


def test_studies_and_models_are_shown_in_few_words(monkeypatch):
    monkeypatch.setattr(sys, "path", [str(ROOT / "configs"), *sys.path])
    names = [f"x{i}" for i in range(100)]
    model = {"kind": "python", "function": "own_model.beam", "parameters": dict.fromkeys(names, 1.0), "outputs": names}
    given = {name: {"kind": "normal", "mean": 0, "std": 1} for name in names}
    study = tissuq.Study(model=model, parameters=given, method={"kind": "monte-carlo", "samples": 8})
    assert repr(study).startswith("Study(model: python; parameters: x0, x1, x2, x3 and 96 others; method: monte-carlo")
    assert len(repr(study)) < 300
    assert "[parameters.x99]" in study._repr_html_()
    made = tissuq.Model(study.model)
    assert repr(made) == "Model(python: 100 numbers that can change; x0, x1, x2, x3, x4, x5, x6, x7 and 92 more)"
    assert "<td>x99</td>" in made._repr_html_()


def test_vectors_are_written_as_such():
    weights = np.random.default_rng(1).standard_normal((30, 20)) / 4
    model = {
        "kind": "python",
        "function": lambda_free(weights.__matmul__),
        "jacobian": lambda_free(lambda p: weights, "slopes"),
        "parameters": {"x": {"size": 20}},
        "outputs": [{"name": "y", "size": 30, "unit": "m"}],
    }
    given = {"x": {"size": 20, "kind": "normal", "mean": np.arange(20.0), "std": 1}}
    study = tissuq.Study(model=model, parameters=given, method={"kind": "local-sensitivity"})
    found = study.run()
    assert found["parameter"].values.tolist() == [f"x.{i}" for i in range(20)]
    np.testing.assert_allclose(found["nominal"].sel(output="y.29"), weights[29] @ np.arange(20.0))
    truth = np.arange(20.0) + 0.5
    stated = {"outputs": {"y": weights @ truth}, "sigma": {"y": 1e-3}}
    study = tissuq.Study(model=model, parameters=given, data=stated, method={"kind": "invert"})
    np.testing.assert_allclose(study.run()["mode"][0], truth, atol=0.01)


def test_functions_of_one_name_are_told_apart():
    """Those that a factory makes, and those without a name; one that is defined again is the same."""

    def made(k):
        def f(p):
            return [k * p[0]]

        return f

    class Scaled:
        def __init__(self, k):
            self.k = k

        def __call__(self, p):
            return [self.k * p[0]]

    def study(function):
        model = {"kind": "python", "function": function, "parameters": {"x": 1.0}, "outputs": ["y"]}
        given = {"x": {"kind": "uniform", "lower": 0, "upper": 2}}
        return tissuq.Study(model=model, parameters=given, method={"kind": "monte-carlo", "samples": 4})

    known = [(made(1.0), 1), (made(10.0), 10), (lambda p: [2 * p[0]], 2), (lambda p: [3 * p[0]], 3), (Scaled(4.0), 4)]
    known += [(Scaled(k).__call__, k) for k in (5.0, 6.0)]  # methods hold their object
    studies = [(study(function), size) for function, size in known]
    first = studies[0][0].run()["mean"]
    for one, size in studies:
        np.testing.assert_allclose(one.run()["mean"], size * first, rtol=1e-12)
    again = [study(f).model.function for f in 2 * [lambda p: [5 * p[0]]]]
    assert again[0] == again[1]


def lambda_free(function, name="map_of_x"):
    """A function with a name, as a session has them."""

    def found(p):
        return function(p)

    found.__name__ = name
    return found


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"parameters": {"x": {"size": 64, "kind": "normal", "mean": 0}}}, "x.0.std: missing (63 more like it)"),
        ({"parameters": {"x": {"size": 0, "kind": "normal"}}}, "x.size is 0, expected a whole number from 1"),
        ({"parameters": {"x": {"size": 65, "kind": "normal", "mean": 0, "std": 1}}}, "x.64"),
    ],
)
def test_what_is_wrong_with_a_vector_is_said_once(change, said):
    model = {"kind": "python", "function": len, "parameters": {"x": [0.0] * 64}, "outputs": ["y"]}
    with pytest.raises(tissuq.Error) as caught:
        tissuq.Study(**{"model": model, "method": {"kind": "monte-carlo", "samples": 8}} | change)
    assert said in str(caught.value)
    assert len(str(caught.value)) < 400
