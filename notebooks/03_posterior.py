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
# # Exploring a posterior
#
# A cube was sheared, compressed and extended; displacements of four faces were measured. What do they say about
# the stiffness inside? The study is `configs/stiffness-field.toml`, here on a mesh of 4³ cells, for speed;
# `TISSUQ_INVERSION=results/stiffness-field` shows the full one.
#
# The error of such a coarse mesh is larger than that of the data. The full study finds and corrects it by solves on
# finer meshes, which take minutes and are left out here (`method.mesh_error`). Instead, the size of the errors is
# inferred by `method.noise`; the findings below, which are also at the top of the report, say whether that was enough.

# %%
# %matplotlib inline
import os
import tempfile
from pathlib import Path

import numpy as np

import tissuq

CONFIGS = next(path for path in (Path("configs"), Path("../configs")) if path.exists())
directory = Path(os.environ.get("TISSUQ_INVERSION") or tempfile.mkdtemp())
if not (directory / "results.nc").exists():
    coarse = ["model.body.cells=[4, 4, 4]", "method.mesh_error=false"]
    noise = "method.noise={kind='log-uniform', lower=0.5, upper=20}"
    tissuq.load(CONFIGS / "stiffness-field.toml", [*coarse, noise]).run(directory)
data = tissuq.read(directory)
one = data.isel(data_set=0)
print(*(f"{one.severity}: {one.text}" for one in tissuq.findings(data)), sep="\n")

# %% [markdown]
# ## What was found
#
# The logarithm of the stiffness factor on a plane: truth (these data were made with a finer mesh), mean of the
# posterior, and its standard deviation beside that of the prior.

# %%
cut = tissuq.plots.inversion.Cut.of(one)
tissuq.plots.inversion.slices(one, cut).figure

# %% [markdown]
# ## How much is from the data: the spectrum
#
# λ compares the data with the prior, direction by direction. Above 1, the data say more; below, the picture shows the
# prior. The posterior width of a direction is that of the prior divided by √(1 + λ).

# %%
tissuq.plots.inversion.spectrum(one).figure

# %%
eigenvalues = one["eigenvalue"].values
eigenvalues = eigenvalues[np.isfinite(eigenvalues)]
seen = int((eigenvalues > 1).sum())
print(f"{seen} directions of {one.sizes['node']} have λ > 1; determined in all: {float(one['determined']):.1f}")

# %% [markdown]
# ## Which directions
#
# The data determine the first ones best, and the last ones hardly: fine variations, and those far from the measured
# faces.

# %%
tissuq.plots.inversion.direction_slices(one, cut).figure

# %% [markdown]
# Each load case alone determines less:

# %%
tissuq.plots.inversion.alone_slices(one, cut).figure

# %% [markdown]
# ## Draws, and what they predict
#
# Draws from the posterior are fields that agree with the data and the prior; a quantity computed from each of them
# has the distribution of a prediction. Here the mean stiffness factor of the upper and of the lower half:

# %%
draws = np.exp(one["stiffness_draw"].values)  # ln of the factor: (sample, node)
upper = one["node_position"].sel(axis="z").values > 0.5 * float(one["node_position"].sel(axis="z").max())
ax = tissuq.plots.axes()
for name, nodes in (("upper half", upper), ("lower half", ~upper)):
    ax.hist(draws[:, nodes].mean(axis=1), bins=12, alpha=0.6, label=name)
ax.set_xlabel("mean stiffness factor of the nodes")
ax.set_ylabel("draws")
ax.legend()
ax.figure

# %% [markdown]
# ## Does the model explain the data?
#
# |r|² of each load case beside its expected value: a bar far above its mark means that the mesh, the material or the
# stated errors are wrong. The coarse mesh fails here although the size of the errors was inferred: its error is larger
# in one load case than in another, and smooth, so residuals of neighbours agree. The full study, on 12³ cells and with
# the errors as stated, passes: probability 0.26 of larger residuals, 0.08 of neighbours that agree more. Do not
# interpret a posterior that has not passed this test.

# %%
tissuq.plots.inversion.misfits(one).figure
