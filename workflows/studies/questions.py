"""What inversions ask of the shape of a body: the model with what it could have besides."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix

from forward.affine import Sparse
from forward.combine import Mapped
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
            by = np.zeros((len(own.parameters), len(wanted)))
            by[range(len(names)), [wanted.index(name) for name in names]] = 1.0
            by[len(names) :, [i for i, name in enumerate(wanted) if name not in names]] = patterns.T
            return SerialEvaluate(Mapped(own, Sparse(csr_matrix(by), np.zeros(len(by))), tuple(wanted)))

        return Questions(own, forms, having, partial(fitted, spec, places=places))

    return of
