"""Pictures of results: one function each, from the dataset of `read_dataset` to labelled axes.

Functions with an argument `ax` draw there, or on a new figure that needs no display: in a notebook,
``plots.histogram(dataset, "uy_max").figure``. Those of inversions and of comparisons of models are in `inversion` and
`selection`; bodies are drawn by `workflows.report.bodies`.
"""

from workflows.report.plots import inversion, selection
from workflows.report.plots.against_cost import Cost, errors
from workflows.report.plots.averaged import parts_of_variance
from workflows.report.plots.budget import error_budget
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
from workflows.report.plots.moments import (
    Estimated,
    comparison,
    convergence,
    histogram,
    running_estimates,
    standard_error,
)
from workflows.report.plots.multilevel import levels, mesh_cost, mesh_mean, mesh_samples, mesh_variance, refinement
from workflows.report.plots.tolerance import tolerance_bars

__all__ = [
    "BARS",
    "COLOURS",
    "CONTROLLED",
    "DARK",
    "HIGH",
    "LOW",
    "PLAIN",
    "Cost",
    "Estimated",
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
    "parts_of_variance",
    "png",
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
