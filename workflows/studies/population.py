"""A study of a population: what the posteriors of specimens say on specimens in general.

Specimens whose draws do not reach the population are solved again, with a prior like it.
"""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import field_validator

from forward.findings import Finding
from forward.model import SolveError
from forward.settings import nearest
from inverse.data.files import distinct, files
from inverse.data.table import DataError
from inverse.methods.population import Columns, Population, Scale, prior_names
from uq.estimators.input_sample_error import findings_of_few
from uq.evaluation.evaluate import Steps
from uq.evaluation.kept import Kept
from uq.findings import once_for_outputs
from uq.inputs.draws import Draws
from uq.inputs.random_parameters import Inputs
from workflows.config.mistakes import StudyError
from workflows.config.study import parse
from workflows.results.posteriors import Left, draws_in
from workflows.run.from_python import FromPython
from workflows.studies.job import Job
from workflows.studies.study import StudyKind

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import xarray as xr

    from forward.scalars import Mistake
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from uq.evaluation.request import Evaluations
    from uq.evaluation.work_queue import Progress

GONE = (StudyError, ValueError, OSError)
KEPT = ("model", "data", "method", "candidates", "parameters", "correlations")  # blocks that a posterior depends on


class PopulationStudy(FromPython, StudyKind):
    """From what, and how, the distribution over specimens is found.

    Parameters
    ----------
    method
        What is computed and how.
    """

    stopped: ClassVar[str] = "a population"

    method: Population

    @field_validator("method")
    @classmethod
    def _begun(cls, method: Population) -> Population:
        """Keep the hash of the source, where it can be read."""
        with suppress(ValueError):  # `mistakes` says what is wrong with it
            return method if method.digest else method.model_copy(update={"digest": Left(method.source).digest})
        return method

    @cached_property
    def source(self) -> Left:
        """What the study of the specimens has left."""
        return Left(self.method.source)

    @cached_property
    def posteriors(self) -> dict[str, Draws]:
        """Draws of each specimen, by its name."""
        return self.source.specimens(self.method.model)

    @cached_property
    def of_specimens(self) -> Any:
        """The study of the specimens; an exception of `GONE` where it cannot be read any more."""
        from workflows.run.own_code import make_visible

        make_visible(self.source.path)
        return parse(self.source.blocks, folder=self.source.path)

    @property
    def planned(self) -> int:
        """One evaluation: none is solved, unless specimens are drawn again."""
        return 1

    @property
    def solves(self) -> int:
        return 0

    @property
    def findings(self) -> tuple[Finding, ...]:
        every = self.posteriors if Path(self.method.source).exists() else {}
        few = [found for name, draws in every.items() for found in findings_of_few(draws, name)]
        lost, count = self.source.lost if every else [], len(every)
        values = {"lost": len(lost), "of": count + len(lost), "specimens": ", ".join(lost)}
        blocks = self.source.blocks if every else {}
        if blocks.get("model_error") or blocks.get("data", {}).get("errors", {}).get("process"):
            few.append(Finding("population-model-error", "warning"))
        return (*once_for_outputs(few, every), *([Finding("population-without", "warning", values)] if lost else ()))

    def plan(self, rank_groups: int) -> list[str]:
        names = prior_names(self.posteriors)
        return [
            f"method      {self.method.kind}, {self.method.distribution}",
            f"source      {self.method.source}",
            f"specimens   {', '.join(self.posteriors)}",
            f"parameters  {', '.join(names)}",
            "solves      none, but for specimens whose draws do not reach the population",
        ]

    def parameters_of(self, label: str) -> tuple[str, ...]:
        return prior_names(self.posteriors)

    @cached_property
    def modules(self) -> tuple[str, ...]:
        with suppress(*GONE):
            found: tuple[str, ...] = self.of_specimens.modules
            return found
        return ()

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> Job:
        """Fit on the first rank, and draw specimens again on all of them where that is needed."""
        return PopulationJob(self, name, directory, told={"specimens": list(self.posteriors)})

    def units_of(self, label: str) -> dict[str, str]:
        """SI units of the parameters, as the study of the specimens has them; none where that is gone."""
        with suppress(*GONE):
            study = self.of_specimens
            label = self.source.candidate(self.method.model) if hasattr(study, "candidates") else "/"
            found: dict[str, str] = study.units_of(label)
            return found
        return {}

    def mistakes(self) -> Iterator[Mistake]:
        """Find what is wrong with the source, which is taken as it was when the study was begun."""
        method, place = self.method, ("method", "source")
        if method.digest and not Path(method.source).exists():  # results, which are looked at
            return
        try:
            Scale.of(method.distribution, self.posteriors)
            Columns.of(method.covariates, list(self.posteriors)).row(method.new)
            shared = self.source.shared(method.model, prior_names(self.posteriors))
            for name in method.own:
                if name not in shared:
                    yield ("method", "own"), f"is not uncertain in the source; {nearest(name, list(shared))}", name
            found = self.source.digest
        except (ValueError, StudyError) as error:
            yield place, str(error), method.source
            return
        if method.study is not None and not Path(method.study).is_file():
            message = "is not there, expected the file of the study that the source is of"
            yield ("method", "study"), message, method.study
        if method.digest and found != method.digest:
            yield place, f"has changed since the study was begun: hash {method.digest} → {found}", method.source


