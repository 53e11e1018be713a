"""What an inversion predicts: the models of it, mistakes in asking, and how posteriors are put into them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import ValidationError
from scipy.linalg import block_diag
from scipy.special import ndtri

from forward.findings import Entry, Finding, entries
from forward.model import FloatArray, ForwardModel
from forward.settings import nearest
from forward.specimen import in_words, shared_paths
from inverse.data.measurements import Measurements
from inverse.fields.low_rank import Beside, LowRankPosterior, symmetric_root
from inverse.methods import predict
from uq.estimators.estimate import estimate_of
from uq.findings import keep_unknown, meshes_unknown
from uq.inputs.draws import Draws
from uq.inputs.sampling import sobol_points
from workflows.studies.inversion_blocks import ACTING, LEAST, PREDICTED, InversionBlocks, Predict
from workflows.studies.study import never_estimable

if TYPE_CHECKING:
    import xarray as xr

    from forward.scalars import Mistake
    from inverse.methods.predict import Band
    from inverse.methods.record import Record
    from uq.evaluation.request import Evaluate

# From the name of a data set, the posterior of its field, what corrects that, and what is uncertain beside.
FieldPredictions = Callable[[str, "LowRankPosterior", "tuple[FloatArray, FloatArray] | None", Beside], "Record"]
_acts = attrgetter(*ACTING)  # of a load case
LARGE = 0.2  # of the standard deviation of a prediction: errors that are said


# --- what is asked ---------------------------------------------------------------------------------------------------


def mistakes(study: InversionBlocks) -> Iterator[Mistake]:
    """Find what cannot be predicted."""
    asked, specimen = study.predict, study.model.placed
    assert asked is not None
    if specimen and asked.model:
        message = "a specimen is predicted in load cases and at places, expected predict.cases and predict.observed"
        yield ("predict", "model"), message, asked.model
        return
    of_specimen = {"cases": [one.name for one in asked.cases], "observed": [one.name for one in asked.observed]}
    for name, given in of_specimen.items() if not specimen else ():
        if given:
            message = f"a model of kind '{study.model.kind}' has none, expected predict.model = {{ outputs = [...] }}"
            yield ("predict", name), message, given
            return
    if not study.field and asked.solves(field=False) < LEAST:
        yield ("predict", "samples"), f"expected at least {LEAST}", asked.samples
    wrong = list(_of_cases(study, asked)) if specimen else list(_of_model(study, asked))
    yield from wrong
    if wrong:
        return
    made: Any
    try:
        made = study.predicted
    except ValidationError as error:
        for line in error.errors(include_url=False):
            where = () if specimen else ("model",)
            yield ("predict", *where, *line["loc"]), line["msg"], line["input"]
        return
    try:
        outputs = made.returned
    except ValueError as error:  # nodes of a boundary, which only the mesh knows
        yield ("predict", "observed"), str(error).removeprefix("observed"), [one.on for one in asked.observed]
        return
    if not outputs:
        yield ("predict",), "nothing is predicted, expected outputs or places", {}
        return
    cases = made.cases if specimen else ()
    there = [one.model_copy(update={"name": f"what is predicted in {one.name}"}) for one in cases]
    shared = shared_paths([*study.model.cases, *there]) if specimen else {}
    # Unknowns would give what is predicted another load than it states.
    yield from ((("predict", "cases"), in_words(path, shared[path]), path) for path in shared if path in study.unknown)
    if not {*made.scalars, *made.coefficients} & set(study.unknown):
        yield ("predict",), f"none of the unknown numbers ({', '.join(study.names)}) is one of what is predicted", {}


def _of_cases(study: InversionBlocks, asked: Predict) -> Iterator[Mistake]:
    known = tuple(case.name for case in study.model.cases)
    if not asked.cases and not asked.observed:
        yield ("predict",), "nothing is predicted, expected predict.cases or predict.observed", {}
    everywhere = any(not one.cases for one in asked.observed)
    seen = {name for one in asked.observed for name in one.cases}
    for i, case in enumerate(asked.cases):
        if case.name not in known and not any(getattr(case, name) for name in ACTING):
            message = f"is no measured load case, and nothing acts in it; {nearest(case.name, known)}"
            yield ("predict", "cases", i, "name"), message, case.name
        elif not case.outputs and not everywhere and case.name not in seen:
            message = "nothing is predicted in this load case, expected outputs or predict.observed"
            yield ("predict", "cases", i), message, case.name


def _of_model(study: InversionBlocks, asked: Predict) -> Iterator[Mistake]:
    known = tuple(name for name in type(study.model).model_fields if name != "kind")
    if asked.model.get("kind", study.model.kind) != study.model.kind:
        yield ("predict", "model", "kind"), f"expected '{study.model.kind}', as what was measured", asked.model["kind"]
    for name in asked.model:
        if name not in known and name != "kind":
            yield ("predict", "model", name), f"unknown key; {nearest(name, known)}", asked.model[name]


# --- what is done ----------------------------------------------------------------------------------------------------


def of_few(
    study: InversionBlocks, found: xr.Dataset, evaluate: Evaluate, of_mesh: Evaluate, before: Callable[[], Band]
) -> Record:
    """Return what the posterior of few parameters, in the dataset of its inversion, says on what is predicted.

    The model of that has evaluations for solves, and for estimates of the error of its mesh; what the prior says of it
    was found before.
    """
    names, labels = study.acting, tuple(study.predicts.groups)
    weights = found["point_weight"].to_numpy()
    used = weights > 0
    columns = [study.names.index(name) for name in names]
    points = found["point"].to_numpy()[used][:, columns]
    kept = weights[used] / weights[used].sum()
    effective, c = float(1 / (kept**2).sum()), len(names) + len(labels)
    if labels or "unexplained_point" in found:
        means, covariance = _beside(found)
        known, others = _acting_of(study)
        acting = block_diag(known, np.eye(means.shape[1] - known.shape[1]))
        others = np.pad(others, ((0, len(acting) - len(known)), (0, 0)))
        root = np.hstack([acting @ symmetric_root(covariance), others])
        points, kept = predict.with_beside(points, kept, means[used] @ acting.T, root, study.method.seed)
    draws, more = Draws((*names, *labels), points[:, :c], kept, effective), points[:, c:]
    solves = study.predicted_by, study.method.seed
    after, whole = predict.of_draws(draws, evaluate, *solves, more if more.size else None)
    looked = study.method.treatment is not None and study.predicted.bodies
    mesh = predict.mesh_error_at(draws, of_mesh) if looked and not np.isnan(after.mean).all() else np.nan
    record = predict.record(before(), after, np.broadcast_to(mesh, after.mean.shape))
    return record if whole is None else record | whole.named("prediction_process_")


def _beside(found: xr.Dataset) -> tuple[FloatArray, FloatArray]:
    """Return means at all points, and the covariance, of what is uncertain and of what no parameters explain."""
    kinds = [kind for kind in ("uncertain", "unexplained") if f"{kind}_point" in found]
    covariance = block_diag(np.zeros((0, 0)), *(found[f"{kind}_covariance"] for kind in kinds))
    if "unexplained_uncertain" in found:
        both = found["unexplained_uncertain"].to_numpy()
        g = both.shape[1]
        covariance[g:, :g], covariance[:g, g:] = both, both.T
    return np.hstack([np.zeros((found.sizes["point"], 0)), *(found[f"{kind}_point"] for kind in kinds)]), covariance


def elsewhere_of(study: InversionBlocks) -> Measurements:
    """Return the displacements that are predicted, in the load cases of the data in which the same acts."""
    made: Any = study.predicted
    measured = study.model.cases
    alike = [
        next((k for k, case in enumerate(measured) if _acts(case) == _acts(one)), len(measured) + number)
        for number, one in enumerate(made.cases)
    ]
    rows = [(alike[number], axis, at) for number, _, axis, at in made.rows()]
    cases, axes, places = (np.array(of) for of in zip(*rows, strict=True))
    nothing = np.full(len(rows), np.nan)
    return Measurements.of(nothing, nothing, cases, np.minimum(axes, 3), places=places)


def _acting_of(study: InversionBlocks) -> tuple[FloatArray, FloatArray]:
    """Return which of what is uncertain acts in what is predicted, ones among zeros (g′, g), and units of others."""
    known, labels = [] if study.taken is None else list(study.taken.groups), list(study.predicts.groups)
    acting = np.array([[float(one == other) for other in known] for one in labels]).reshape(len(labels), len(known))
    return acting, np.eye(len(labels))[:, ~acting.any(axis=1)]


def prior_band(study: InversionBlocks, evaluate: Evaluate) -> Band:
    """Return what the prior says, which is solved for once for all data sets."""
    names, every, labels = study.acting, study.inputs.names, tuple(study.predicts.groups)
    uniforms = sobol_points(study.method.seed, 0, 0, predict.POINTS, len(every) + len(labels))
    points = study.inputs.points(uniforms[:, : len(every)])
    values = np.hstack([points[:, [every.index(name) for name in names]], ndtri(uniforms[:, len(every) :])])
    values = values[study.inputs.allowed(points)]
    draws = Draws((*names, *labels), values, np.full(len(values), 1 / len(values)), float(len(values)))
    return predict.of_draws(draws, evaluate, study.predicted_by, study.method.seed)[0]


def of_field(study: InversionBlocks, model: Callable[[str], ForwardModel]) -> FieldPredictions:
    """Return what predicts from the posterior of a field of a data set, by a model whose solves are kept by name."""
    prior, looked = study.model.fields[0].prior(study.model.body), study.method.treatment is not None
    pairs, seed, size = study.predicted_by // 2, study.method.seed, len(study.acting)
    known, others = _acting_of(study)

    @cache
    def before() -> Band:
        return predict.before_field(model(f"prior, {PREDICTED}"), prior, size, pairs, seed, len(known))

    def record(
        name: str, found: LowRankPosterior, weighted: tuple[FloatArray, FloatArray] | None, every: Beside
    ) -> Record:
        there = model(f"{name}/{PREDICTED}")
        beside = Beside(known @ every.mean, known @ every.slopes, np.hstack([known @ every.root, others]))
        return predict.after_field(there, found, before(), pairs, seed, weighted, beside, of_mesh=looked)

    return record


# --- what is said ----------------------------------------------------------------------------------------------------


def keep_unknown_meshes(study: InversionBlocks, dataset: xr.Dataset) -> None:
    """Keep which predictions have an error of a mesh that nobody knows, of any data set."""
    spec = study.predicted
    if not spec.bodies:
        return
    goals = dataset["goal"].values
    predicted = estimate_of(dataset, "prediction_mean")
    solved, error = np.isfinite(dataset["prediction_std"].to_numpy()), np.isfinite(predicted.mesh)
    unknown = [str(goal) for goal in goals[(solved & ~error).any(axis=0)]]
    looked = study.method.treatment is not None and not spec.unenriched_with and not spec.hidden
    keep_unknown(dataset, unknown, set(unknown) - set(never_estimable(spec, unknown)) if looked else ())


def findings(one: xr.Dataset) -> Iterator[Finding]:
    """Say what is doubtful of the predictions of a data set."""
    why = str(one["prediction_why"].item())
    if why:
        yield Finding("prediction-doubtful", "warning", {"doubts": why})
    std, predicted = one["prediction_std"].to_numpy(), estimate_of(one, "prediction_mean")
    mesh = predicted.mesh
    off = _over(one, np.abs(mesh), std)
    if off:
        yield Finding("prediction-mesh", "warning", about=off)
    rough = _over(one, predicted.error, std)
    if rough:
        yield Finding("prediction-rough", "warning", about=rough)
    unknown = meshes_unknown(one) if np.isfinite(std).any() else {}
    untold = [str(goal) for goal, error in zip(one["goal"].values, mesh, strict=True) if np.isnan(error)]
    failed, never = ([goal for goal in untold if unknown.get(goal) is planned] for planned in (True, False))
    if failed:
        yield Finding("prediction-mesh-failed", "error", about=entries(failed))
    if never:
        yield Finding("prediction-mesh-unknown", "note", about=entries(never))


def _over(one: xr.Dataset, errors: FloatArray, std: FloatArray) -> tuple[Entry, ...]:
    """Return the outputs whose errors (k,) are large against their standard deviations (k,)."""
    parts = zip(one["goal"].values, errors, std, strict=True)
    return tuple(
        Entry(str(goal), f" by {error / width:.2g}", error / width)
        for goal, error, width in parts
        if error > LARGE * width > 0
    )
