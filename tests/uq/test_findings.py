"""What a study says of the worth of its own numbers: kept with the results, and in the exit code."""

import json
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from forward.findings import CATALOGUE, Entry, Finding, Words, entries, register
from uq.findings import add, findings, once_for_outputs, once_for_steps, withdraw
from workflows.run.run import exit_code

pytestmark = pytest.mark.unit

TABLE = {
    "test-said": Words("{text}"),
    "test-samples": Words("The {n} samples of {about} look {how}, by {spread:.2g}."),
    "test-list": Words("It errs by: {about}. So.", between="; ", listed=8),
    "test-clause": Words("the mesh of {about} errs by {much:.0%}", short="{about} is off"),
    "test-named": Words("{about} is at the end", short=""),
}


@pytest.fixture(autouse=True)
def words(monkeypatch):
    for code, said in TABLE.items():
        monkeypatch.setitem(CATALOGUE, code, said)


def said(severity, text):
    return Finding("test-said", severity, {"text": text})


def of(name, spread, severity="warning", how="log-normal"):
    return Finding("test-samples", severity, {"n": 20, "how": how, "spread": spread}, entries([name]))


def test_findings_are_kept_once_and_listed_by_severity():
    dataset = xr.Dataset()
    assert findings(dataset) == []
    add(dataset)
    assert dataset.attrs == {}
    add(dataset, said("note", "a"), said("warning", "b"))
    add(dataset, said("error", "c – “quoted”"), said("note", "a"))
    assert findings(dataset) == [said("error", "c – “quoted”"), said("warning", "b"), said("note", "a")]


def test_a_number_that_cannot_be_trusted_is_told_by_the_exit_code():
    def code(failed, *severities):
        return exit_code({"failed": failed, "findings": [{"severity": s, "text": ""} for s in severities]})

    assert code(0) == code(0, "note", "warning") == 0
    assert code(1) == code(0, "warning", "error") == 3


def test_a_finding_comes_back_from_a_file_as_it_was():
    dataset = xr.Dataset()
    entry = Entry("force.1", " 2 N", np.float64(2.0))
    found = Finding("test-list", "note", {"n": np.int64(3)}, (entry,)).of("Candidate 'a'").of("all")
    add(dataset, replace(found, also="at step 2"))
    (kept,) = json.loads(dataset.attrs["findings"])
    text = "all: Candidate 'a': It errs by: force.1 2 N. So. The same, with other numbers, at step 2."
    assert (kept["severity"], kept["text"], kept["code"]) == ("note", text, "test-list")
    (back,) = findings(dataset)
    assert (back.text, back.about, back.values, back.subject) == (text, (entry,), {"n": 3}, "all: Candidate 'a'")


def test_words_of_other_versions_stay_as_they_were_said():
    old = {"severity": "warning", "text": "What was {said}."}
    unknown = Finding("test-said", "note", {"text": "u"}).kept() | {"code": "gone"}
    other_places = Finding("test-said", "note", {"text": "p"}).kept() | {"values": {"words": "p"}}
    dataset = xr.Dataset(attrs={"findings": json.dumps([old, unknown, other_places])})
    assert [one.text for one in findings(dataset)] == ["What was {said}.", "u", "p"]
    add(dataset, said("error", "e"))
    assert [one.text for one in findings(dataset)] == ["e", "What was {said}.", "u", "p"]


def test_a_code_stands_for_one_kind_of_words():
    register({"test-said": TABLE["test-said"]})  # the same words twice do no harm
    with pytest.raises(ValueError, match="'test-said' has other words"):
        register({"test-said": Words("other")})


def test_a_clause_is_a_sentence_of_its_own_or_of_a_subject():
    found = Finding("test-clause", "warning", {"much": 0.2}, entries(["uy"]))
    assert (found.text, found.short) == ("The mesh of uy errs by 20%.", "uy is off")
    assert found.of("patient").text == "patient: the mesh of uy errs by 20%."
    assert Finding("test-named", "note", about=entries(["uy"])).text == "uy is at the end."


def test_many_outputs_are_not_all_named():
    found = Finding("test-list", "note", about=entries("abcdefghij"))
    assert found.text == "It errs by: a; b; c; d; e; f; g; h; and 2 more. So."
    assert replace(found, about=entries("abcdefghi")).text == "It errs by: a; b; c; d; e; f; g; h; i. So."


