"""A part of a report: when it applies, and what it shows. A report is all sections that apply, in their order.

The program's own are in `workflows.report.sections`, in the order of the page here; others come from a module beside
the study, which names them, or from an installed package, by an entry point ``section.NAME`` of the group ``tissuq``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from forward.external.own_modules import make_visible, refused
from forward.readable import NONE, and_error, margin, named, quantity, scale, size, spoken
from forward.registry import KindError, Kinds
from forward.settings import nearest
from uq.estimators.estimate import PARTS, holds, part, single
from uq.findings import DIGITS, NOT_KNOWN, meshes_unknown
from workflows.config.mistakes import StudyError
from workflows.report.blocks import Block, Heading, Level, Table
from workflows.results.summary import leading

if TYPE_CHECKING:
    import xarray as xr

    from workflows.config.blocks import Report

Content = Callable[["Results"], Iterator[Block]]
DRAWN = 24  # outputs with pictures
ROWS = 40  # parameters from which on a table is in the order of their effects
_HERE = "workflows.report.sections"


@dataclass(frozen=True)
class Results:
    """The contents of a results directory (None for results in memory): results.nc, and summary.json.

    The study is of any kind: a section that applies to the results knows which.
    """

    dataset: xr.Dataset
    summary: Mapping[str, Any]
    study: Any
    directory: Path | None = None

    @property
    def outputs(self) -> list[str]:
        """Names of the outputs."""
        return [str(name) for name in self.dataset["output"].values]

    @property
    def asked(self) -> list[str]:
        """Names of the outputs that are asked for: along a path, those of the last step."""
        step = self.dataset.coords.get("step")
        return self.outputs if step is None else [str(name) for name in step["output"][step == step.max()].values]

    @property
    def drawn(self) -> list[str]:
        """Names of those with pictures of their own: of many, those that vary most."""
        return leading(self.dataset, self.asked, DRAWN)

    @property
    def parameters(self) -> list[str]:
        """Names of the parameters."""
        return [str(name) for name in self.dataset["parameter"].values]

    def leading(self, effects: xr.DataArray) -> list[str]:
        """Names of the parameters; of many, those with the largest effects (parameter,) first."""
        if len(self.parameters) <= ROWS:
            return self.parameters
        return [str(name) for name in effects["parameter"].to_numpy()[(-abs(effects)).argsort().to_numpy()]]

    def of(self, output: str) -> xr.Dataset:
        """What is known of an output: all variables, those without outputs too."""
        return self._of_outputs[output]

    @cached_property
    def _of_outputs(self) -> dict[str, xr.Dataset]:
        return {output: self.dataset.sel(output=output) for output in self.outputs}

    @cached_property
    def meshes_unknown(self) -> dict[str, bool]:
        """Outputs whose error of the mesh is not known, and whether its estimates have failed."""
        return meshes_unknown(self.dataset)

    def value(self, output: str, value: float, error: float) -> str:
        """Write a value of an output to the place of its error, or to few digits where estimates of its mesh failed."""
        unit = self.unit(output)
        return size(value, unit, DIGITS) if self.meshes_unknown.get(output) else quantity(value, error, unit)

    def estimate(self, output: str, name: str) -> str:
        """One estimate of an output with its error and unit."""
        (value, error, *_), unit = single(self.of(output), name), self.unit(output)
        if np.isnan(value) or output not in self.meshes_unknown or name.endswith("corrected"):
            return NONE if np.isnan(value) else and_error(value, error, unit)
        if self.meshes_unknown[output]:
            return f"{size(value, unit, DIGITS)} (sampling ± {margin(error, unit, like=value)}, {NOT_KNOWN})"
        return f"{and_error(value, error, unit)} ({NOT_KNOWN})"

    def estimates(self, words: Mapping[str, str]) -> Table:
        """Write estimates of all outputs, a column of each by what it is called."""
        rows = [(output, *(self.estimate(output, name) for name in words)) for output in self.outputs]
        return Table(("output", *words.values()), rows)

    def cells(self, names: Iterable[str], at: Mapping[str, str], unit: str = "1") -> Iterator[str]:
        """Write estimates somewhere, each followed by the one with the error of the mesh added where there are such."""
        for name in names:
            held = [which for which in PARTS if holds(self.dataset, name, which)]
            one = single(self.dataset[[name, *(part(name, which) for which in held)]].sel(at), name)
            yield and_error(one.value, one.error, unit)
            if "corrected" in held:
                yield NONE if np.isnan(one.corrected) else and_error(one.corrected, one.left, unit)

    def heads(self, words: Mapping[str, str]) -> Iterator[str]:
        """Write what `cells` are of, by the names of the estimates."""
        for name, word in words.items():
            yield from (word, f"{word}, corrected") if holds(self.dataset, name, "corrected") else (word,)

    def unit(self, output: str) -> str:
        """SI unit of an output."""
        return str(self.of(output)["unit"].item())

    def parameter_unit(self, path: str, label: str = "/") -> str:
        """SI unit of a number of the model of some evaluations, by its path; "1" for other names."""
        return str(self.study.units_of(label).get(path, "1"))

    def columns(self, usual: xr.DataArray) -> dict[str, tuple[float, str]]:
        """Return by parameter what one of the unit of its column is in the SI unit, and its head, for usual values."""
        each = {str(path): float(value) for path, value in zip(usual["parameter"].values, usual, strict=True)}
        found = {path: scale(value, self.parameter_unit(path)) for path, value in each.items()}
        return {path: (one, named(spoken(path), unit)) for path, (one, unit) in found.items()}


def written(of: Mapping[Any, Any], name: str, unit: str = "1") -> str:
    """Write one estimate and its error of sampling, in a unit if it has one."""
    one = single(of, name)
    return and_error(one.value, one.error, unit)


class Section(ABC):
    """A part of a report, with the variables of results that it `needs`: without them there is nothing to say.

    One from outside is placed `before` a section of the program.
    """

    before: ClassVar[str] = "failures"
    needs: ClassVar[tuple[str, ...]] = ()

    def applies(self, results: Results) -> bool:
        """Whether there is something to say about these results: with all that it needs, if not said otherwise."""
        return set(self.needs) <= set(results.dataset.variables)

    @abstractmethod
    def content(self, results: Results) -> Iterator[Block]:
        """Headings, sentences, tables and pictures, from top to bottom."""


def section(
    *needs: str, heading: str = "", level: Level = 2, when: Callable[[Results], bool] | None = None
) -> Callable[[Content], type[Section]]:
    """Make a section of a function from results to blocks, under a heading if that is always the same.

    It applies to results that hold the variables that it `needs`, `when` that is so.
    """

    def made(content: Content) -> type[Section]:
        def whole(_: Section, results: Results) -> Iterator[Block]:
            if heading:
                yield Heading(heading, level)
            yield from content(results)

        members: dict[str, Any] = {"__doc__": content.__doc__, "__module__": content.__module__, "needs": needs}
        members["content"] = whole
        if when is not None:
            members["applies"] = lambda self, results: Section.applies(self, results) and when(results)
        return type(content.__name__, (Section,), members)

    return made


SECTIONS = Kinds(
    "section",
    {
        "header": f"{_HERE}.frame:header",
        "answer": f"{_HERE}.answer:answer_first",
        "findings": f"{_HERE}.frame:findings",
        "body": f"{_HERE}.bodies:body",
        "curves": f"{_HERE}.selection:curves",
        "tolerance": f"{_HERE}.errors:tolerance",
        "error-budget": f"{_HERE}.errors:error_budget",
        "synthetic-data": f"{_HERE}.inversions:synthetic_data",
        "design": f"{_HERE}.inversions:chosen_observations",
        "reduced": f"{_HERE}.cost:reduced_model_of_body",
        "evidences": f"{_HERE}.selection:evidences",
        "path": f"{_HERE}.bodies:curve",
        "error-against-cost": f"{_HERE}.cost:error_against_cost",
        "distribution": f"{_HERE}.outputs:distribution",
        "density": f"{_HERE}.outputs:density",
        "sobol": f"{_HERE}.outputs:sobol_indices",
        "shapley": f"{_HERE}.outputs:shapley_effects",
        "sobol-field": f"{_HERE}.outputs:sobol_field",
        "derivative-based": f"{_HERE}.outputs:derivative_based",
        "contact": f"{_HERE}.bodies:contact",
        "local-sensitivities": f"{_HERE}.outputs:local_sensitivities",
        "local-field": f"{_HERE}.outputs:local_field",
        "not-random": f"{_HERE}.assumptions:not_random",
        "batch": f"{_HERE}.inversions:batch",
        "predictions": f"{_HERE}.inversions:predictions",
        "posterior": f"{_HERE}.posterior:posterior",
        "posterior-field": f"{_HERE}.posterior:field_posterior",
        "taken-for-granted": f"{_HERE}.assumptions:taken_for_granted",
        "questions": f"{_HERE}.assumptions:questions_to_shape",
        "places": f"{_HERE}.bodies:places",
        "finer-meshes": f"{_HERE}.errors:finer_meshes",
        "dependence": f"{_HERE}.selection:dependence",
        "criticism": f"{_HERE}.selection:criticism",
        "held-out": f"{_HERE}.selection:held_out",
        "averages": f"{_HERE}.selection:averages",
        "constants": f"{_HERE}.selection:constants",
        "population": f"{_HERE}.inversions:population_of_specimens",
        "candidates": f"{_HERE}.selection:averaged_candidates",
        "moments": f"{_HERE}.outputs:moments",
        "control-variate": f"{_HERE}.outputs:control_variate",
        "total-errors": f"{_HERE}.outputs:total_errors",
        "quantiles": f"{_HERE}.outputs:quantiles",
        "nominal": f"{_HERE}.outputs:nominal",
        "meshes": f"{_HERE}.errors:meshes",
        "fidelities": f"{_HERE}.cost:fidelities",
        "expansion": f"{_HERE}.outputs:expansion",
        "levels": f"{_HERE}.cost:levels",
        "adapted-mesh": f"{_HERE}.errors:adapted_mesh",
        "model": f"{_HERE}.frame:model",
        "priors": f"{_HERE}.frame:priors",
        "failures": f"{_HERE}.frame:failures",
        "run-time": f"{_HERE}.frame:run_time",
        "provenance": f"{_HERE}.frame:provenance",
    },
    Section,
)


def of_study(report: Report | None) -> dict[str, Section]:
    """Import the sections that a study asks for, as far as they may run here.

    Raises
    ------
    StudyError
        If one of them does not exist, or names a `before` that does not; the message says where it was searched.
    """
    if report is None:
        return {}
    make_visible(report.modules, [Path(report.folder), Path.cwd()], "report.sections")
    found: dict[str, Section] = {}
    for name in report.sections:
        if refused(name.rpartition(".")[0]):
            continue
        try:
            found[name] = SECTIONS[name]()
        except KindError as error:
            where = f"{name.partition('.')[0]}.py in {report.folder}"
            raise StudyError(f"report.sections: {error}; expected in {where}, or in an installed package") from None
        if found[name].before not in SECTIONS.own:
            known = nearest(found[name].before, tuple(SECTIONS.own))
            message = f"report.sections: '{name}' has before = '{found[name].before}', which is not a section; {known}"
            raise StudyError(message)
    return found


def sections(report: Report | None = None) -> list[tuple[str, Section]]:
    """Return all sections by name, in the order of the page, with those of a study; errors as of `of_study`."""
    others = {name: SECTIONS[name]() for name in SECTIONS.names if name not in SECTIONS.own} | of_study(report)
    placed: list[tuple[str, Section]] = []
    for name in SECTIONS.own:
        placed += [(label, other) for label, other in others.items() if other.before == name]
        placed.append((name, SECTIONS[name]()))
    return placed
