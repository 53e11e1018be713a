"""Pictures of results: one function each, from the dataset of `read_dataset` to labelled axes.

Functions with an argument `ax` draw there, or on a new figure that needs no display: in a notebook,
``plots.histogram(dataset, "uy_max").figure``. Those of inversions, of posteriors, of comparisons of models and of what
is where on a body are in the modules `inversion`, `posterior`, `selection` and `places`; bodies are drawn by
`workflows.report.bodies`.
"""

from workflows.report.plots import inversion, places, posterior, selection
from workflows.report.plots.accuracy import (
    error_budget,
    errors,
    levels,
    mesh_cost,
    mesh_mean,
    mesh_samples,
    mesh_variance,
    refinement,
    tolerance_bars,
)
from workflows.report.plots.figure import COLOURS, CONTROLLED, DARK, HIGH, LOW, PLAIN, axes, grid, png, span, svg
from workflows.report.plots.indices import (
    BARS,
    active_summary,
    index_bars,
    index_convergence,
    index_shares,
    spectrum,
    tornado,
)
from workflows.report.plots.moments import comparison, convergence, histogram, running_estimates, standard_error

__all__ = [
    "BARS",
    "COLOURS",
    "CONTROLLED",
    "DARK",
    "HIGH",
    "LOW",
    "PLAIN",
    "active_summary",
    "axes",
    "comparison",
    "convergence",
    "error_budget",
    "errors",
    "grid",
    "histogram",
    "index_bars",
    "index_convergence",
    "index_shares",
    "inversion",
    "levels",
    "mesh_cost",
    "mesh_mean",
    "mesh_samples",
    "mesh_variance",
    "places",
    "png",
    "posterior",
    "refinement",
    "running_estimates",
    "selection",
    "span",
    "spectrum",
    "standard_error",
    "svg",
    "tolerance_bars",
    "tornado",
]
