"""Starter studies: what `tissuq init` prints."""

from __future__ import annotations

from forward.settings import nearest
from workflows.config.mistakes import StudyError

_MODEL = """\
# A study of tissuq. SI units throughout. Check it with `tissuq check FILE`, run it with `mpirun -n 2 tissuq run FILE`.

[model]
kind = "hyperelastic"
# A box [0, size] in m; its boundaries are x-min, x-max, y-min, y-max, z-min and z-max.
# kind = "block" has corners = [...] instead: the images of the corners of a cube, x goes first, then y, then z.
# kind = "mesh" has file = "liver.msh" (or .xdmf, .vtk, .vtu) and unit = 1e-3: its groups are boundaries and regions.
# A model of another program instead of a body: kind = "python" or "um-bridge", see README.
# cell = "hexahedron" | "tetrahedron", degree = 1 | 2
body = { kind = "box", size = [0.1, 0.02, 0.02], cells = [8, 2, 2], cell = "hexahedron", degree = 2 }
# In Pa, except for the ratios Jm and b: "mooney-rivlin" (C1, C2, D1), "neo-hookean" (C1, D1),
# "yeoh" (C10, C20, C30, D1), "gent" (mu, Jm, D1), "demiray" (a, b, D1), "neo-hookean-coupled" (mu, lmbda),
# "saint-venant-kirchhoff" (lmbda, mu), "blatz-ko" (mu).
material = { kind = "mooney-rivlin", C1 = 1e4, C2 = 2e4, D1 = 2e5 }
# Others: neo-hookean, neo-hookean-coupled, yeoh, gent, demiray, ogden, saint-venant-kirchhoff, blatz-ko, and
# holzapfel-gasser-ogden, c = 2e4, k1 = 1e4, k2 = 1, D1 = 2e5, fibres = [[1, 1, 0], [1, -1, 0]]
# formulation = "mixed"  # or "displacement"; by default mixed if the bulk modulus may be above 3 shear moduli
# Balls of `contrast` times the stiffness of the body around them; `width` is that of the smooth transition (m):
# (kind = "ellipsoid" has radii a, b, c and a rotation vector turn_x, turn_y, turn_z (rad) instead of a radius)
# inclusions = [{ name = "tumour", x = 0.05, y = 0.01, z = 0.01, radius = 6e-3, contrast = 9, width = 3e-3 }]
# A random factor on the stiffness (or the density), log-normal, that varies over the body; its modes are parameters:
# fields = [{ of = "stiffness", length = 0.03, std = 0.3, modes = 10 }]
clamp = ["x-min"]
# Boundaries that are moved by a given amount (m), component by component:
# displacements = [{ on = "x-max", x = 0.01 }]
loads = [
    { kind = "gravity", direction = [0, -1, 0], density = 1000 },
    # { kind = "traction", on = "x-max", direction = [0, 0, 1], size = 100 },
    # { kind = "pressure", on = "y-max", size = 50 },
    # { kind = "spot", on = "y-max", direction = [0, -1, 0], size = 0.1, x = 0.1, y = 0.02, z = 0.01, width = 0.005 },
]
# max-displacement (component x, y, z or magnitude), displacement (at, component), mean-displacement (on, component),
# reaction (on, component), strain-energy, volume-change, max-von-mises
outputs = [
    { name = "sag", kind = "max-displacement", component = "y" },
    { name = "energy", kind = "strain-energy" },
]
# Refine the mesh first, until the errors that it makes of outputs are 1 % (body.cell = "tetrahedron"):
# adapt = { tolerance = 0.01, outputs = ["sag"] }
# solver = { tolerance = 1e-8 }  # or solver = "newton": the textbook, from zero with a new factor for every step

[parameters]
# Any number of the model by its path: material.*, loads.<name or kind>.density|size, displacements.<name or boundary>.x
# inclusions.<name or kind>.contrast|radius|x|y|z|width (or a|b|c|turn_x|turn_y|turn_z of an ellipsoid)
# regions.<name>.contrast|<constant>, in a mesh from a file
# uniform, log-uniform, triangular, beta, truncated-normal, normal, log-normal, gamma
"material.C1" = { kind = "uniform", lower = 0.5e4, upper = 1.5e4 }
"loads.gravity.density" = { kind = "truncated-normal", mean = 1000, std = 50, lower = 800, upper = 1200 }

# [[correlations]]
# between = ["material.C1", "loads.gravity.density"]
# value = 0.3

[method]
"""

