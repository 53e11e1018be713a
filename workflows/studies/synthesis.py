"""Studies that make synthetic data: a known specimen is solved, and measured with errors."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping
from contextlib import redirect_stderr, redirect_stdout
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
import tomli_w
from numpy.typing import NDArray
from pydantic import Field, model_validator

from forward.bodies.geometry import AXES
from forward.bodies.inclusions import log_factor
from forward.registry import named
from forward.scalars import Mistake
from forward.specimen import Specimen
from inverse.data.observations import kinds
from inverse.methods.synthesize import Synthesize
from uq.evaluation.evaluate import Recorder
from uq.inputs.distributions import Distribution, Normal
from uq.inputs.random_parameters import Inputs
from workflows.config.blocks import Correlation, Parallel
from workflows.config.mistakes import refused
from workflows.config.priors import mistakes_of_priors, ranges
from workflows.config.report import Report
from workflows.studies.job import MethodJob
from workflows.studies.predictions import duration, formulation, times_of
from workflows.studies.study import StudyKind, measures_outputs
from workflows.studies.synthetic_surfaces import facets_among, surfaces

if TYPE_CHECKING:
    import xarray as xr

    from forward.fem.specimen import SpecimenModel
    from forward.model import Finding, FloatArray
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from uq.evaluation.request import Evaluate


class SynthesisStudy(StudyKind):
    """Synthetic data of a known model.

    Parameters
    ----------
    parameters
        Distributions of numbers that are drawn for each data set; coefficients of random fields always are.
    correlations
        Correlations between them.
    method
        Errors, and the points that data sets have.
    parallel
        Use of ranks.
    report
        Your own sections of the report.
    """

    stopped: ClassVar[str] = "all data made"
    explains: ClassVar[bool] = False

    parameters: dict[str, Distribution] = Field(default={})
    correlations: tuple[Correlation, ...] = ()
    method: Synthesize
    parallel: Parallel = Parallel()
    report: Report | None = None

    if TYPE_CHECKING:  # a field of every kind

        @property
        def model(self) -> Any:
            """What is measured."""

    @classmethod
    def forms(cls) -> Iterator[type[StudyKind]]:
        """Displacements of a specimen, and outputs."""
        yield Synthesis
        yield named("workflows.studies.output_synthesis:OutputSynthesis")

    @classmethod
    def made(cls, blocks: Mapping[str, Any], folder: Path) -> SynthesisStudy:
        """Check the blocks of a study that measures displacements of a specimen, or outputs of any model."""
        if measures_outputs(blocks.get("model")):
            other: type[SynthesisStudy] = named("workflows.studies.output_synthesis:OutputSynthesis")
            return other.model_validate(blocks)
        return Synthesis.model_validate(blocks)

    @cached_property
    def inputs(self) -> Inputs:
        """What is drawn for each data set."""
        standard = dict.fromkeys(self.model.coefficients, Normal(mean=0.0, std=1.0))
        return Inputs(self.parameters | standard, tuple((*c.between, c.value) for c in self.correlations))

    @property
    def planned(self) -> int:
        """Number of solves."""
        return len(self.method.fraction) + 1

    def parameters_of(self, label: str) -> tuple[str, ...]:
        """Names of what is drawn."""
        return self.inputs.names

    @model_validator(mode="after")
    def _check(self) -> Self:
        refused(type(self).__name__, list(self._mistakes()))
        return self

    def _mistakes(self) -> Iterator[Mistake]:
        yield from self.model.mistakes_of_mesh()
        for i, field in enumerate(getattr(self.model, "fields", ())):
            if field.basis == "nodes":
                message = "values at the vertices are not independent, expected 'modes' or 'noise'"
                yield ("model", "fields", i, "basis"), message, field.basis
        yield from mistakes_of_priors(self.model, self.parameters, self.correlations, lambda: self.inputs)


class Synthesis(SynthesisStudy):
    """What synthetic displacements to make.

    Parameters
    ----------
    model
        The specimen to be measured, with its observations.
    parameters, correlations, method, parallel, report
        As of `SynthesisStudy`.
    """

    model: Specimen

    @cached_property
    def specimen(self) -> Specimen:
        """The specimen, in the formulation that suits all values of its parameters."""
        specimen: Specimen = self.model.over(ranges(self.parameters))
        return specimen

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about the specimen before anything is solved."""
        return (*self.model.findings, *self.model.locking(ranges(self.parameters)))

    def stiffness(self, places: FloatArray, points: FloatArray) -> FloatArray:
        """Return ln of the factor (n, k) of the inclusions on the stiffness at places (k, 3) and parameters (n, d)."""
        return log_factor(self.model.inclusions, self.inputs.names, points, places)

    @property
    def specs(self) -> tuple[Specimen, ...]:
        """The specimen."""
        return (self.model,)

    def plan(self, rank_groups: int) -> list[str]:
        """Say what is made, and how long that will take."""
        return plan(self)

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> MethodJob:
        """Make the specimen; collective."""
        return job(self, ensemble, name)

    def _mistakes(self) -> Iterator[Mistake]:
        if not self.model.observed and not any(case.outputs for case in self.model.cases):
            message = "nothing is observed, expected boundaries or points, or outputs of load cases"
            yield ("model", "observed"), message, ()
        if self.method.format != "csv" and any(case.outputs for case in self.model.cases):
            message = "outputs of load cases are written to tables, expected 'csv'"
            yield ("method", "format"), message, self.method.format
        if self.method.format == "stl":
            yield from self._mistakes_of_surfaces()
        yield from super()._mistakes()

    def _mistakes_of_surfaces(self) -> Iterator[Mistake]:
        """Find what pairs of surfaces cannot hold."""
        method = self.method
        if not any(item.on is not None for item in self.model.observed):
            yield ("model", "observed"), "surfaces are of boundaries, expected { on = ... }", ()
        if method.missing > 0 or min(method.fraction) < 1:
            yield ("method", "format"), "surfaces have all their points, expected fraction = 1 and missing = 0", "stl"
        if method.noise.absolute is None:
            message = "one standard deviation is stated of all surfaces, expected absolute errors"
            yield ("method", "noise"), message, method.noise.model_dump(exclude_none=True)


