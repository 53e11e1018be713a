"""Specimens of a population that are drawn again, under a prior like the population.

It is the study that they came from that runs, for one of its data sets or groups of data, with another prior.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from forward.model import SolveError
from forward.registry import named
from inverse.data.files import distinct, files
from inverse.data.table import DataError
from uq.inputs.draws import Draws
from uq.inputs.random_parameters import Inputs
from workflows.config.mistakes import StudyError
from workflows.studies.job import ArvizGroups, Job, Texts
from workflows.studies.posteriors import candidate_of, draws_in, prior_of, source_blocks

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import xarray as xr

    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from uq.evaluation.request import Evaluations
    from uq.evaluation.tasks import Outcome
    from uq.evaluation.turns import Progress
    from workflows.studies.population import PopulationStudy
    from workflows.studies.study import StudyKind

KEPT = ("model", "data", "method", "candidates", "parameters", "correlations")  # blocks that a posterior depends on


def of_one(study: PopulationStudy, specimen: str, prior: Inputs) -> StudyKind:
    """Return the study of a specimen of a population, with another prior.

    Raises
    ------
    ValueError
        If there is none, or its data are not there any more.
    """
    from workflows.config.study import parse

    method = study.method
    blocks = {key: value for key, value in source_blocks(method.source).items() if key in KEPT}
    parameters = {name: one.model_dump(mode="json") for name, one in prior.marginals.items()}
    correlations = [{"between": [a, b], "value": value} for a, b, value in prior.correlations]
    known = {"parameters": parameters, "correlations": correlations}
    folder = Path(method.source) if method.study is None else Path(method.study).parent
    if "candidates" in blocks:
        name = candidate_of(method.source, method.model)
        tests = [one for one in blocks["data"]["tests"] if one["group"] == specimen]
        blocks["candidates"] = {name: blocks["candidates"][name] | known}
        blocks["data"] = {**blocks["data"], "tests": tests}
        once = {"other_noises": {}, "subsets": {}, "held_out": False}
        blocks["method"] = {key: value for key, value in blocks["method"].items() if key != "check"} | once
    else:
        if set(parameters) != set(blocks.get("parameters", {})):
            message = "random fields are among the unknowns, whose distribution is that of the model"
            raise ValueError(message)
        path = _file(blocks["data"], specimen, folder)
        data = {key: value for key, value in blocks["data"].items() if key not in {"files", "sets"}}
        blocks |= known | {"data": {**data, "files": [str(path)]}}
    return parse(blocks | {"parallel": study.parallel.model_dump()}, folder=folder)


def _file(data: dict[str, Any], specimen: str, folder: Path) -> Path:
    """Return the file of a data set, which has to be as it was; errors as of `of_one`."""
    from workflows.studies.measured import digest_of

    known = {one["name"]: one for one in data.get("sets", [])}
    where = "expected method.study, the file of the study that the source is of"
    if specimen not in known:
        message = f"the data of {specimen} are in no file"
        raise ValueError(message)
    try:
        paths = files(data["files"], [folder, Path()])
    except DataError:
        paths = []
    path = dict(zip(distinct(paths), paths, strict=True)).get(specimen)
    if path is None or not path.is_file():
        message = f"{known[specimen]['file']} is not in {folder} or here, {where}"
        raise ValueError(message)
    if digest_of(path) != known[specimen]["digest"]:
        message = f"{path} has changed since {specimen} was inverted"
        raise ValueError(message)
    return path.resolve()


@dataclass(frozen=True)
class PopulationJob:
    """The fit of a population on the first rank, and specimens that all ranks draw again.

    Attributes
    ----------
    study, name, directory
        The study, its name, and where results go.
    evaluations
        What was solved for specimens, by their names and how often it was.
    own
        Processor time (s) of the fit, and of what each specimen took besides its solves.
    """

    study: PopulationStudy
    name: str
    directory: Path
    evaluations: dict[str, Evaluations] = field(default_factory=dict)
    own: list[float] = field(default_factory=list)

    @property
    def own_seconds(self) -> float:
        """Processor time (s) of the fit, and of what each specimen took besides its solves."""
        return sum(self.own)

    @property
    def labelled(self) -> Callable[[xr.Dataset], xr.Dataset]:
        """There is nothing to add."""
        return lambda found: found

    @property
    def arviz_groups(self) -> ArvizGroups:
        """There are none."""
        return lambda _: {}

    @property
    def texts(self) -> Texts:
        """There are none."""
        return lambda _: {}

    @property
    def outcomes(self) -> Sequence[Outcome]:
        """There are no tasks."""
        return ()

    def run(self, ensemble: Ensemble, checkpoint: Checkpoint, progress: Progress, blocks: int) -> xr.Dataset | None:
        """Fit on rank 0; collective over all ranks."""
        method, drawn = self.study.method, list[str]()

        def again(specimen: str, prior: Inputs) -> Draws | str:
            drawn.append(specimen)
            times = drawn.count(specimen)
            part = checkpoint.part(f"{specimen}, {times}")
            try:
                one = ensemble.together(lambda: of_one(self.study, specimen, prior))
                job = ensemble.together(lambda: one.job(ensemble, self.name, self.directory, part))
                found = job.run(ensemble, part, progress, blocks)
                if found is None:
                    return ""
                self._keep(job, f"{specimen}, {times}")
                return draws_in(job.labelled(found), one.method.kind)
            except (ValueError, StudyError, SolveError) as error:
                return "; ".join(map(str, error.args))

        def task(asked: Callable[[tuple[str, Inputs]], Draws | str]) -> xr.Dataset:
            posteriors = self.study.posteriors
            prior = prior_of(method.source, method.model, next(iter(posteriors.values())).names)
            asking = 0.0

            def timed(*one: Any) -> Draws | str:
                nonlocal asking
                begun = time.process_time()
                found = asked(one)
                asking += time.process_time() - begun
                return found

            begin = time.process_time()
            fitted = method.run(posteriors, prior, timed)
            self.own.append(time.process_time() - begin - asking)
            return fitted

        return ensemble.led(task, lambda asked: again(*asked))

    def _keep(self, job: Job, label: str) -> None:
        self.own.append(job.own_seconds)
        for part, found in job.evaluations.items():
            self.evaluations[label if part == "/" else f"{label}/{part}"] = found


def modules(study: PopulationStudy) -> tuple[str, ...]:
    """Return a user's modules of the models of the source."""
    source = _source(study)
    return () if source is None else source.modules


def units(study: PopulationStudy) -> dict[str, str]:
    """Return SI units of numbers of the model of the source, by their names there; none where it is gone."""
    source = _source(study)
    if source is None:
        return {}
    by_candidate = hasattr(source, "candidates")
    return source.units_of(candidate_of(study.method.source, study.method.model) if by_candidate else "/")


def _source(study: PopulationStudy) -> StudyKind | None:
    """Return the study that the source is of; None where that is gone."""
    from workflows.config.study import parse

    try:
        named("workflows.run.own_code:make_visible")(Path(study.method.source))
        return parse(source_blocks(study.method.source), folder=Path(study.method.source))
    except (StudyError, ValueError, OSError):
        return None
