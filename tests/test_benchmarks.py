"""What a long benchmark would meet only after minutes."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from benchmarks import same_results, size
from benchmarks.same_results import Done
from benchmarks.stability import FAMILIES
from uq.evaluation.hdf5 import netcdf
from workflows.config.mistakes import StudyError
from workflows.config.study import load


def test_the_map_of_hard_cases_can_be_listed() -> None:
    cases = [case for make in dict.fromkeys(make for *_, make in FAMILIES.values()) for case in make()]
    assert {case.family for case in cases} == set(FAMILIES)
    shipped = {case.y for case in cases if case.family == "shipped studies"}
    assert {"beam", "organ", "cook"} <= shipped
    assert "beam-million" not in shipped


@pytest.mark.slow
def test_time_and_memory_of_a_size_are_measured() -> None:
    unknowns, build, first, counting, tangents, memory = size.measured((3, 1, 1), "multigrid", 1)
    assert unknowns == 3 * 7 * 3 * 3
    assert build > 0
    assert 0 < counting < first
    assert tangents > 0
    assert 0.05 < memory < 2
    assert np.isfinite(size.measured((3, 1, 1), "factor", 1, step=True)).all()


@pytest.fixture(scope="module")
def net(tmp_path_factory):
    """The folder of the net, where nothing was run."""
    folder = tmp_path_factory.mktemp("studies") / "net"
    return shutil.copytree(same_results.ROOT / same_results.NET, folder)


@pytest.mark.parametrize("case", same_results.cases_of([same_results.NET]).values(), ids=lambda case: case.name)
def test_studies_of_the_net_are_valid(net, case, monkeypatch):
    """What is wrong with one that reads the results of others is only that these are not there yet."""
    monkeypatch.chdir(net)
    first = (net / case.file.name).read_text(encoding="utf-8").partition("\n")[0]
    assert re.fullmatch("# Keeps: .+[.]", first), "the first line says which ability the study keeps"
    try:
        load(Path(case.file.name))
    except StudyError as error:
        for mistake in error.args:
            assert any(name in mistake for name in case.needs), mistake
            assert "is not there" in mistake or "no such file" in mistake.lower()


@pytest.mark.parametrize("name", same_results.SHORTER)
def test_shortened_studies_are_valid(name):
    load(same_results.ROOT / "configs" / f"{name}.toml", same_results.SHORTER[name])


@pytest.mark.unit
def test_studies_run_after_those_whose_results_they_read():
    cases = same_results.cases_of(same_results.FOLDERS)
    order = [case.name for case in same_results.in_order(cases, ["from-population"])]
    assert order == ["beams-inverted", "beams-population", "from-population"]
    every = same_results.in_order(cases, [])
    assert {case.name for case in every} == set(cases)
    seen = set()
    for case in every:
        assert case.needs <= seen, case.name
        seen.add(case.name)


def done(folder, *, mean=1.0, findings=(), code=0, **more):
    """Results of a run that nobody made."""
    folder.mkdir()
    dataset = xr.Dataset({"mean": ("output", [mean, 2.0], {"units": "m"}), "solve_seconds": 1 + mean}, attrs=more)
    (folder / "results.nc").write_bytes(netcdf(dataset))
    meshes = [{"unknowns": 10, "seconds": mean}, {"unknowns": 20 + (mean > 1), "seconds": 3 * mean}]
    summary = {"findings": list(findings), "outputs": {"sag": {"mean": mean}}, "cpu_seconds": mean, "meshes": meshes}
    (folder / "summary.json").write_text(json.dumps(summary))
    return Done(folder, code, 1.0)


@pytest.mark.unit
def test_what_differs_between_two_runs_is_said(tmp_path):
    note = {"severity": "note", "text": "All is well."}
    one = done(tmp_path / "one", findings=[note], study='{"a": 1, "seconds": 2}')
    same = done(tmp_path / "two", findings=[note], study='{"a": 1, "seconds": 3}')
    assert list(same_results.compared(one, same)) == []
    worse = note | {"severity": "error"}
    other = done(tmp_path / "other", mean=1 + 2**-40, findings=[worse], code=3, study='{"a": 2}', gone=np.nan)
    (other.directory / "batch.csv").touch()
    assert list(same_results.compared(one, other)) == [
        "exit code 0 before, 3 here",
        "/@study.a differs",
        "/@gone only here",
        "/mean by 4.5e-13",
        "only before “note: All is well.”",
        "only here “error: All is well.”",
        "summary outputs.sag.mean differs",
        "summary meshes.1.unknowns differs",
        "file batch.csv only here",
    ]
    assert any("no results" in text for text in same_results.compared(one, Done(tmp_path / "nowhere", 1, 0.0)))
