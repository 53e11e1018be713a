"""What results can do besides being an xarray dataset: ``data.tissuq``."""

from __future__ import annotations

import html
from collections.abc import Iterator
from functools import cached_property
from typing import Any

import xarray as xr

from forward.errors import Error, UnknownError
from forward.settings import nearest
from workflows.report.blocks import Block, Picture, Pictures
from workflows.report.page import TOP, Parts, parts_of, render, results_in
from workflows.report.section import Results, sections
from workflows.results.directory import body_grid, with_units

# What the answers of a study are, the first that its results hold; what has the same dimensions stands beside it.
ANSWERS = ("probability", "mean", "new_quantiles", "candidate_information", "values", "nominal", "reduced_error")
OF_RUN = ("header", "failures", "run-time", "provenance")  # sections that only a directory has
LATER = (*TOP, "tolerance", "error-budget")  # whose pictures are not the first that one looks for
HEIGHT = 640  # pixels of a page in a notebook


class Shown:
    """Parts of a report: a page in a notebook, lines elsewhere."""

    def __init__(self, title: str, parts: Parts) -> None:
        self.title, self.parts = title, parts

    def __repr__(self) -> str:
        """What a terminal shows of them."""
        return "\n".join(line for _, blocks in self.parts for block in blocks for line in block.lines)

    def _repr_html_(self) -> str:
        """A page in the page, whose styles and scripts do not meet those around it."""
        page = html.escape(render(self.title, self.parts))
        return f'<iframe srcdoc="{page}" style="width: 100%; height: {HEIGHT}px; border: 0"></iframe>'


@xr.register_dataset_accessor("tissuq")  # type: ignore[no-untyped-call]
class Accessor:
    """Results of a study: what they say, and the same for other libraries."""

    def __init__(self, dataset: xr.Dataset) -> None:
        self._dataset = dataset

    @cached_property
    def _results(self) -> Results:
        return results_in(self._dataset)

    def _parts(self, names: tuple[str, ...] = ()) -> Iterator[tuple[str, list[Block]]]:
        """Make sections that apply: those with names, or all."""
        known = {name: one for name, one in sections() if name not in OF_RUN or "failed" in self._results.summary}
        for name in names:
            if name not in known:
                raise UnknownError(f"'{name}' is no section of the report; {nearest(name, tuple(known))}")
        for name in names or sorted(known, key=lambda name: name in LATER):
            yield from parts_of(self._results, [(name, known[name])])[0]

    def show(self, *names: str) -> Shown:
        """Show answers with their errors, findings, and the body to turn; or the sections of a report that are named.

        Raises
        ------
        UnknownError
            If there is no such section.
        """
        return Shown(str(self._results.summary["study"]), list(self._parts(names or TOP)))

    def plot(self, name: str = "") -> Picture:
        """Return the first picture of a section of the report, by default of the first that has one.

        `tissuq.plots` has each as a function, which returns axes.

        Raises
        ------
        UnknownError
            If there is no such section, or no picture in it.
        """
        for _, blocks in self._parts((name,) if name else ()):
            for block in (inner for outer in blocks for inner in outer.whole()):
                if isinstance(block, Pictures) and block.items:
                    return block.items[0]
        raise UnknownError(f"no picture in {f'the section {name!r}' if name else 'the report'} of these results")

    def to_pandas(self) -> Any:
        """Return a data frame of the answers with their errors: a row for each output, parameter, model, ..."""
        name = next((one for one in ANSWERS if one in self._dataset), None)
        if name is None:
            raise Error(f"no answers in these results, expected one of: {', '.join(ANSWERS)}")
        dims = self._dataset[name].dims
        return self._dataset[[str(k) for k, one in self._dataset.data_vars.items() if one.dims == dims]].to_dataframe()

    def to_arviz(self) -> Any:
        """Return prior, posterior, likelihood of each datum, and data, as arviz.InferenceData."""
        import arviz

        groups = self._results.study.arviz_groups(self._dataset)
        if not groups:
            raise Error(f"no posterior in results of '{self._dataset.attrs['method']}', expected 'invert' or 'select'")
        return arviz.InferenceData(**groups)

    def to_pyvista(self) -> Any:
        """Return the undeformed body with the fields of the results, their units in their names, as a pyvista grid."""
        import pyvista

        one = self._dataset.squeeze("data_set") if self._dataset.sizes.get("data_set") == 1 else self._dataset
        if "cell_nodes" not in one or "data_set" in one.dims:
            raise Error("no body, or several, in these results; one of several: data.isel(data_set=0)")
        grid = with_units(body_grid(one), self._results.study.units_of("/"))
        found = pyvista.UnstructuredGrid({grid.kind: grid.cells}, grid.points)
        found.point_data.update(dict(grid.point_data))
        found.cell_data.update(dict(grid.cell_data))
        return found
