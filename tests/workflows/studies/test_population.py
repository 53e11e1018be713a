"""Populations some of whose specimens have to be drawn again: batches of `invert` and groups of `select`."""

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr

from inverse.low_dimensional import population as fits
from inverse.methods.population import LEAST
from tests.inverse.low_dimensional.test_population import closed_form
from tests.launch import TISSUQ, assert_same_bits, environment
from tests.launch import run as on_ranks
from uq.evaluation import kept
from uq.inputs.distributions import LogNormal, Normal
from workflows.config.mistakes import StudyError
from workflows.config.study import load
from workflows.report.page import write_report
from workflows.run.run import run

MODULE = """
import itertools, os
count = itertools.count()
def value(p):
    if "KILL" in os.environ and next(count) > 300:
        os._exit(9)
    return [p[0]]
def slope(p):
    return [[1.0]]
"""
INVERT = """
[model]
kind = "python"
function = "measured_once.value"
jacobian = "measured_once.slope"
parameters = { a = 0.0 }
outputs = ["u"]
[parameters]
a = { kind = "normal", mean = 0.0, std = 1.0 }
[data]
files = ["data"]
[method]
kind = "invert"
samples = 128
starts = 1
"""
SELECT = """
[data]
file = "curve.csv"
group = "specimen"
[candidates.neo-hookean]
material = { kind = "neo-hookean" }
parameters.C1 = { kind = "log-normal", mean = 100, std = 20 }
[method]
kind = "select"
samples = 64
noise = { absolute = 100 }
subsets = { tension = ["uniaxial"] }
"""
VALUES = 6 + np.hypot(0.5, 1.0) * np.random.default_rng(1).standard_normal(4)


class Killed(BaseException):
    """An end amid the work."""


def population(folder, source, more=""):
    path = folder / "population.toml"
    path.write_text(f'[method]\nkind = "population"\nsource = "{source}"\ndraws = 400\n{more}\n')
    return path


@pytest.fixture(scope="module")
def batch(tmp_path_factory):
    """Four specimens of a number, measured once each, whose prior is six of its deviations away."""
    folder = tmp_path_factory.mktemp("batch")
    (folder / "measured_once.py").write_text(MODULE)
    (folder / "data").mkdir()
    for k, value in enumerate(VALUES):
        (folder / "data" / f"s{k}.csv").write_text(f"output,value,sigma\nu,{value},1\n")
    (folder / "invert.toml").write_text(INVERT)
    sys.path.insert(0, str(folder))
    assert run(load(folder / "invert.toml"), "invert", folder / "results", quiet=True, report=False) in (0, 3)
    yield folder
    sys.path.remove(str(folder))


def texts(directory):
    return [one["text"] for one in json.loads((directory / "summary.json").read_text())["findings"]]