_METHODS = {
    "monte-carlo": """\
kind = "monte-carlo"
samples = 200         # or tolerance = 0.01 (standard errors over means), or budget_seconds = 600: whichever comes first
seed = 1
quantiles = [0.05, 0.5, 0.95]
fields = true         # mean and standard deviation of the displacement at every node
""",
    "sensitivity-monte-carlo": """\
kind = "sensitivity-monte-carlo"
samples = 100         # or tolerance = 0.01 (standard errors over means), or budget_seconds = 600: whichever comes first
seed = 1
coefficient = "one"   # or "optimal": estimated on the samples
second_moment = "quadratic"   # or "linear": the published form
fields = true         # mean and standard deviation of the displacement at every node
""",
    "quasi-monte-carlo": """\
kind = "quasi-monte-carlo"
samples = 256         # scrambles × a power of two; or tolerance = 0.001, or budget_seconds = 600: whichever comes first
scrambles = 16        # independent randomisations of the Sobol' points: their scatter is the error
control = "tangent"   # or "none"; "quadratic": two more solves for each parameter; "chaos": a fit to separate samples
coefficient = "one"   # or "optimal": regression over the scrambles
seed = 1
fields = true         # mean and standard deviation of the displacement at every node
""",
    "multilevel-monte-carlo": """\
kind = "multilevel-monte-carlo"
tolerance = 0.01      # total error (mesh and sampling) of means, relative; or budget_seconds = 600, or samples = 100 on
                      # the coarsest mesh: whichever comes first
levels = 3            # meshes; the body above is the coarsest, and each one halves the cells of the one before
pilot = 8             # samples on every mesh before the numbers are chosen
control = "tangent"   # or "none"
seed = 1
""",
    "multifidelity": """\
kind = "multifidelity"
samples = 64          # what may be spent, in solves of the model above; or tolerance = 1e-3, or budget_seconds = 600
# One to six cheap models, with the same parameters and outputs; `cost`: a solve, over one of the model above.
cheap = [
    { kind = "mesh", coarser = 2 },           # cells twice as long; degree = 1: linear ones
    { kind = "iterations", iterations = 2 },  # the model above, stopped early
    # { kind = "model", name = "beam theory", cost = 1e-4, model = { kind = "python", function = "my_beam.sag", ... } },
]
control = "auto"      # their tangents are taken off first, and an expansion takes their place where it is better
seed = 1
""",
    "reduce": """\
kind = "reduce"       # `tissuq reduce` runs it too, of any study that samples a body (formulation = "displacement")
snapshots = 96        # solves of which it is made: half of them even, the others where estimated errors are largest
rounds = 3            # in which those are drawn
# modes = 40          # by default as many as truncation = 2e-3 needs
cubature = 1e-3       # what the points may miss of the forces of the snapshots
unseen = 32           # further solves, on which its errors are measured
seed = 1
""",
    "chaos": """\
kind = "chaos"
samples = 15          # or tolerance = 1e-3 (leave-one-out error / std), or budget_seconds = 600: whichever comes first
max_order = 6         # order and terms up to it are chosen by the leave-one-out error
gradients = true      # fit the derivatives too: d + 1 rows for every solve
fit = "regression"    # or "projection": (max_order + 2)^d Gauss points and no samples
seed = 1
quantiles = [0.05, 0.5, 0.95]
fields = true         # expand the displacement at every node
""",
    "multilevel-chaos": """\
kind = "multilevel-chaos"
iterations = 2        # of the solver for each sample of a level
tolerance = 1e-3      # relative change of the moments from level to level
order = 3             # of the expansion
samples = 32          # of each level; by default at least three for each term
max_levels = 10
first = "tangent"     # where the first level starts; or "mean": the state at the mean parameters, as published
seed = 1
quantiles = [0.05, 0.5, 0.95]
fields = true         # mean, standard deviation and expansion of the displacement at every node
""",
    "compare": """\
kind = "compare"
repeats = 20          # independent repeats of every method: errors are known to 16 %
seed = 1
textbook = 8          # draws that are also solved by Newton's method from zero: the cost of plain Monte Carlo with it
mesh_error = false    # true: solve once with twice the cells in each direction
# A method, solved to tighter tolerances, or { kind = "given", values = { sag = { mean = ..., std = ... }, ... } }:
reference = { kind = "chaos", fit = "projection", max_order = 8 }
# Blocks of methods, with the numbers of samples that they are run with:
methods = [
    { kind = "monte-carlo", budgets = [16, 64, 256] },
    { kind = "sensitivity-monte-carlo", budgets = [16, 64, 256] },
    { name = "tangent", kind = "quasi-monte-carlo", control = "tangent", budgets = [64, 256] },
    { name = "quadratic", kind = "quasi-monte-carlo", control = "quadratic", budgets = [64, 256] },
    { kind = "chaos", max_order = 4, budgets = [5, 10, 15] },
]
""",
    "sobol": """\
kind = "sobol"
design = "chaos"      # from values and gradients at few points; or "saltelli": exchanged Sobol' points, samples = rows,
                      # scrambles × a power of two, of d + 2 solves each; or "given-data", source = "results/DIRECTORY"
samples = 15          # or tolerance = 1e-3 (leave-one-out error / std; error of an index), or budget_seconds = 600
second_order = true   # the share of every pair of parameters
# groups = { load = ["loads.gravity.density"] }   # indices of several parameters together
seed = 1
fields = true         # indices of the displacement field, and at every node
""",
    "derivative-based": """\
kind = "derivative-based"
samples = 128         # scrambles × a power of two; or tolerance = 0.01 (error of a bound), or budget_seconds = 600
scrambles = 32        # independent randomisations of the Sobol' points: their scatter is the error
seed = 1
""",
    "local-sensitivity": """\
kind = "local-sensitivity"
""",
}


