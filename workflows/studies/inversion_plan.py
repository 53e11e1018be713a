"""What an inversion will cost."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from forward.fem.cost import REPORT, START
from forward.readable import told
from inverse.criticism.assessment import own_seconds
from inverse.methods.invert import derivable
from workflows.config.priors import ranges
from workflows.studies.predictions import NOT_ASKED, duration, formulation, mesh_check, times_of

if TYPE_CHECKING:
    from forward.specimen import Specimen
    from workflows.studies.inversion import Inversion
    from workflows.studies.measured import Measurement

PRODUCTS_OF_FIELD = 500  # for a mode and its pairs
LISTED = 8  # outputs that are named
PRODUCT = 0.12  # time of a product, of that of a solve by Newton's method from a state nearby


def plan(study: Inversion) -> list[str]:
    """Say what is inverted, and how long that will take."""
    return _of_outputs(study) if study.specimen is None else _of_specimen(study, study.specimen)


def _of_specimen(study: Inversion, spec: Specimen) -> list[str]:
    from workflows.studies.inversion import SOLVES_OF_FIELD

    sets = study.data.sets
    usable = [m for m in study.measurements if m is not None]
    counts = [int(m.observations.measured.sum()) + len(m.observations.readings) for m in usable]
    moved = [int((m.moved > 0).sum()) for m in usable]
    cases = [times_of(spec.loaded(case)) for case in spec.cases]
    each, textbook = sum(one.corrected for one in cases), sum(one.textbook for one in cases)
    if study.field:
        unknown = f"{spec.body.vertex_count:,} values of ln stiffness"
        seconds = (
            textbook * (SOLVES_OF_FIELD + PRODUCT * PRODUCTS_OF_FIELD) + 2 * study.method.solves(0, field=True) * each
        )
    else:
        unknown = f"{len(study.names)}: {', '.join(study.names)}"
        seconds = textbook * 15 * study.method.starts + each * study.method.solves(len(study.names), field=False)
    seconds += each * study.method.chain_solves(len(study.names), field=study.field)
    once, checked = mesh_check(spec) if study.method.treatment is not None else (0.0, NOT_ASKED)
    seconds += once + _seconds_of_predictions(study) + _own_seconds(study, max(counts))
    return [
        f"method      {study.method.kind}",
        f"unknown     {unknown}",
        *(f"{what:10}  {found}" for what, found in spec.body.listed.items()),
        f"load cases  {', '.join(case.name for case in spec.cases)}, of {spec.unknowns:,} unknowns each",
        formulation(study.model.decision(ranges(study.parameters))),
        f"data sets   {len(usable)}, of {', '.join(f'{count:,}' for count in counts)} components",
        *([f"            {_moved(sum(moved), usable)}"] if sum(moved) else []),
        *(f"registered  {one.registered.described}" for one in usable if one.registered is not None),
        *(f"warning     {found.clause}" for one in usable for found in one.findings),
        f"mesh check  {checked}",
        *_predicted(study),
        f"time        about {duration(seconds)} for each on 1 core (rough)",
        *(f"warning     {item.refused}" for item in sets if item.refused),
    ]


def _predicted(study: Inversion) -> list[str]:
    """Say what is predicted, and by how many solves."""
    if study.predict is None:
        return []
    names = [output.name for output in study.predicted.returned]
    more = f" and {len(names) - LISTED} others" if len(names) > LISTED else ""
    solves = 1 + study.predict.solves(field=study.field)
    return [f"predicts    {', '.join(names[:LISTED])}{more}, by {solves} solves, and as many of the prior"]


def _seconds_of_predictions(study: Inversion) -> float:
    """Predict the processor time (s) of what is predicted."""
    cost = None if study.predict is None else study.predicted.cost()
    if cost is None or study.predict is None:
        return 0.0
    own = 0.0 if study.field else cost.tangents_of_sample(len(study.inputs.names))
    return 2 * (cost.textbook + study.predict.solves(field=study.field) * (cost.sample + own))


def _own_seconds(study: Inversion, data: int) -> float:
    """Predict the most processor time (s) that an inversion of so many data takes besides solves."""
    if study.field:
        return 0.0
    method, size = study.method, len(study.names)
    return own_seconds(size, data, method.solves(size, field=False), method.chains)


def _moved(count: int, usable: list[Measurement]) -> str:
    where = "" if all(m.on_surface for m in usable) else " outside the body"
    are = f"point{where} is" if count == 1 else f"points{where} are"
    farthest = max(m.moved.max(initial=0.0) for m in usable)
    square = float(np.mean(np.concatenate([m.moved for m in usable]) ** 2))
    rms = told(np.sqrt(square), "m")
    return f"{count} {are} moved to its surface, by up to {told(farthest, 'm')} (root mean square {rms})"


def _of_outputs(study: Inversion) -> list[str]:
    spec, sets, method = study.spec, study.data.sets, study.method
    counts = [len(found.values) for found in study.measurements if found is not None]
    lines = [
        f"method      {method.kind}",
        *(f"{what:10}  {words}" for what, words in study.model.described(ranges(study.parameters))),
        *(f"by          {one.description}" for one in study.reduced.values()),
        f"unknown     {len(study.names)}: {', '.join(study.names)}",
        f"outputs     {', '.join(study.parts)}",
        f"data sets   {len(counts)}, of {', '.join(f'{count:,}' for count in counts)} values",
        f"solves      about {study.solves // len(counts):,} for each",
        *_predicted(study),
    ]
    cost, own = spec.cost(), _own_seconds(study, max(counts))
    if cost is None:
        derivable(study.spec.build(None, study.inputs.names), spec.kind)
        each = f"up to about {duration(own)} for each, " if own else ""
        lines.append(f"time        {each}{duration(START + REPORT)} for start and report, and what the solves take")
    else:
        d = len(study.inputs.names)
        seconds = study.solves / len(counts) * (cost.sample + cost.tangents(d) / 4) + _seconds_of_predictions(study)
        seconds += own
        if method.treatment is not None:
            once, checked = mesh_check(spec)
            seconds += once
            lines.append(f"mesh check  {checked}")
        else:
            lines.append(f"mesh check  {NOT_ASKED}")
        lines.append(f"time        about {duration(seconds)} for each on 1 core (rough)")
    return [*lines, *(f"warning     {item.refused}" for item in sets if item.refused)]