def of_one(study: PopulationStudy, specimen: str, prior: Inputs) -> StudyKind:
    """Return the study of a specimen, with another prior; a ValueError if there is none, or its data are not there."""
    method = study.method
    blocks = {key: value for key, value in study.source.blocks.items() if key in KEPT}
    parameters = {name: one.model_dump(mode="json") for name, one in prior.marginals.items()}
    correlations = [{"between": [a, b], "value": value} for a, b, value in prior.correlations]
    known = {"parameters": parameters, "correlations": correlations}
    folder = Path(method.source) if method.study is None else Path(method.study).parent
    if "candidates" in blocks:
        name = study.source.candidate(method.model)
        tests = [one for one in blocks["data"]["tests"] if one["group"] == specimen]
        blocks["candidates"] = {name: blocks["candidates"][name] | known}
        blocks["data"] = {**blocks["data"], "tests": tests}
        once = {"other_noises": {}, "subsets": {}, "held_out": False}
        blocks["method"] = {key: value for key, value in blocks["method"].items() if key != "check"} | once
    else:
        if set(parameters) != set(blocks.get("parameters", {})):
            raise ValueError("random fields are among the unknowns, whose distribution is that of the model")
        path = _file(blocks["data"], specimen, folder)
        data = {key: value for key, value in blocks["data"].items() if key not in {"files", "sets"}}
        blocks |= known | {"data": {**data, "files": [str(path)]}}
    return parse(blocks | {"parallel": study.parallel.model_dump()}, folder=folder)


def _file(data: dict[str, Any], specimen: str, folder: Path) -> Path:
    """Return the file of a data set, which has to be as it was; errors as of `of_one`."""
    from workflows.data.measured import digest_of as digest_of_file

    known = {one["name"]: one for one in data.get("sets", [])}
    where = "expected method.study, the file of the study that the source is of"
    if specimen not in known:
        raise ValueError(f"the data of {specimen} are in no file")
    try:
        paths = files(data["files"], [folder, Path()])
    except DataError:
        paths = []
    path = dict(zip(distinct(paths), paths, strict=True)).get(specimen)
    if path is None or not path.is_file():
        raise ValueError(f"{known[specimen]['file']} is not in {folder} or here, {where}")
    if digest_of_file(path) != known[specimen]["digest"]:
        raise ValueError(f"{path} has changed since {specimen} was inverted")
    return path.resolve()


@dataclass(frozen=True)
class PopulationJob(Job):
    """The fit of a population on the first rank, and specimens that all ranks draw again."""

    study: PopulationStudy
    name: str  # of the study
    directory: Path  # where results go
    solved: dict[str, Evaluations] = field(default_factory=dict)  # for specimens, by their names and how often it was

    @property
    def evaluations(self) -> dict[str, Evaluations]:
        return self.solved

    def run(self, ensemble: Ensemble, checkpoint: Checkpoint, progress: Progress, blocks: int) -> xr.Dataset | None:
        """Fit on rank 0; collective over all ranks."""
        from mpi4py import MPI

        method, drawn = self.study.method, list[str]()

        def again(specimen: str, prior: Inputs) -> tuple[Draws | None, str]:
            drawn.append(specimen)
            times = drawn.count(specimen)
            part = checkpoint.part(f"{specimen}, {times}")
            try:
                one = ensemble.together(lambda: of_one(self.study, specimen, prior))
                job = ensemble.together(lambda: one.job(ensemble, self.name, self.directory, part))
                found = job.run(ensemble, part, progress, blocks)
                if found is None:
                    return None, ""
                self.own.append(job.own_seconds)
                for label, solved in job.evaluations.items():
                    self.solved[f"{specimen}, {times}" if label == "/" else f"{specimen}, {times}/{label}"] = solved
                return draws_in(job.labelled(found), one.method.kind), ""
            except (ValueError, StudyError, SolveError) as error:
                return None, "; ".join(map(str, error.args))

        def task(asked: Callable[[tuple[str, Inputs]], tuple[Draws | None, str]]) -> xr.Dataset:
            posteriors = self.study.posteriors
            names, before, left = prior_names(posteriors), self.study.of_specimens, self.study.source
            whose = before.models[left.candidate(method.model)] if "candidates" in left.blocks else before
            prior = Inputs({name: whose.inputs.marginals[name] for name in names}, whose.inputs.correlations)
            asking = 0.0

            def timed(*one: Any) -> tuple[Draws | None, str]:
                nonlocal asking
                begun = time.process_time()
                found = asked(one)
                asking += time.process_time() - begun
                return found

            begin = time.process_time()
            shared = left.shared(method.model, names)
            fitted = method.run(posteriors, prior, timed, Steps(Kept(checkpoint, MPI.COMM_SELF, "steps")), shared)
            self.own.append(time.process_time() - begin - asking)
            return fitted

        return ensemble.led(task, lambda asked: again(*asked))