@pytest.mark.slow
def test_a_batch_is_inverted_again_where_its_draws_do_not_reach(batch, tmp_path, looked_at):
    """The same bytes on any number of ranks and after an end amid it, and without the data a finding that says so."""
    mean, std, each = closed_form(VALUES, 1.0, Normal(mean=0.0, std=1.0))
    more = f'distribution = "normal"\nstudy = "{batch / "invert.toml"}"'
    path = population(tmp_path, batch / "results", more)
    assert run(load(path), "population", tmp_path / "one", quiet=True, report=False) == 0
    command = [TISSUQ, "run", path, "--quiet", "--no-report", "--out"]
    done = on_ranks(2, *command, tmp_path / "two")
    assert done.returncode == 0, done.stderr
    for kill, status in (({"KILL": "1"}, 9), ({}, 0)):
        words = list(map(str, [*command, tmp_path / "cut"]))
        done = subprocess.run(words, env=environment() | kill, capture_output=True, check=False)
        assert done.returncode == status, done.stderr
    for other in ("two", "cut"):
        assert_same_bits(tmp_path / "one", tmp_path / other)
    found = xr.load_dataset(tmp_path / "one" / "results.nc")
    assert (found["specimen_redrawn"] >= 1).all()
    assert (found["specimen_effective"] >= LEAST).all()
    assert float(found["location_mean"][0]) == pytest.approx(mean, abs=0.5 * std)
    np.testing.assert_allclose(found["specimen_mean"][:, 0], each, atol=0.5 * std)
    summary = json.loads((tmp_path / "one" / "summary.json").read_text())
    assert summary["evaluations"] > 4 * 128
    page = write_report(tmp_path / "one").read_text()
    lines = page.partition("<h2>Its specimens</h2>")[2]
    assert all(lines.count(f'<td class="text">s{k}</td>') == 1 for k in range(len(each)))  # a line for each specimen
    looked_at(tmp_path / "one")
    assert any(text.startswith("Few draws of s0") and "drawn again" in text for text in texts(tmp_path / "one"))
    alone = population(tmp_path, batch / "results", 'distribution = "normal"')
    assert run(load(alone), "population", tmp_path / "alone", quiet=True, report=False) == 0
    assert any("cannot be drawn again: s0.csv is not in" in text for text in texts(tmp_path / "alone"))


@pytest.mark.slow
def test_walkers_go_on_where_they_were_stopped(batch, tmp_path, monkeypatch):
    """What is lost of the fit is what was not written yet; the results are the same bytes."""
    monkeypatch.setattr(kept, "SECONDS_BETWEEN_STRETCHES", 0.005)
    monkeypatch.setattr("inverse.methods.population.ROUNDS", 1)
    study = load(population(tmp_path, batch / "results", 'distribution = "normal"'))
    counts, density = [0], fits._log_posterior

    def counted(*given):
        counts[-1] += 1
        if len(counts) == 2 and counts[-1] > 400:
            raise Killed
        return density(*given)

    monkeypatch.setattr(fits, "_log_posterior", counted)
    assert run(study, "population", tmp_path / "whole", quiet=True, report=False) in (0, 3)
    counts.append(0)
    with pytest.raises(Killed):
        run(study, "population", tmp_path / "parts", quiet=True, report=False)
    counts.append(0)
    assert run(study, "population", tmp_path / "parts", quiet=True, report=False) in (0, 3)
    assert counts[2] <= counts[0] - 390
    assert_same_bits(tmp_path / "whole", tmp_path / "parts")


def test_data_that_have_changed_are_not_inverted_again(batch, tmp_path):
    shutil.copytree(batch, tmp_path / "moved")
    changed = tmp_path / "moved" / "data" / "s1.csv"
    changed.write_text(changed.read_text().replace("u,", "u,1"))
    more = f'distribution = "normal"\nstudy = "{tmp_path / "moved" / "invert.toml"}"'
    study = load(population(tmp_path, batch / "results", more))
    assert run(study, "population", tmp_path / "population", quiet=True, report=False) == 0
    found = xr.load_dataset(tmp_path / "population" / "results.nc")
    assert found["specimen_redrawn"].values.tolist()[1] == 0
    assert any("s1.csv has changed since s1 was inverted" in text for text in texts(tmp_path / "population"))


@pytest.fixture(scope="module")
def stated(batch, tmp_path_factory):
    """A population of three specimens whose device may err; the data of a fourth could not be inverted."""
    folder = tmp_path_factory.mktemp("stated")
    shutil.copytree(batch / "data", folder / "data")
    (folder / "data" / "s2.csv").write_text("output,value,sigma\nu,nan,1\n")
    (folder / "invert.toml").write_text(INVERT + '\n[uncertain]\n"data.scale" = 0.05\n')
    run(load(folder / "invert.toml"), "invert", folder / "results", quiet=True, report=False)
    study = load(population(folder, folder / "results", 'distribution = "normal"'))
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("inverse.methods.population.ROUNDS", 1)  # what is said of the source does not need more
        assert run(study, "population", folder / "population", quiet=True, report=False) == 0
    return folder


