"""What a study says of the worth of its own numbers: kept with the results, and in the exit code."""

import pytest
import xarray as xr

from forward.model import Finding
from uq.findings import add, findings, once_for_outputs, once_for_steps
from workflows.run.run import exit_code

pytestmark = pytest.mark.unit


def test_findings_are_kept_once_and_listed_by_severity():
    dataset = xr.Dataset()
    assert findings(dataset) == []
    add(dataset)
    assert dataset.attrs == {}
    add(dataset, Finding("note", "a"), Finding("warning", "b"))
    add(dataset, Finding("error", "c – “quoted”"), Finding("note", "a"))
    assert findings(dataset) == [Finding("error", "c – “quoted”"), Finding("warning", "b"), Finding("note", "a")]


def test_a_number_that_cannot_be_trusted_is_told_by_the_exit_code():
    def of(failed, *severities):
        return exit_code({"failed": failed, "findings": [{"severity": s, "text": ""} for s in severities]})

    assert of(0) == of(0, "note", "warning") == 0
    assert of(1) == of(0, "warning", "error") == 3


def test_what_holds_at_several_steps_is_said_once():
    outputs = ["force.1", "force.2", "force.10", "area.1"]
    axes = {"output_of": ("output", ["force", "force", "force", "area"]), "step": ("output", [1, 2, 10, 1])}
    dataset = xr.Dataset(coords={"output": outputs, **axes})
    said = "The 20 samples of {} look log-normal, their logarithms have a standard deviation of {}."
    add(dataset, *(Finding("warning", said.format(name, number)) for name, number in zip(outputs, "4567", strict=True)))
    add(dataset, Finding("error", said.format("force.2", 9)), Finding("warning", "force.1 and force.2 differ by 1."))
    once_for_steps(dataset)
    assert findings(dataset) == [
        Finding("error", said.format("force.2", 9)),
        Finding("warning", said.format("force.1", 4) + " The same, with other numbers, at steps 2, 10."),
        Finding("warning", said.format("area.1", 7)),
        Finding("warning", "force.1 and force.2 differ by 1."),
    ]


@pytest.mark.parametrize(
    ("said", "shorter"),
    [
        (
            "It errs by: force.1 18%, area.1 22%, force.2 21%, area.2 23%, force.3 20%, area.3 20%. So.",
            "It errs by: force 21% (step 2, the largest of steps 1 to 3), "
            "area 23% (step 2, the largest of steps 1 to 3). So.",
        ),
        (
            "At: force.1 = 3,184 N, there 2; area.1 = 1 m; force.2 = −9,184 N, there 3; force.3 = 1e3 N, there 4.",
            "At: force = −9,184 N, there 3 (step 2, the largest of steps 1 to 3); area.1 = 1 m.",
        ),
        ("They do not agree for force.1, force.2, force.3: why?", "They do not agree for force at steps 1 to 3: why?"),
        ("They do not agree for force.1, force.2: why?", "They do not agree for force.1, force.2: why?"),
        ("force.1 is small, force.2 is odd, force.3 is large.", "force.1 is small, force.2 is odd, force.3 is large."),
    ],
)
def test_lists_of_many_steps_say_where_it_is_most(said, shorter):
    names = [f"{name}.{step}" for step in (1, 2, 3) for name in ("force", "area")]
    axes = {"output_of": ("output", ["force", "area"] * 3), "step": ("output", [1, 1, 2, 2, 3, 3])}
    dataset = xr.Dataset(coords={"output": names, **axes})
    add(dataset, Finding("note", said))
    once_for_steps(dataset)
    assert findings(dataset) == [Finding("note", shorter)]


def test_what_is_said_of_several_outputs_is_said_once():
    said = "The error of {} is {}."
    texts = [said.format("press.x", 0.3), "Of press.x and y.", said.format("press.x.1", 0.4), said.format("y", 0.5)]
    expected = f"{texts[0]} The same, with other numbers, of y."
    assert once_for_outputs(texts, ("press.x", "y")) == [expected, texts[1], texts[2]]
    assert once_for_outputs(texts, ()) == texts
    assert once_for_outputs((), ("y",)) == []
