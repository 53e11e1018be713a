"""Studies that make synthetic data: a known model is solved, and measured with errors; files say what is true."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple

import numpy as np
import tomli_w
from numpy.typing import NDArray

from forward.bodies.geometry import AXES, Body
from forward.bodies.inclusions import log_factor
from forward.bodies.surface import Surface
from forward.scalars import Mistake
from forward.spec import MEASURED, ModelSpec
from inverse.data.measurements import Measurements, kinds
from inverse.data.outputs import steps_of
from inverse.methods.synthesize import Synthesize
from uq.evaluation.evaluate import Recorder
from workflows.config.one_model import OneModel
from workflows.config.priors import ranges
from workflows.run.from_python import FromPython
from workflows.studies.job import MethodJob
from workflows.studies.study import StudyKind, duration

if TYPE_CHECKING:
    import xarray as xr

    from forward.fem.joined import SpecimenModel
    from forward.findings import Finding
    from forward.model import FloatArray
    from forward.specimen import Specimen
    from uq.evaluation.checkpoint import Checkpoint
    from uq.evaluation.ensemble import Ensemble
    from uq.evaluation.request import Evaluate

OF_TRUTH = ("inclusions.", "material.", "regions.")  # numbers that files state in any case
SAME = 12  # decimals (m) of places that are the same


class Synthesis(OneModel, FromPython, StudyKind):
    """What synthetic data to make: displacements of a specimen, or outputs of any other model.

    Parameters
    ----------
    model
        The specimen to be measured, with its observations; or another model, whose outputs are measured. Errors that
        are relative are so to the root mean square of an output over its steps; data sets have a share of the steps.
    parameters
        Distributions of numbers that are drawn for each data set; coefficients of random fields always are.
    correlations
        Correlations between them.
    method
        Errors, and the points that data sets have.
    """

    stopped: ClassVar[str] = "all data made"
    explains: ClassVar[bool] = False

    model: Annotated[ModelSpec, MEASURED]
    method: Synthesize

    @property
    def findings(self) -> tuple[Finding, ...]:
        return self.model.findings_over(ranges(self.parameters))

    @property
    def planned(self) -> int:
        return len(self.method.fraction) + 1

    def plan(self, rank_groups: int) -> list[str]:
        sets, cost = len(self.method.fraction), self.spec.cost()
        names = [] if self.model.placed else [output.name for output in self.model.returned]
        return [
            f"method      {self.method.kind}",
            *(f"{what:10}  {found}" for what, found in self.model.described(ranges(self.parameters))),
            *([f"outputs     {', '.join(names)}"] if names else []),
            f"data sets   {sets}",
            *([] if cost is None else [f"time        about {duration(sets * cost.textbook)} on 1 core (rough)"]),
        ]

    def job(self, ensemble: Ensemble, name: str, directory: Path, checkpoint: Checkpoint) -> MethodJob:
        model: Any = self.spec.build(ensemble.group, self.inputs.names)
        spec: Any = self.model
        made = displacements(self, model, ensemble) if spec.placed else outputs(spec, model)
        recorders: dict[str, Recorder] = {}

        def task(evaluate: Evaluate) -> xr.Dataset:
            recorders["/"] = Recorder(evaluate)
            return self.method.run(self.inputs, recorders["/"], made.groups, made.points)

        def texts(found: xr.Dataset) -> dict[str, str]:
            return {f"data/{file}": text for file, text in files_of(self, made, name, found).items()}

        return MethodJob(made.model, {}, task, recorders, labelled=made.labelled, texts=texts)

    def mistakes(self) -> Iterator[Mistake]:
        if self.model.placed:
            yield from self._mistakes_of_specimen(self.model)
        yield from self.model.mistakes_of_mesh()
        for i in self.nodal:
            message = "values at the vertices are not independent, expected 'modes' or 'noise'"
            yield ("model", "fields", i, "basis"), message, "nodes"
        yield from self.mistakes_of_parameters()

    def _mistakes_of_specimen(self, model: Any) -> Iterator[Mistake]:
        method = self.method
        if not model.observed and not any(case.outputs for case in model.cases):
            message = "nothing is observed, expected boundaries or points, or outputs of load cases"
            yield ("model", "observed"), message, ()
        if method.format != "csv" and any(case.outputs for case in model.cases):
            yield ("method", "format"), "outputs of load cases are written to tables, expected 'csv'", method.format
        if method.format != "stl":
            return
        if not any(item.on is not None for item in model.observed):
            yield ("model", "observed"), "surfaces are of boundaries, expected { on = ... }", ()
        if method.missing > 0 or min(method.fraction) < 1:
            yield ("method", "format"), "surfaces have all their points, expected fraction = 1 and missing = 0", "stl"
        if method.noise.absolute is None:
            message = "one standard deviation is stated of all surfaces, expected absolute errors"
            yield ("method", "noise"), message, method.noise.model_dump(exclude_none=True)


# --- what is measured, and files of it -------------------------------------------------------------------------------


class Synthetic(NamedTuple):
    """What is measured of a model."""

    model: Any
    # Number (m,) of the group of each output, whose root mean square relative errors are shares of.
    groups: NDArray[np.int64]
    # Number (m,) of the point, or step, of each output; -1 of those that every data set has.
    points: NDArray[np.int64]
    # Name of a data set, its results, what is true by path, and the first lines of a table → texts of files by name.
    files: Callable[[str, xr.Dataset, dict[str, float], str], dict[str, str]]
    labelled: Callable[[xr.Dataset], xr.Dataset] = lambda found: found  # adds to the results what else is known


def files_of(study: Synthesis, made: Synthetic, name: str, found: xr.Dataset) -> dict[str, str]:
    """Return the texts of the files of all data sets, by their names."""
    scalars = {path: scalar.value for path, scalar in study.model.scalars.items()}
    stated = [path for path in scalars if path.startswith(OF_TRUTH) or path in study.inputs.names]
    texts: dict[str, str] = {}
    count = found.sizes["data_set"]
    for k in range(count):
        one = found.isel(data_set=k)
        every = scalars | dict(zip(map(str, found.parameter.values), one["truth"].values.tolist(), strict=True))
        truth = {path: every[path] for path in stated}
        lines = (f"# truth.{path} = {value!r}\n" for path, value in truth.items())
        label = name if count == 1 else f"{name}-{k + 1}"
        texts |= made.files(label, one, truth, "".join([_head(study.model, study.method), *lines]))
    return texts


def _head(model: ModelSpec, method: Synthesize) -> str:
    """Return the first line of a file: of what the data are."""
    noise = method.noise.model_dump(exclude_none=True)
    errors = f"errors {', '.join(f'{key} {value:g}' for key, value in noise.items())}, seed {method.seed}"
    if len(model.bodies) != 1:
        return f"# Synthetic: {model.description}, {errors}.\n"
    body = model.bodies[0].body
    return f"# Synthetic: {body.cells_in_words} cells ({body.cell}, degree {body.degree}), {errors}.\n"


def outputs(spec: ModelSpec, model: Any) -> Synthetic:
    """Return what is measured of the outputs of a model: each is a group, and each step of a path a point."""
    steps, m = steps_of(spec), len(spec.returned)
    n = m if steps is None else len(steps.units)

    def files(label: str, one: xr.Dataset, truth: dict[str, float], head: str) -> dict[str, str]:
        return {f"{label}.csv": head + "".join(f"{','.join(row)}\n" for row in _rows(spec, one))}

    return Synthetic(model, np.arange(m) % n, np.arange(m) // n, files)


def _rows(spec: ModelSpec, one: xr.Dataset) -> Iterator[list[str]]:
    """Go through the rows of a table: a curve for a path, else an output in each."""
    steps, values, sigma = steps_of(spec), one["values"].to_numpy(), one["sigma"].to_numpy()
    if steps is None:
        yield ["output", "value", "sigma"]
        names = one["output"].values
        yield from (
            [str(name), f"{value:.8g}", f"{error:.4e}"]
            for name, value, error in zip(names, values, sigma, strict=True)
            if np.isfinite(value)
        )
        return
    yield [*steps.numbers, *steps.units, *(f"sigma_{output}" for output in steps.units)]
    along = zip(*(numbers for _, numbers in steps.numbers.values()), strict=True)
    n = len(steps.units)
    for places, row, errors in zip(along, values.reshape(-1, n), sigma.reshape(-1, n), strict=True):
        if np.isfinite(row).any():
            shown = [f"{value:.8g}" if np.isfinite(value) else "" for value in row]
            yield [*(f"{place:.10g}" for place in places), *shown, *(f"{error:.4e}" for error in errors)]


# --- displacements of a specimen --------------------------------------------------------------------------------------


def displacements(study: Synthesis, model: SpecimenModel, ensemble: Ensemble) -> Synthetic:
    """Return what is measured of a specimen; collective over the group."""
    specimen: Any = study.model
    method, inputs = study.method, study.inputs
    places, axes = model.space.coordinates, model.axes
    # The point at which each output is observed, the same in all load cases; -1 of those that are measured at none.
    points, at = np.full(len(axes), -1), axes < len(AXES)
    points[at] = np.unique(np.round(model.places[at], SAME), axis=0, return_inverse=True)[1].ravel()
    if method.frame is not None:  # components along the axes of the scanner
        along = method.motion.rotation.T[model.axes]
        model = model.observing(model.places, model.axes, model.cases, along)
    fields = np.ones((len(method.fraction), 1))
    if specimen.fields and ensemble.index == 0:
        drawn = model.space.factors(method.truths(inputs))
        for one in (random for random in specimen.fields if random.of == "stiffness" and ensemble.group.rank == 0):
            fields = fields * drawn[one.label]

    def labelled(found: xr.Dataset) -> xr.Dataset:
        """Add the true factor on the stiffness at each node, as rows x, y, z, factor."""
        truths = found["truth"].to_numpy()
        factor = fields * np.exp(log_factor(specimen.inclusions, inputs.names, truths, places))
        table = np.concatenate([np.broadcast_to(places, (len(truths), *places.shape)), factor[:, :, None]], axis=2)
        return found.assign(factor=(("data_set", "place", "axis"), table))

    def files(label: str, one: xr.Dataset, truth: dict[str, float], head: str) -> dict[str, str]:
        values, sigma = (one[name].to_numpy() / method.metres for name in ("values", "sigma"))
        data = Measurements.of(values, sigma, model.cases, model.axes, places=model.places, points=points)
        return synthetic_files(study, label, one, data, truth, head)

    groups = np.where(points < 0, len(model.models) + kinds(model.cases, model.axes), model.cases)
    return Synthetic(model, groups, points, files, labelled)


def synthetic_files(
    study: Synthesis, label: str, one: xr.Dataset, data: Measurements, truth: dict[str, float], head: str
) -> dict[str, str]:
    """Return the texts of the files of a data set, by their names; its displacements are in the unit of the files."""
    specimen: Any = study.model
    method = study.method
    points, cases, axes, values, sigma = data.points, data.cases, data.axes, data.values, data.sigma
    rigid, unit, texts = method.motion, method.metres, {}
    frame = (data.places - rigid.shift) @ rigid.rotation / unit  # where the scanner sees them
    file = io.StringIO()
    file.write(head)
    if specimen.inclusions and not specimen.fields:
        inclusions = [
            {key: truth.get(f"inclusions.{one.label}.{key}", value) for key, value in one.model_dump().items()}
            for one in specimen.inclusions
        ]
        file.write(f"# truth.inclusions = {json.dumps(inclusions)}\n")
    if specimen.fields:
        file.write(f"# truth.stiffness = truth/{label}.csv\n")
        lines = (",".join(f"{x:.6g}" for x in row) for row in one["factor"].values)
        texts[f"truth/{label}.csv"] = "x,y,z,factor\n" + "\n".join(lines) + "\n"
    if method.format != "csv":
        return texts | _described(specimen, method, label, data, frame, truth)
    said = "" if method.units == "m" else f" [{method.units}]"
    heads = [f"{column}{said}" for column in ("x", "y", "z", "ux", "uy", "uz", "sigma")]
    apart = points < 0  # outputs of load cases, in units of their own
    more = ["output", "value", "sigma_value"] if apart.any() else []
    file.write(",".join([*heads, "case", *more] if not apart.all() else ["case", *more]) + "\n")
    for case, case_name in enumerate(c.name for c in specimen.cases):
        for point in np.unique(points[(cases == case) & (points >= 0)]):
            rows = np.flatnonzero((cases == case) & (points == point) & np.isfinite(values))
            if len(rows) == 0:
                continue
            motion = {int(axes[row]): f"{values[row]:.6e}" for row in rows}
            at = ",".join(f"{x:.8g}" for x in np.round(frame[rows[0]], 12) + 0.0)
            cells = ",".join(motion.get(axis, "") for axis in range(3))
            file.write(f"{at},{cells},{sigma[rows[0]]:.4e},{case_name}{',' * len(more)}\n")
        names = tuple(output.name for output in specimen.cases[case].outputs)
        for row in np.flatnonzero((cases == case) & apart):
            output, empty = names[axes[row] - len(AXES)], "" if apart.all() else "," * len(heads)
            value, error = (float(one[key].values[row]) for key in ("values", "sigma"))
            file.write(f"{empty}{case_name},{output},{value:.8g},{error:.4e}\n")
    return texts | {f"{label}.csv": file.getvalue()}


def _described(
    specimen: Specimen, method: Synthesize, label: str, data: Measurements, frame: FloatArray, truth: dict[str, float]
) -> dict[str, str]:
    """Return the texts of a cloud, or of a pair of surfaces for each load case, and of the file in TOML that says so.

    That file says what is true, too. Displacements, and where (m, 3) they are in the frame of the files, are in their
    unit.
    """
    number, arrays = _arrays(specimen, method, data)
    on_body, places = data.places[number], frame[number]
    if method.format == "stl":
        facets = facets_among(specimen.body, on_body)
        names = {case.name: f"{label}-{case.name}.stl" for case in specimen.cases}
        texts = {file: _stl((places + arrays[f"displacement_{case}"])[facets]) for case, file in names.items()}
        more = {"units": method.units, "sigma": method.noise.absolute, "truth": truth}
        said = tomli_w.dumps({"reference": f"{label}.stl", "deformed": names, **more})
        return texts | {f"{label}.stl": _stl(places[facets]), f"{label}.toml": said}
    file = f"{label}.{method.format}"
    said = tomli_w.dumps({"file": file, "units": method.units, "truth": truth})
    return {file: _cloud(places, arrays, method.format), f"{label}.toml": said}


def _arrays(
    specimen: Specimen, method: Synthesize, data: Measurements
) -> tuple[NDArray[np.int64], dict[str, FloatArray]]:
    """Return a row of each point of a cloud, and displacements of each load case there with their errors."""
    measured = np.unique(data.seen().points)
    number = np.array([np.flatnonzero(data.points == point)[0] for point in measured])
    found: dict[str, FloatArray] = {}
    for case, name in enumerate(one.name for one in specimen.cases):
        here = data.subset((data.cases == case) & np.isin(data.points, measured))
        motion, errors = np.full((len(measured), 3), np.nan), np.full(len(measured), np.nan)
        at = np.searchsorted(measured, here.points)
        motion[at, here.axes] = here.values
        errors[at] = here.sigma
        if method.format == "ply":
            found |= {f"u{axis}_{name}": motion[:, k] for k, axis in enumerate("xyz")} | {f"sigma_{name}": errors}
        else:
            found |= {f"displacement_{name}": motion, f"sigma_{name}": errors}
    return number, found


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


def facets_among(body: Body, places: FloatArray) -> NDArray[np.int64]:
    """Return triangles (n, 3) of the surface of a body whose corners are all among places (k, 3), as rows of these."""
    rows = {tuple(place): i for i, place in enumerate((np.round(places, SAME) + 0.0).tolist())}
    corners = (np.round(Surface.of(body).triangles, SAME) + 0.0).tolist()
    found = [[rows.get(tuple(corner), -1) for corner in triangle] for triangle in corners]
    return np.array([triangle for triangle in found if min(triangle) >= 0], dtype=np.int64).reshape(-1, 3)


def _stl(corners: FloatArray) -> str:
    """Return the text of an STL file of triangles (n, 3, 3)."""
    lines = ["solid surface"]
    for triangle in corners:
        a, b, c = triangle
        normal = np.cross(b - a, c - a)
        normal = normal / (np.linalg.norm(normal) or 1.0)
        lines += [f"facet normal {normal[0]:.6g} {normal[1]:.6g} {normal[2]:.6g}", " outer loop"]
        lines += [f"  vertex {x:.10g} {y:.10g} {z:.10g}" for x, y, z in triangle]
        lines += [" endloop", "endfacet"]
    return "\n".join([*lines, "endsolid surface", ""])