_SELECTION = """\
# A comparison of material models with tissuq. Check it with `tissuq check FILE`, run it with `tissuq run FILE`.
# For models of a specimen given its displacements see configs/inclusion-material.toml.

[data]
# Tests, here in full. Or a table beside this file, whose lines with # are kept as its source:
# file = "table.csv"; names of its columns: mode, at, measured and, if there are any, across, sigma, group; unit in Pa;
# modes = { word = "mode" } translates, where = { column = "word" } and between = [1, 4] choose rows. Each group has
# constants of its own.
# mode = "uniaxial" | "equibiaxial" | "biaxial" | "pure-shear" | "simple-shear", stress = "nominal" | "cauchy"
tests = [
    { mode = "uniaxial", at = [0.9, 1.1, 1.2, 1.3], measured = [-330, 280, 520, 750] },
    { mode = "simple-shear", at = [0.1, 0.2, 0.3], measured = [99, 205, 298] },
]

# A candidate: constants that do not vary stand in material, priors of the others in parameters. Without D1, an energy
# that has it is that of an incompressible material. Energies as of other studies.
[candidates.neo-hookean]
material = { kind = "neo-hookean" }
parameters.C1 = { kind = "log-normal", mean = 500, std = 300 }

[candidates.mooney-rivlin]
material = { kind = "mooney-rivlin" }
parameters.C1 = { kind = "log-normal", mean = 500, std = 300 }
parameters.C2 = { kind = "uniform", lower = 0, upper = 500 }
# weight = 1          # its probability before the data, up to a common factor

[method]
"""

