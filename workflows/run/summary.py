"""What a run writes to summary.json."""

from __future__ import annotations

import platform
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.model import WORK
from uq.estimators import failure_domain
from uq.findings import findings
from workflows.results.summary import summarise
from workflows.run import own_code
from workflows.run.version import commit, versions

if TYPE_CHECKING:
    import xarray as xr

    from uq.evaluation.request import Evaluations
    from uq.evaluation.tasks import Outcome
    from workflows.studies.job import Job
    from workflows.studies.study import StudyKind

LISTED = 50  # failures that are listed; evaluations.h5 has all


def summarised(
    study: StudyKind, name: str, dataset: xr.Dataset, job: Job, ranks: int, rank_groups: int, wall: float
) -> dict[str, Any]:
    """Return the contents of summary.json: the study, its results, their cost, and the versions that made them."""
    evaluations = job.evaluations
    every, done = evaluations.values(), _counts(study, evaluations, job.outcomes)
    seconds = sum(one.seconds for one in job.outcomes) or float(sum(found.seconds.sum() for found in every))
    source = own_code.digest(study)
    stability, joined = failure_domain.counts(every), failure_domain.joined_counts(every)
    none = np.zeros(len(WORK), dtype=np.int64)
    return {
        "study": name,
        "method": study.method.kind,
        "status": "partial" if done["failed"] else "complete",
        "stopped": dataset.attrs.get("stopped", study.stopped),
        **({"note": dataset.attrs["note"]} if "note" in dataset.attrs else {}),
        "findings": [{"severity": one.severity, "text": one.text, "code": one.code} for one in findings(dataset)],
        **done,
        **({"stability": stability} if stability else {}),
        **({"joined": joined} if joined else {}),
        "wall_seconds": wall,
        "cpu_seconds": seconds * study.parallel.ranks_per_model,
        "own_seconds": job.own_seconds,
        "work": dict(zip(WORK, sum((found.work.sum(axis=0) for found in every), none).tolist(), strict=True)),
        **summarise(dataset),
        "provenance": {
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "seed": getattr(study.method, "seed", None),
            "ranks": ranks,
            "groups": rank_groups,
            "processor": platform.machine(),
            "commit": commit(),
            **({} if source is None else {"source": source}),
            "versions": {"python": platform.python_version(), **versions()},
        },
        **job.told,
    }


def _counts(study: StudyKind, evaluations: Mapping[str, Evaluations], outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Number of solves, or of data sets that were inverted side by side, and which failed."""
    explains = study.explains
    solves = [(label, failure) for label, found in evaluations.items() for failure in found.failures]
    failed = [(label, failure) for label, failure in solves if not (explains and failure.inadmissible)]
    lost = [(k, one.reason) for k, one in enumerate(outcomes) if one.dataset is None]
    listed: list[dict[str, Any]] = [
        {"parameters": {"data_set": float(k)}, "reason": reason} for k, reason in lost[:LISTED]
    ]
    if not outcomes:
        listed = [
            {
                **({} if label == "/" else {"model": label}),
                "parameters": dict(zip(study.parameters_of(label), failure.parameters, strict=True)),
                "reason": failure.reason,
            }
            for label, failure in failed[:LISTED]
        ]
    unlikely = sum(failure.inadmissible for _, failure in solves)  # at parameters for which there is no model
    return {
        "evaluations": len(outcomes) or sum(len(found.points) for found in evaluations.values()),
        "failed": len(lost if outcomes else failed),
        **({"zero_likelihood": unlikely} if outcomes or explains else {}),
        "failures": listed,
    }
