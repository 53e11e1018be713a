# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Comparing materials
#
# Treloar stretched rubber in three ways. Which law do his tests support? This notebook has three candidates and few
# solves; `configs/treloar.toml` has five, and `TISSUQ_SELECTION=results/treloar` shows that study.

# %%
# %matplotlib inline
import os
import tempfile
import tomllib
from pathlib import Path

import tissuq
from tissuq import plots
from workflows.config.study import parse
from workflows.results.comparison import findings

STUDY = """
[data]
file = "data/treloar.csv"
measured = "P_MPa"
unit = 1e6
modes = { pure_shear = "pure-shear" }

[candidates.neo-hookean]
material = { kind = "neo-hookean" }
parameters.C1 = { kind = "log-normal", mean = 2e5, std = 1e5 }

[candidates.mooney-rivlin]
material = { kind = "mooney-rivlin" }
parameters.C1 = { kind = "log-normal", mean = 2e5, std = 1e5 }
parameters.C2 = { kind = "uniform", lower = 0, upper = 2e5 }

[candidates.gent]
material = { kind = "gent" }
parameters.mu = { kind = "log-normal", mean = 4e5, std = 2e5 }
parameters.Jm = { kind = "log-uniform", lower = 60, upper = 300 }

[method]
kind = "select"
samples = 64
seed = 1
noise = { relative = 0.05, absolute = 5e3, factor = { kind = "log-uniform", lower = 0.2, upper = 20 } }
subsets = { "uniaxial tension alone" = ["uniaxial"] }
"""

CONFIGS = next(path for path in (Path("configs"), Path("../configs")) if path.exists())
directory = Path(os.environ.get("TISSUQ_SELECTION") or tempfile.mkdtemp())
if not (directory / "results.nc").exists():
    tissuq.run(parse(tomllib.loads(STUDY), folder=CONFIGS), directory)
data = tissuq.read(directory)
print(*findings(data), sep="\n")

# %% [markdown]
# ## Evidence
#
# ln Z of each model minus the largest, with three standard errors. First: can all of them be trusted?

# %%
data["trusted"].to_pandas()

# %%
plots.selection.evidence_bars(data).figure

# %% [markdown]
# ## What the ranking depends on
#
# Other errors, part of the data, priors half and twice as wide.

# %%
plots.selection.probability_bars(data).figure

# %% [markdown]
# ## Is the best one any good?
#
# The most probable candidate may still be wrong. If a model were true, residuals at least as large as these, and
# neighbours that agree at least as much, would have these probabilities:

# %%
data[["misfit_probability", "correlation_probability"]].min("group").to_pandas()

# %%
group = str(data["group"].values[0])
test = str(data["output_test"].values[0])
plots.selection.curves(data, group, test).figure

# %% [markdown]
# ## Posteriors of the constants
#
# Points of the best model with their weights; the crosses are the modes.

# %%
best = str(data["model"].values[data["log_evidence"].argmax().item()])
plots.selection.corner(data, best, group).figure

# %% [markdown]
# Any other picture takes a few lines of matplotlib on `plots.axes()`: the predicted stress at the last stretch,
# with the disagreement of the models.

# %%
last = data.isel(output=[i for i, name in enumerate(data["output_test"].values) if name == test][-1])
ax = plots.axes()
names = [str(name) for name in data["model"].values]
low, high = last["prediction_quantiles"].sel(quantile=[0.05, 0.95]).transpose("quantile", "model").values / 1e6
middle = last["prediction_mean"].values / 1e6
ax.errorbar(range(len(names)), middle, yerr=[middle - low, high - middle], fmt="o", color=plots.CONTROLLED, capsize=4)
ax.axhline(float(last["measured"]) / 1e6, color=plots.DARK, linestyle="--", label="measured")
ax.set_xticks(range(len(names)), names)
ax.set_ylabel(f"stress of {test} at {float(last['output_at']):.3g} (MPa)")
ax.legend()
ax.figure