def test_data_sets_that_could_not_be_inverted_are_named(stated):
    lost = "1 of 4 data sets could not be inverted, and are not in the population: s2."
    assert [text for text in texts(stated / "population") if "could not be inverted" in text] == [lost]


def test_what_is_uncertain_in_the_source_is_shared_by_specimens(stated, tmp_path):
    """A scale of the data of 5 % moves a number of 6 by about a quarter of its deviation."""
    study = load(stated / "population.toml")
    said = [text for text in texts(stated / "population") if "err alike in all specimens" in text]
    assert len(said) == 1
    assert "one deviation of data.scale moves a by 0." in said[0]
    assert "population-model-error" not in [one.code for one in study.findings]
    for blocks, name, given in (
        (study.source.blocks["data"]["errors"], "process", True),
        (study.source.blocks, "model_error", {"against": {}}),
    ):
        blocks[name] = given
        assert "population-model-error" in [one.code for one in study.findings]
        del blocks[name]
        assert "population-model-error" not in [one.code for one in study.findings]
    with pytest.raises(StudyError, match=r"did you mean 'data\.scale'"):
        load(population(tmp_path, stated / "results", 'distribution = "normal"\nown = ["data.scael"]'))


def by_sums(truth, slope, sigma):
    """Median of the typical modulus, by sums over grids of ln C1, and of its mean and deviation over specimens."""
    z, m = np.linspace(3, 9, 1201), np.linspace(3, 9, 121)
    s, prior = np.exp(np.linspace(np.log(0.01), np.log(10), 80)), LogNormal(mean=100.0, std=20.0).of_coordinate
    deviations = (np.outer(np.exp(z), slope) - C1 * slope for C1 in truth)
    likelihoods = np.array([np.exp(-((one / sigma) ** 2).sum(axis=1) / 2) for one in deviations])
    found = -(((m[:, None] - prior[0]) / (2 * prior[1])) ** 2) / 2 + np.log(s) - 2 * np.log1p((s / prior[1]) ** 2 / 3)
    for j, width in enumerate(s):
        kernel = np.exp(-(((z - m[:, None]) / width) ** 2) / 2) / width
        found[:, j] += np.log(kernel @ likelihoods.T + 1e-300).sum(axis=1)
    w = np.exp(found - found.max()).sum(axis=1)
    return float(np.exp(np.interp(0.5, np.cumsum(w) / w.sum(), m)))


@pytest.mark.slow
def test_groups_of_a_comparison_are_solved_again(tmp_path):
    """Specimens that are three times as stiff as the prior expects."""
    stretch, truth = np.array([1.1, 1.2, 1.3]), {"one": 300.0, "two": 320.0, "three": 280.0, "four": 310.0}
    slope = 2 * (stretch - stretch**-2)
    rows = [f"uniaxial,{name},{x},{C1 * k}" for name, C1 in truth.items() for x, k in zip(stretch, slope, strict=True)]
    (tmp_path / "curve.csv").write_text("\n".join(["mode,specimen,stretch,stress", *rows]))
    (tmp_path / "select.toml").write_text(SELECT)
    assert run(load(tmp_path / "select.toml"), "select", tmp_path / "results", quiet=True, report=False) in (0, 3)
    path = population(tmp_path, tmp_path / "results")
    assert run(load(path), "population", tmp_path / "population", quiet=True, report=False) == 0
    found = xr.load_dataset(tmp_path / "population" / "results.nc")
    assert (found["own_mean"] < 200).all()  # the prior holds them
    assert (found["specimen_redrawn"] >= 1).all()
    assert (found["specimen_effective"] >= LEAST).all()
    right = by_sums(truth.values(), slope, 100.0)
    assert float(found["typical_quantiles"][1, 0]) == pytest.approx(right, rel=0.1)
