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
# # Moments and Sobol' indices of a finished study
#
# A study writes one file, `results.nc`, that xarray reads. This notebook reads the directory in
# `TISSUQ_RESULTS`; if that is not set, it runs a coarse beam first, which takes a few seconds.

# %%
# %matplotlib inline
import os
import tempfile
from pathlib import Path

import tissuq

CONFIGS = next(path for path in (Path("configs"), Path("../configs")) if path.exists())
directory = Path(os.environ.get("TISSUQ_RESULTS") or tempfile.mkdtemp())
if not (directory / "results.nc").exists():
    method = "method={kind='sobol', design='chaos', samples=15, second_order=true}"
    tissuq.load(CONFIGS / "tiny.toml", [method]).run(directory)
data = tissuq.read(directory)
data

# %% [markdown]
# ## What it says
#
# The answers with their errors, what is doubtful about them, and the body, which turns.

# %%
data.tissuq.show()

# %% [markdown]
# ## What it contains
#
# Every estimate `x` has its standard error beside it, `x_error`. Units are in the coordinate `unit`.

# %%
table = data[["mean", "mean_error", "std", "std_error"]].to_dataframe()
table

# %% [markdown]
# ## Which parameter matters
#
# The total index of a parameter is the share of the variance that would remain if all others were known.

# %%
data["sobol_total"].to_pandas().round(4)

# %%
output = str(data["output"].values[0])
tissuq.plots.index_bars(data, output).figure

# %%
tissuq.plots.index_shares(data).figure

# %% [markdown]
# To first order, derivatives at the mean parameters show the same, at the cost of one solve:

# %%
tissuq.plots.tornado(data, output).figure

# %% [markdown]
# ## Where on the body
#
# Indices of the displacement at every node.

# %%
strongest = str(data["parameter"].values[data["field_sobol_total"].argmax().item()])
tissuq.bodies.body(data, f"Total index of the displacement for {strongest}")

# %% [markdown]
# The data behind the picture are plain arrays, one row for each node:

# %%
moving = data["node_sobol_total"].sum("parameter") > 0
data["node_sobol_total"].isel(node=moving.values).to_pandas().T.describe().loc[["min", "mean", "max"]]
