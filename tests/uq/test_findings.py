"""What a study says of the worth of its own numbers: kept with the results, and in the exit code."""

import pytest
import xarray as xr

from forward.model import Finding
from uq.findings import add, findings
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
