"""What inversions ask of the shape of a body: the model with what it could have besides."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from forward.combine import along_columns
from forward.enlargements import enlarged, enlargements, fitted
from forward.fem.layout import vertex_matrices
from forward.model import FloatArray
from inverse.criticism.questions import Questions
from inverse.data.measurements import Measurements
from uq.evaluation.evaluate import SerialEvaluate
from workflows.data.measured import observing


def asking(spec: Any, names: tuple[str, ...], comm: Any) -> Callable[[Measurements], Questions]:
    """Return what makes the questions for a data set on a body with unknown numbers, by their paths; collective."""
    larger, paths = enlarged(spec)
    model = larger.build(comm, (*names, *paths))
    places = vertex_matrices(spec.body)[3]
    forms = partial(enlargements, spec, names, places=places)

    def of(data: Measurements) -> Questions:
        own = observing(model, data)

        def having(wanted: Sequence[str], patterns: FloatArray) -> SerialEvaluate:
            columns = dict(zip((name for name in wanted if name not in names), patterns, strict=True))
            return SerialEvaluate(along_columns(own, wanted, columns, np.zeros(len(paths))))

        return Questions(own, forms, having, partial(fitted, spec, places=places))

    return of