def head(study: SynthesisStudy) -> str:
    """Return the first line of a file: of what the data are."""
    noise = study.method.noise.model_dump(exclude_none=True)
    errors = f"errors {', '.join(f'{key} {value:g}' for key, value in noise.items())}, seed {study.method.seed}"
    body = getattr(study.model, "body", None)
    if body is None:
        return f"# Synthetic: {study.model.description}, {errors}.\n"
    return f"# Synthetic: {body.cells_in_words} cells ({body.cell}, degree {body.degree}), {errors}.\n"


def _with_values(inclusion: Any, values: Mapping[str, float]) -> dict[str, Any]:
    """An inclusion with changed numbers, by their paths."""
    block: dict[str, Any] = inclusion.model_dump()
    return {key: values.get(f"inclusions.{inclusion.label}.{key}", value) for key, value in block.items()}


def points_of(model: SpecimenModel) -> NDArray[np.int64]:
    """Number (m,) of the point at which each output of a specimen is observed, the same in all load cases.

    It is -1 of outputs that are measured at no point.
    """
    found, at = np.full(len(model.axes), -1), model.axes < len(AXES)
    found[at] = np.unique(np.round(model.places[at], 12), axis=0, return_inverse=True)[1].ravel()
    return found


def with_factor(study: Synthesis, found: xr.Dataset, places: FloatArray, fields: Any) -> xr.Dataset:
    """Add the true factor on the stiffness at places (k, 3) of each data set, as rows x, y, z, factor.

    Parameters
    ----------
    fields
        Factors (n, k) of the random fields on the stiffness, all together.
    """
    points = found["truth"].to_numpy()
    factor = fields * np.exp(study.stiffness(places, points))
    table = np.concatenate([np.broadcast_to(places, (len(points), *places.shape)), factor[:, :, None]], axis=2)
    return found.assign(factor=(("data_set", "place", "axis"), table))