def test_what_is_said_of_an_output_is_withdrawn_wherever_it_stands_in_a_sentence():
    dataset = xr.Dataset()
    left = said("note", "of uy")  # about no output
    several = Finding("test-list", "error", about=(Entry("ux", ", 1"), Entry("uy", ", 2")))
    add(dataset, of("uy", 4), of("uy.max", 5), several, Finding("test-list", "note", about=entries(["uy"])), left)
    withdraw(dataset, ["uy"])
    assert findings(dataset) == [replace(several, about=several.about[:1]), of("uy.max", 5), left]


def test_what_holds_at_several_steps_is_said_once():
    outputs = ["force.1", "force.2", "force.10", "area.1"]
    axes = {"output_of": ("output", ["force", "force", "force", "area"]), "step": ("output", [1, 2, 10, 1])}
    dataset = xr.Dataset(coords={"output": outputs, **axes})
    add(dataset, *(of(name, number) for name, number in zip(outputs, (4, 5, 6, 7), strict=True)))
    other = of("force.2", 3, how="odd"), said("warning", "force.1 and force.2 differ by 1.")
    add(dataset, of("force.2", 9, "error"), *other)
    once_for_steps(dataset)
    assert findings(dataset) == [
        of("force.2", 9, "error"),
        replace(of("force.1", 4), also="at steps 2, 10"),
        of("area.1", 7),
        *other,
    ]


NAMES = [f"{name}.{step}" for step in (1, 2, 3) for name in ("force", "area")]


@pytest.mark.parametrize(
    ("about", "shorter"),
    [
        (
            [(name, f" {n}%", n) for name, n in zip(NAMES, (18, 22, 21, 23, 20, 20), strict=True)],
            "force 21% (step 2, the largest of steps 1 to 3); area 23% (step 2, the largest of steps 1 to 3)",
        ),
        (
            [
                ("force.1", " = 900 N, there 2", 900.0),
                ("area.1", " = 1 m", 1.0),
                ("force.2", " = −1.2 kN, there 3", -1200.0),
                ("force.3", " = 1.1 kN, there 4", 1100.0),
            ],
            "force = −1.2 kN, there 3 (step 2, the largest of steps 1 to 3); area.1 = 1 m",
        ),
        ([("force.1",), ("force.2",), ("force.3",)], "force at steps 1 to 3"),
        ([("force.1",), ("force.2",)], "force.1; force.2"),
        ([("other", " 2%", 2), ("ux", " 3%", 3)], "other 2%; ux 3%"),
    ],
)
def test_lists_of_many_steps_say_where_it_is_most(about, shorter):
    axes = {"output_of": ("output", ["force", "area"] * 3), "step": ("output", [1, 1, 2, 2, 3, 3])}
    dataset = xr.Dataset(coords={"output": NAMES, **axes})
    add(dataset, Finding("test-list", "note", about=tuple(Entry(*one) for one in about)))
    once_for_steps(dataset)
    assert [one.text for one in findings(dataset)] == [f"It errs by: {shorter}. So."]


def test_the_largest_of_many_steps_is_found_before_outputs_are_left_out():
    names = [f"force.{step}" for step in range(1, 13)]
    axes = {"output_of": ("output", ["force"] * 12), "step": ("output", list(range(1, 13)))}
    dataset = xr.Dataset(coords={"output": names, **axes})
    add(dataset, Finding("test-list", "note", about=tuple(Entry(name, f" {k}%", k) for k, name in enumerate(names))))
    once_for_steps(dataset)
    assert findings(dataset)[0].text == "It errs by: force 11% (step 12, the largest of steps 1 to 12). So."


def test_what_is_said_of_several_outputs_is_said_once():
    found = [of("press.x", 0.3), said("note", "Of press.x and y."), of("press.x.1", 0.4), of("y", 0.5)]
    expected = replace(found[0], also="of y")
    assert once_for_outputs(found, ("press.x", "y")) == [expected, *found[1:3]]
    assert once_for_outputs(found, ()) == found
    assert once_for_outputs((), ("y",)) == []
