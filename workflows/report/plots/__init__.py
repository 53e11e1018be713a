"""Pictures of results: one function each, from the dataset of `read_dataset` to labelled axes.

Functions with an argument `ax` draw there, or on a new figure that needs no display: in a notebook,
``plots.histogram(dataset, "uy_max").figure``. Bodies are drawn by `workflows.report.bodies`.
"""

from workflows.report.plots import inversion as inversion
from workflows.report.plots import places as places
from workflows.report.plots import posterior as posterior
from workflows.report.plots import selection as selection
from workflows.report.plots.accuracy import error_budget as error_budget
from workflows.report.plots.accuracy import errors as errors
from workflows.report.plots.accuracy import mesh_cost as mesh_cost
from workflows.report.plots.accuracy import mesh_mean as mesh_mean
from workflows.report.plots.accuracy import mesh_samples as mesh_samples
from workflows.report.plots.accuracy import mesh_variance as mesh_variance
from workflows.report.plots.accuracy import refinement as refinement
from workflows.report.plots.figure import CONTROLLED as CONTROLLED
from workflows.report.plots.figure import DARK as DARK
from workflows.report.plots.figure import HIGH as HIGH
from workflows.report.plots.figure import axes as axes
from workflows.report.plots.figure import png as png
from workflows.report.plots.figure import svg as svg
from workflows.report.plots.outputs import BARS as BARS
from workflows.report.plots.outputs import active_summary as active_summary
from workflows.report.plots.outputs import comparison as comparison
from workflows.report.plots.outputs import convergence as convergence
from workflows.report.plots.outputs import histogram as histogram
from workflows.report.plots.outputs import index_bars as index_bars
from workflows.report.plots.outputs import index_convergence as index_convergence
from workflows.report.plots.outputs import index_shares as index_shares
from workflows.report.plots.outputs import tornado as tornado