_METHODS["select"] = """\
kind = "select"
samples = 256         # solves for each evidence
seed = 1
# Standard deviation of the errors: max(relative × stress, absolute), or that of the data; times a factor, if unknown.
noise = { relative = 0.05, absolute = 10 }  # factor = { kind = "log-uniform", lower = 0.2, upper = 20 }
other_noises = { "twice the errors" = { relative = 0.1, absolute = 20 } }
subsets = { "tension alone" = ["uniaxial"] }
# held_out = true     # predict every test from the others, too
# check = "dynesty"   # nested sampling beside it, for minutes
"""


_SPECIMEN = """\
# What is inside a specimen, with tissuq. SI units throughout. Check it with `tissuq check FILE`, run it with
# `tissuq run FILE`.

[model]
kind = "specimen"
# As of other studies, but for loads and outputs: bodies, materials, inclusions, fields.
body = { kind = "box", size = [0.05, 0.05, 0.05], cells = [4, 4, 4], cell = "hexahedron", degree = 2 }
material = { kind = "neo-hookean-coupled", mu = 1e3, lmbda = 4e3 }
inclusions = [{ name = "lump", x = 0.025, y = 0.025, z = 0.025, radius = 0.012, contrast = 4, width = 8e-3 }]
# Load cases, each with clamp, displacements and loads as of other studies.
[[model.cases]]
name = "pull"
clamp = ["z-min"]
loads = [{ kind = "traction", on = "z-max", direction = [0, 0, 1], size = 100 }]
"""

_INVERT = """
[parameters]
# Priors of the numbers that are unknown, by their paths. Or none, and a field whose values at the vertices are:
# model.fields = [{ of = "stiffness", length = 0.02, std = 0.5, basis = "nodes" }]
"inclusions.lump.x" = { kind = "uniform", lower = 0.01, upper = 0.04 }
"inclusions.lump.contrast" = { kind = "log-uniform", lower = 1, upper = 16 }

[data]
# Tables with the columns x, y, z, any of ux, uy, uz, optionally sigma and case (empty cells: not measured), or meshes
# that meshio reads; files, folders or patterns. Each is a data set by itself.
files = ["measured.csv"]
sigma = 2e-5          # standard deviation (m) of the errors, where a file does not say
# unit = 1e-3         # m per unit of the files
# tolerance = 1e-4    # how far (m) points may lie outside the body; by default a thousandth of it

[method]
"""

_SYNTHESIZE = """

# What is measured: all nodes of boundaries, or points (at = [[x, y, z], …]).
[[model.observed]]
on = "z-max"

[parameters]
# What is drawn for each data set.
"inclusions.lump.x" = { kind = "uniform", lower = 0.015, upper = 0.035 }

[method]
"""

_METHODS["invert"] = """\
kind = "invert"
samples = 64          # solves that correct Laplace's Gaussian; of a field, 192 check it and 0 is none
starts = 2            # of the search for the mode
# noise = { kind = "log-uniform", lower = 0.2, upper = 5 }   # of a factor on all sigma, if their size is unknown
# chains = "pcn"      # Markov chains beside it; or "emcee"
seed = 1
"""

_METHODS["synthesize"] = """\
kind = "synthesize"
noise = { relative = 0.01 }   # of the root mean square of the displacements of a load case; or absolute (m)
fraction = [0.5, 0.1]         # of the points, for each data set
missing = 0.0                 # share of components that are lost
seed = 1
"""
_HEADS = {
    "select": _SELECTION,
    "invert": _SPECIMEN + _INVERT,
    "synthesize": _SPECIMEN + _SYNTHESIZE,
    # a reduced model has no pressures among its unknowns
    "reduce": _MODEL.replace(
        '# formulation = "mixed"  # or "displacement";', 'formulation = "displacement"  # not "mixed";'
    ),
}


def starter(kind: str) -> str:
    """Return a commented study that runs as it is; for the kind "list", the names of all kinds, one a line.

    Raises
    ------
    StudyError
        If there is no method of that kind.
    """
    if kind == "list":
        return "".join(f"{name}\n" for name in _METHODS)
    if kind not in _METHODS:
        message = f"init {kind}: unknown kind of study; {nearest(kind, tuple(_METHODS))}"
        raise StudyError(message)
    return _HEADS.get(kind, _MODEL) + _METHODS[kind]