def synthetic_files(study: Synthesis, name: str, found: xr.Dataset, model: Any) -> dict[str, str]:
    """Return the texts of the files of synthetic data, by their names."""
    texts = {}
    points, cases, axes, places = model
    rigid = study.method.motion
    frame = (places - rigid.shift) @ rigid.rotation  # where the scanner sees them
    count = found.sizes["data_set"]
    scalars = {path: scalar.value for path, scalar in study.model.scalars.items()}
    varies = [
        path
        for path in scalars
        if path.startswith(("inclusions.", "material.", "regions.")) or path in study.parameters
    ]
    for k in range(count):
        one = found.isel(data_set=k)
        truth = scalars | dict(zip(map(str, found.parameter.values), one["truth"].values.tolist(), strict=True))
        label = name if count == 1 else f"{name}-{k + 1}"
        file = io.StringIO()
        file.write(head(study))
        file.writelines(f"# truth.{path} = {truth[path]!r}\n" for path in varies)
        if study.model.inclusions and not study.model.fields:
            inclusions = [_with_values(inclusion, truth) for inclusion in study.model.inclusions]
            file.write(f"# truth.inclusions = {json.dumps(inclusions)}\n")
        if study.model.fields:
            file.write(f"# truth.stiffness = truth/{label}.csv\n")
            lines = (",".join(f"{x:.6g}" for x in row) for row in one["factor"].values)
            texts[f"truth/{label}.csv"] = "x,y,z,factor\n" + "\n".join(lines) + "\n"
        method, unit = study.method, study.method.metres
        values, sigma = one["values"].values / unit, one["sigma"].values / unit
        if method.format != "csv":
            arrays = _arrays(study, values, sigma, (points, cases, axes))
            truths = {path: truth[path] for path in varies}
            texts |= _described(study, label, (places, frame / unit), arrays, truths)
            continue
        said = "" if method.units == "m" else f" [{method.units}]"
        heads = [f"{head}{said}" for head in ("x", "y", "z", "ux", "uy", "uz", "sigma")]
        apart = points < 0  # outputs of load cases, in units of their own
        more = ["output", "value", "sigma_value"] if apart.any() else []
        file.write(",".join([*heads, "case", *more] if not apart.all() else ["case", *more]) + "\n")
        for case, case_name in enumerate(c.name for c in study.model.cases):
            for point in np.unique(points[(cases == case) & (points >= 0)]):
                rows = np.flatnonzero((cases == case) & (points == point) & np.isfinite(values))
                if len(rows) == 0:
                    continue
                motion = {int(axes[row]): f"{values[row]:.6e}" for row in rows}
                where = ",".join(f"{x:.8g}" for x in np.round(frame[rows[0]] / unit, 12) + 0.0)
                cells = ",".join(motion.get(axis, "") for axis in range(3))
                file.write(f"{where},{cells},{sigma[rows[0]]:.4e},{case_name}{',' * len(more)}\n")
            names = tuple(output.name for output in study.model.cases[case].outputs)
            for row in np.flatnonzero((cases == case) & apart):
                output, empty = names[axes[row] - len(AXES)], "" if apart.all() else "," * len(heads)
                value, error = (float(one[key].values[row]) for key in ("values", "sigma"))
                file.write(f"{empty}{case_name},{output},{value:.8g},{error:.4e}\n")
        texts[f"{label}.csv"] = file.getvalue()
    return texts


def _described(
    study: Synthesis,
    label: str,
    where: tuple[FloatArray, FloatArray],
    arrays: dict[str, NDArray[Any]],
    truth: Mapping[str, float],
) -> dict[str, str]:
    """Return the texts of a cloud, or of surfaces, and of the file in TOML that says what they are.

    Parameters
    ----------
    label
        With which names begin.
    where
        Places (m, 3) of all outputs on the body (m), and in the unit and the frame of the files.
    arrays
        As of `_arrays`, in the unit of the files.
    truth
        What is known, by path.
    """
    method, number = study.method, arrays.pop("number")
    on_body, places = (one[number] for one in where)
    if method.format == "stl":
        motions = {case.name: arrays[f"displacement_{case.name}"] for case in study.model.cases}
        more = {"units": method.units, "sigma": method.noise.absolute, "truth": truth}
        return surfaces(label, places, motions, facets_among(study.specimen.body, on_body), more)
    file = f"{label}.{method.format}"
    said = tomli_w.dumps({"file": file, "units": method.units, "truth": truth})
    return {file: _cloud(places, arrays, method.format), f"{label}.toml": said}


