"""What a study says of the worth of its own numbers: kept with the results, and in the exit code."""

import pytest
import xarray as xr

from forward.model import Finding
from uq.findings import add, findings, once_for_steps
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
