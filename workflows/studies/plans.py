"""What studies that sample a model, or invert data, will cost."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from forward.fem.cost import BYTES_OF_PROGRAM, COMPILATION, REPORT, START, Linear
from forward.machine import MIB, compiled_forms
from forward.readable import told
from uq.evaluation.request import OWN, company_of
from workflows.accuracy import tolerance_words
from workflows.accuracy.levers import COUNTS
from workflows.config.priors import ranges
from workflows.studies.predictions import NOT_ASKED, PRODUCT, duration, mesh_check, never_estimable, times_of

if TYPE_CHECKING:
    from inverse.data.measurements import Measurements
    from workflows.studies.inversion_blocks import InversionBlocks
    from workflows.studies.sampling_blocks import SamplingBlocks

PRODUCTS_OF_FIELD = 500  # for a mode and its pairs
LISTED = 8  # outputs that are named


def of_sampling(study: SamplingBlocks, memory: float, rank_groups: int) -> list[str]:
    """Say what is sampled, how often, and how long that will take."""
    method, spec, planned = study.method, study.spec, study.planned
    open_ended = method.open_ended or study.accuracy.tolerance is not None
    up_to = "up to " if open_ended and not method.undecided else ""
    later = f" for {method.undecided}, which decide how many more" if method.undecided else ""
    lines = [
        f"method      {method.kind}",
        *(f"{what:10}  {words}" for what, words in study.model.described(ranges(study.given))),
    ]
    for k, mesh in enumerate(study.meshes[1:], 1):
        cost = mesh.cost()
        taken = "" if cost is None else f" ({cost.sample:.2g} s a solve)"
        lines.append(f"            {mesh.unknowns:,} on mesh {k}{taken}")
    lines += [
        f"parameters  {', '.join([*study.given, *_in_series(spec.coefficients)])}",
        f"outputs     {', '.join(output.name for output in spec.returned)}",
        f"solves      {up_to}{planned:,}{later}",
        *(tolerance_words.plan(study) if study.accuracy.tolerance is not None else ()),
    ]
    if spec.cost() is None:  # the time of a solve is unknown
        return lines
    if study.estimates:
        estimates = f"{up_to}{study.estimates} estimates"
        if study.accuracy.tolerance is not None:  # the study's number is of a method alone
            estimates = f"{COUNTS[0]} to {COUNTS[-1]} estimates on each mesh"
        lines.append(f"mesh error  {estimates} in elements of one degree more; none with accuracy.mesh_error = false")
        never = never_estimable(spec)
        if never:
            lines.append(f"            none of {', '.join(never)}, which need not converge as the mesh is refined")
    needed = memory + BYTES_OF_PROGRAM
    return [
        *lines,
        f"memory      about {needed / MIB:,.0f} MiB for each group of ranks",
        *_told(parts(study), rank_groups, up_to, later and ", then more", _compilation(study)),
    ]


def _in_series(paths: Sequence[str]) -> Iterator[str]:
    """Name the coefficients of each random field by the first and the last."""
    for _, series in groupby(paths, lambda path: path.rpartition(".")[0]):
        first, *rest = series
        yield f"{first} to {len(rest)}"


class Part(NamedTuple):
    """Cost of a part of a study: predicted processor time (s), purpose, and whether groups of ranks share it."""

    seconds: float
    what: str
    shared: bool = False


def parts(study: SamplingBlocks) -> list[Part]:
    """Predict the cost of a study of a body, part by part.

    Samples are the maximum number; those that multilevel methods add after their pilots are unknown.
    """
    method, dimension = study.method, len(study.inputs.names)
    known = ((name, model.cost()) for name, model in study.models.items())
    costs = {OWN: times_of(study.spec)} | {name: cost for name, cost in known if cost is not None}
    found = [times_of(mesh) for mesh in study.meshes]
    samples = study.planned - len(found)
    seconds = min(method.seconds(dimension, costs), getattr(method, "budget_seconds", None) or float("inf"))
    corrected = samples > 0 and found[0].predicted and found[0].linear != Linear.MULTIGRID
    each = found[0].in_company(company_of(samples))
    seconds *= each / found[0].sample
    further = f"{samples:,} further solves, {each:.2g} s each"
    return [
        Part(START, "start of the program"),
        *([] if _compiled_before() else [Part(_compilation(study), "compilation of the forms")]),
        Part(sum(one.first for one in found), f"first solve{' on every mesh' if len(found) > 1 else ''}"),
        Part(sum(one.tangents(dimension) for one in found), "its tangents"),
        *([Part(sum(one.reference_factor(dimension) for one in found), "reference factor")] if corrected else []),
        *([Part(seconds, further, shared=True)] if samples > 0 else []),
        *_estimates(study),
        Part(REPORT, "results and report"),
    ]


def _estimates(study: SamplingBlocks) -> Iterator[Part]:
    """Estimates of the error of the mesh, each with its solution."""
    estimating = study.spec.mesh_error_cost(study.spare) if study.estimates else None
    if estimating is None:
        return
    each = times_of(study.spec).sample + estimating.seconds
    yield Part(
        estimating.once + estimating.calibration + study.estimates * each,
        f"{study.estimates} estimates of the mesh error, {each:.2g} s each",
        True,
    )


def _compilation(study: SamplingBlocks) -> float:
    """Seconds of the forms of a body, and of those for the error of its mesh."""
    estimating = study.spec.mesh_error_cost(study.spare) if study.estimates else None
    if estimating is None:
        return COMPILATION
    return COMPILATION * (2 if estimating.calibration else 3)  # in elements of one degree more, and perhaps of two


def _compiled_before() -> bool:
    """Whether any forms were compiled on this machine; only a run can tell which."""
    return any(compiled_forms().glob("forms-*/*/"))


def _told(found: Sequence[Part], rank_groups: int, up_to: str, more: str, compilation: float) -> list[str]:
    """Say how long a study takes by the clock, if every group of ranks has a core, and of what this is the sum."""
    by_clock = [part.seconds / (rank_groups if part.shared else 1) for part in found]
    cores = f"{rank_groups} core{'s' if rank_groups > 1 else ''}"
    lines = [f"time        {up_to}about {duration(sum(by_clock))} on {cores}, to a factor of 2{more}:"]
    lines += [f"            {duration(s):>8}  {part.what}" for s, part in zip(by_clock, found, strict=True)]
    if _compiled_before():
        lines.append(
            f"            and {compilation:.0f} s or more where the forms of this kind of body are not compiled yet"
        )
    return lines


# --- inversions ------------------------------------------------------------------------------------------------------


def of_inversion(study: InversionBlocks) -> list[str]:
    """Say what is inverted, and how long that will take."""
    from inverse.criticism.assessment import only_needed, own_seconds
    from inverse.methods.invert import derivable

    method, spec, of_outputs, size = study.method, study.spec, study.specimen is None, len(study.names)
    usable = [one for one in study.measurements if one is not None]
    counts = [len(one) for one in usable]
    kind, unknown = "values" if of_outputs else "components", f"{size}: {', '.join(study.names)}"
    if study.field:
        unknown = f"{study.specimen.body.vertex_count:,} values of ln stiffness"
    lines = [
        f"method      {method.kind}",
        *(f"{what:10}  {words}" for what, words in study.model.described(ranges(study.parameters))),
        *(f"by          {one.description}" for one in study.reduced.values() if of_outputs),
        f"unknown     {unknown}",
        *([f"outputs     {', '.join(study.parts)}"] if of_outputs else []),
        f"data sets   {len(usable)}, of {', '.join(f'{n:,}' for n in counts)} {kind}",
        *_moved(usable),
        *(f"registered  {one.registered.described}" for one in usable if one.registered is not None),
        *(f"warning     {found.clause}" for one in usable for found in one.findings),
        *([f"solves      about {study.solves // len(counts):,} for each"] if of_outputs else []),
    ]
    own = 0.0 if study.field else own_seconds(size, max(counts), method.solves(size, field=False), method.chains)
    if spec.cost() is None:
        derivable(spec.build(None, study.inputs.names), spec.kind)
        each = f"up to about {duration(own)} for each, " if own else ""
        time = f"{each}{duration(START + REPORT)} for start and report, and what the solves take"
    else:
        unlooked = NOT_ASKED if study.model_error is None else study.unlooked
        once, checked = mesh_check(spec) if study.looked else (0.0, unlooked)
        lines.append(f"mesh check  {checked}")
        seconds = own + once + _seconds_of_predictions(study)
        if of_outputs:
            cost = times_of(spec)
            seconds += study.solves / len(counts) * (cost.sample + cost.tangents(len(study.inputs.names)) / 4)
        else:
            seconds += _seconds_of_specimen(study)
        time = f"about {duration(seconds)} for each on 1 core (rough)"
    lines += [*_predicted(study), f"time        {time}"]
    lines += only_needed(method.chains, method.chains_when, method.chain_solves(size, field=study.field))
    lines += _learnt(study)
    lines += [] if study.taken is None else [f"assumed     {study.taken.described(field=study.field)}"]
    if study.asked:
        lines.append(f"asked       {', '.join(study.asked)}: whether the data call for them, by 1 solve")
    return [*lines, *(f"warning     {one.refused}" for one in study.data.sets if one.refused)]


def _seconds_of_specimen(study: InversionBlocks) -> float:
    """Predict the processor time (s) of the solves for a data set of a specimen."""
    from workflows.studies.inversion_blocks import SOLVES_OF_FIELD

    method, size, field = study.method, len(study.names), study.field
    cases = [times_of(study.specimen.loaded(case)) for case in study.specimen.cases]
    each, textbook = sum(one.corrected for one in cases), sum(one.textbook for one in cases)
    modes = SOLVES_OF_FIELD + PRODUCT * PRODUCTS_OF_FIELD if field else 15 * method.starts
    draws = 2 * method.solves(0, field=True) if field else method.solves(size, field=False)
    return textbook * modes + each * (draws + method.chain_solves(size, field=field))


def _learnt(study: InversionBlocks) -> list[str]:
    """Say what the errors of the model are learnt from."""
    if study.model_error is None:
        return []
    pairs = study.model_error.solves
    return [
        f"learns      errors of the model by {pairs} solves of another one over the prior, {pairs} over the posterior"
    ]


def _predicted(study: InversionBlocks) -> list[str]:
    """Say what is predicted, and by how many solves."""
    if study.predict is None:
        return []
    names = [output.name for output in study.predicted.returned]
    more = f" and {len(names) - LISTED} others" if len(names) > LISTED else ""
    solves = 1 + study.predicted_by
    return [f"predicts    {', '.join(names[:LISTED])}{more}, by {solves} solves, and as many of the prior"]


def _seconds_of_predictions(study: InversionBlocks) -> float:
    """Predict the processor time (s) of what is predicted."""
    cost = None if study.predict is None else study.predicted.cost()
    if cost is None:
        return 0.0
    own = 0.0 if study.field else cost.tangents_of_sample(len(study.inputs.names))
    return 2 * (cost.textbook + study.predicted_by * (cost.sample + own))


def _moved(usable: list[Measurements]) -> list[str]:
    """Say how many points are moved onto the body, and how far."""
    moves = np.concatenate([one.moves for one in usable])
    count = int((moves > 0).sum())
    if not count:
        return []
    where = "" if all(one.on_surface for one in usable) else " outside the body"
    are = f"point{where} is" if count == 1 else f"points{where} are"
    farthest, rms = (told(float(x), "m") for x in (moves.max(), np.sqrt(np.mean(moves**2))))
    return [f"            {count} {are} moved to its surface, by up to {farthest} (root mean square {rms})"]