def _arrays(
    study: Synthesis, values: FloatArray, sigma: FloatArray, where: tuple[NDArray[np.int64], ...]
) -> dict[str, NDArray[Any]]:
    """Return displacements of each load case at the points of a cloud, their errors, and `number`, a row of each."""
    points, cases, axes = where
    measured = np.unique(points[np.isfinite(values)])
    number = np.array([np.flatnonzero(points == point)[0] for point in measured])
    found: dict[str, NDArray[Any]] = {"number": number}
    for case, name in enumerate(one.name for one in study.model.cases):
        rows = np.flatnonzero((cases == case) & np.isin(points, measured))
        motion, errors = np.full((len(measured), 3), np.nan), np.full(len(measured), np.nan)
        at = np.searchsorted(measured, points[rows])
        motion[at, axes[rows]] = values[rows]
        errors[at] = sigma[rows]
        if study.method.format == "ply":
            found |= {f"u{axis}_{name}": motion[:, k] for k, axis in enumerate("xyz")} | {f"sigma_{name}": errors}
        else:
            found |= {f"displacement_{name}": motion, f"sigma_{name}": errors}
    return found


def _cloud(places: FloatArray, arrays: Mapping[str, NDArray[Any]], form: str) -> str:
    """Return the text of a file with points (n, 3) and arrays at them."""
    import meshio

    mesh = meshio.Mesh(places, [("vertex", np.arange(len(places))[:, None])], point_data=dict(arrays))
    if form == "ply":
        mesh.cells = []
    how: dict[str, Any] = {"data_format": "XML"} if form == "xdmf" else {"binary": False}
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"cloud.{form}"
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):  # that text takes more room
            meshio.write(path, mesh, **how)
        return path.read_text(encoding="utf-8")


def job(study: Synthesis, ensemble: Ensemble, name: str) -> MethodJob:
    """The known specimen; collective over the group."""
    model = study.specimen.build(ensemble.group, study.inputs.names)
    places, points = model.space.coordinates, points_of(model)
    if study.method.frame is not None:  # components along the axes of the scanner
        along = study.method.motion.rotation.T[model.axes]
        model = model.observing(model.places, model.axes.tolist(), model.cases.tolist(), along)
    factor = np.ones((len(study.method.fraction), 1))
    if study.model.fields and ensemble.index == 0:
        drawn = model.space.factors(study.method.truths(study.inputs))
        for one in (random for random in study.model.fields if random.of == "stiffness" and ensemble.group.rank == 0):
            factor = factor * drawn[one.label]
    recorders: dict[str, Recorder] = {}

    def task(evaluate: Evaluate) -> xr.Dataset:
        recorders["/"] = Recorder(evaluate)
        groups = np.where(points < 0, len(model.models) + kinds(model.cases, model.axes), model.cases)
        return study.method.run(study.inputs, recorders["/"], groups, points)

    def texts(found: xr.Dataset) -> dict[str, str]:
        made = synthetic_files(study, name, found, (points, model.cases, model.axes, model.places))
        return {f"data/{file}": text for file, text in made.items()}

    labelled = partial(with_factor, study, places=places, fields=factor)
    return MethodJob(model, {}, task, recorders, labelled, texts=texts)


def plan(study: Synthesis) -> list[str]:
    """Say what is made, and how long that will take."""
    spec, sets = study.specimen, len(study.method.fraction)
    seconds = sets * sum(times_of(spec.loaded(case)).textbook for case in spec.cases)
    return [
        f"method      {study.method.kind}",
        *(f"{what:10}  {found}" for what, found in spec.body.listed.items()),
        f"load cases  {', '.join(case.name for case in spec.cases)}, of {spec.unknowns:,} unknowns each",
        formulation(study.model.decision(ranges(study.parameters))),
        f"data sets   {sets}",
        f"time        about {duration(seconds)} on 1 core (rough)",
    ]
