"""A study that predicts with all candidates of a comparison, each with its own posterior, averaged by probability."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import ValidationError

from forward.findings import Finding
from forward.materials.material import constants
from forward.scalars import Mistake
from uq.estimators import failure_domain
from uq.estimators.averaged import averaged
from uq.evaluation.evaluate import Recorder
from uq.evaluation.request import Evaluate, Evaluations
from uq.findings import add
from workflows.config.blocks import STACKED
from workflows.config.mistakes import lines
from workflows.config.one_model import Source
from workflows.results.directory import label
from workflows.results.posteriors import NamedCandidate, candidates, read
from workflows.studies.job import Job, MethodJob
from workflows.studies.sampling import Study
from workflows.studies.sampling_job import with_errors_of_draws, with_unknown_meshes

if TYPE_CHECKING:
    import xarray as xr

    from forward.spec import ModelSpec
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from uq.inputs.draws import Draws

LEAST = 1e-3  # probability of candidates that are left out
AVERAGED_METHODS = ("monte-carlo", "sensitivity-monte-carlo", "quasi-monte-carlo", "chaos")


class AveragedStudy(Study):
    """The study of a body whose material is one of several, by the probabilities that a comparison has given them.

    The blocks are those of `Study`; `parameters.from` has ``model = "averaged"`` or, with weights of stacking in place
    of probabilities, ``"stacked"``; constants that candidates lack (D1) are those of the model's material.
    """

    source: Source

    @cached_property
    def candidates(self) -> tuple[NamedCandidate, ...]:
        """The candidates that are not improbable, with probabilities of sum 1."""
        every = candidates(self.source.file, "stacking" if self.source.model == STACKED else "probability")
        kept = [one for one in every if one.probability >= LEAST]
        total = sum(one.probability for one in kept)
        return tuple(one._replace(probability=one.probability / total, error=one.error / total) for one in kept)

    @cached_property
    def parts(self) -> dict[str, Study]:
        """The study of each candidate alone."""
        found = {}
        for one in self.candidates:
            blocks = self.model_dump(mode="json", exclude_none=True)
            drawn = read(self.source.file, self.source.group, one.name)
            means = zip((name.rpartition(".")[2] for name in drawn.names), drawn.weights @ drawn.values, strict=True)
            others, known = blocks["model"].get("material", {}) | dict(means), constants(str(one.material["kind"]))
            lacking = {key: float(value) for key, value in others.items() if key in known}
            blocks["model"]["material"] = lacking | dict(one.material)
            blocks["parameters"]["from"] |= {"model": one.name}
            blocks["accuracy"] = {"mesh_error": False}
            found[one.name] = Study.model_validate(blocks)
        return found

    @property
    def _first(self) -> Study:
        return next(iter(self.parts.values()))

    @cached_property
    def draws(self) -> Draws | None:
        """Those of the most probable candidate."""
        return self._first.draws

    @cached_property
    def spec(self) -> ModelSpec:
        """That of the most probable candidate."""
        return self._first.spec

    @property
    def planned(self) -> int:
        return sum(part.planned for part in self.parts.values())

    @property
    def estimates(self) -> int:
        return 0

    @property
    def specs(self) -> tuple[ModelSpec, ...]:
        return tuple(part.spec for part in self.parts.values())

    @property
    def findings(self) -> tuple[Finding, ...]:
        found = [one.of(f"Candidate '{name}'") for name, part in self.parts.items() for one in part.findings]
        if self.model.meshed:
            found.append(Finding("averaged-without-mesh", "note"))
        return tuple(found)

    def plan(self, rank_groups: int) -> list[str]:
        shares = ", ".join(f"{one.name} ({100 * one.probability:.3g} %)" for one in self.candidates)
        return [f"averaged    {shares}; below, the first", *self._first.plan(rank_groups)]

    def parameters_of(self, label: str) -> tuple[str, ...]:
        return self.parts[label].inputs.names

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> Job:
        """One model for each candidate, at the points of the method; collective over the group."""
        parts, recorders = self.parts, dict[str, Recorder]()

        def task(evaluate: Evaluate) -> xr.Dataset:
            found = {}
            for one, part in parts.items():
                recorders[one] = Recorder(evaluate if part is self._first else evaluate.on(one))
                found[one] = with_errors_of_draws(part, part.method.run(part.inputs, recorders[one]))
            p, errors = zip(*((one.probability, one.error) for one in self.candidates), strict=True)
            dataset = averaged(found, p, errors).assign_attrs(weights=str(self.source.model))
            shares = np.divide(dataset["between"], dataset["within"] + dataset["between"])  # which model it is
            pairs = zip(dataset.output.values, shares, strict=True)
            said = ", ".join(f"{output} {100 * float(share):.2g} %" for output, share in pairs)
            add(dataset, Finding("averaged-shares", "note", {"shares": said}))
            return dataset

        others = {one: partial(part.spec.build, ensemble.group, part.inputs.names) for one, part in parts.items()}
        model = others.pop(next(iter(parts)))()
        units = {output.name: output.unit for output in self.model.returned}
        space: Any = model.space if self.model.meshed else None
        mesh = () if space is None else (space.coordinates, *space.cells())
        of_outputs = {name: units[name] for name in model.outputs}

        def finished(found: xr.Dataset, evaluations: Mapping[str, Evaluations]) -> xr.Dataset:
            for one, several in evaluations.items():
                told = failure_domain.findings(parts[one].inputs, several, of_outputs, continued=False)
                add(found, *(finding.of(f"Candidate '{one}'") for finding in told))
            return with_unknown_meshes(self, found)

        told = {"candidates": {one.name: one.probability for one in self.candidates}}
        made = partial(MethodJob, model, others, task, recorders, finished=finished, told=told)
        return made(labelled=lambda found: label(found, units, *mesh))

    def mistakes(self) -> Iterator[Mistake]:
        place, said = ("parameters", "from"), self.source.model
        for what, wrong in (
            ("accuracy.tolerance", self.accuracy.tolerance is not None),
            ("model.adapt", self.model.unrefined),
            (f"method.kind = '{self.method.kind}'", self.method.kind not in AVERAGED_METHODS),
        ):
            if wrong:
                yield place, f"model = '{said}' does not go with {what}, expected a name of a candidate", said
                return
        try:
            _ = self.parts
        except ValidationError as error:
            for line in lines(error):
                yield place, f"of a candidate, {line}", said
        except ValueError as error:
            yield place, str(error), said
