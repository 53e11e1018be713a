"""When sections of a report apply."""

import pytest
import xarray as xr

from workflows.report.blocks import Text
from workflows.report.section import SECTIONS, Results, Section

pytestmark = pytest.mark.unit


class Needing(Section):
    """A section that needs a variable and a coordinate."""

    needs = ("sag", "output")

    def content(self, results):
        """Nothing of interest."""
        yield Text("")


def results_with(dataset):
    """Results that hold nothing else."""
    return Results(dataset, {}, None)


def test_a_section_applies_where_all_that_it_needs_is():
    values = xr.Dataset({"sag": ("output", [1.0])})
    assert Needing().applies(results_with(values.assign_coords(output=["u"])))
    assert not Needing().applies(results_with(values))  # no names of the outputs
    assert not Needing().applies(results_with(xr.Dataset(coords={"output": ["u"]})))


def test_sections_that_need_nothing_are_of_every_study():
    """Whoever adds a section that stands in every report adds it here."""
    always = {name for name in SECTIONS.own if not SECTIONS[name].needs and SECTIONS[name].applies is Section.applies}
    assert always == {"header", "answer", "failures", "run-time", "provenance"}
