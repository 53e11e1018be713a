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
# # Error against time
#
# How large is the true error of a method, and what does it cost? `compare` runs methods with increasing numbers
# of samples, each several times, against a reference. This notebook uses the coarse beam, or the directory in
# `TISSUQ_COMPARISON`, such as `results/beam-compare`.

# %%
# %matplotlib inline
import os
import tempfile
import tomllib
from pathlib import Path

import tissuq
from uq.estimators.scores import gains

METHOD = """
kind = "compare"
repeats = 3
textbook = 0
seed = 1
reference = { kind = "chaos", fit = "projection", max_order = 5 }
methods = [
    { kind = "monte-carlo", budgets = [8, 32] },
    { kind = "sensitivity-monte-carlo", budgets = [8, 32] },
    { kind = "quasi-monte-carlo", control = "tangent", scrambles = 8, budgets = [16, 32] },
    { kind = "chaos", max_order = 4, budgets = [4, 8, 12] },
]
"""

CONFIGS = next(path for path in (Path("configs"), Path("../configs")) if path.exists())
directory = Path(os.environ.get("TISSUQ_COMPARISON") or tempfile.mkdtemp())
if not (directory / "results.nc").exists():
    study = tomllib.loads((CONFIGS / "tiny.toml").read_text()) | {"method": tomllib.loads(METHOD)}
    tissuq.Study(**study).run(directory)
data = tissuq.read(directory)

# %% [markdown]
# ## Errors of the mean
#
# Root mean square over the repeats; costs include set-up. Hollow markers are below the resolution of the reference.

# %%
output = str(data["output"].values[0])
tissuq.plots.errors(data, output, "mean", "solves").figure

# %%
tissuq.plots.errors(data, output, "mean", "cpu_seconds").figure

# %% [markdown]
# ## Are claimed errors honest?
#
# A method claims a standard error with each estimate. Over the repeats, the claims (`mean_claimed`) should be
# about as large as the true errors (`mean_rmse`). With three repeats both are known only to 40 %; more repeats tell
# more.

# %%
one = data.sel(output=output)
table = one[["row_method", "budget", "solves", "mean_rmse", "mean_claimed", "mean_coverage"]].to_dataframe()
table.drop(columns=["output", "unit"], errors="ignore")

# %% [markdown]
# ## The gain of a method
#
# Plain Monte Carlo needs σ²/error² samples for the same error. The gain is that number divided by the method's solves.

# %%
worth = gains(one, "mean")["solves"].values
for name, budget, gain in zip(one["row_method"].values, one["budget"].values, worth, strict=True):
    print(f"{name:28} {int(budget):4} samples: {gain:.3g}")
