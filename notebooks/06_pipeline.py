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
# # From tests of a tissue to a prediction, and to the next test
#
# A small version of `docs/how-to/pipeline.md`: which law do tests of the brain support, what are its regions like as a
# population, how does a body of that tissue deform, and which test of a new region would tell most? Each study uses
# what the one before has left.

# %%
# %matplotlib inline
import tempfile
from pathlib import Path

import tissuq

CONFIGS = next(path for path in (Path("configs"), Path("../configs")) if path.exists()).resolve()
results = Path(tempfile.mkdtemp())


def done(name, *changes):
    """Run a study of `configs`, with changes, and return its results."""
    return tissuq.load(CONFIGS / f"{name}.toml", changes).run(results / Path(name).stem)


# %% [markdown]
# ## Which law, with which constants
#
# Few solves, without the variants of the full study.

# %%
brain = done("brain", "method.samples=32", "method.starts=1", "method.other_noises={}", "method.subsets={}")
brain[["probability", "stacking"]].to_dataframe().round(3)

# %%
tissuq.plots.selection.probability_bars(brain).figure

# %% [markdown]
# ## What is a region like that was not tested?

# %%
population = done("next/brain-population", f"method.source='{results}/brain'", "method.draws=200")
population["new_quantiles"].to_pandas().round(1)

# %% [markdown]
# ## A body of that tissue
#
# A block of cortex under its own weight, with every candidate that is not improbable. `configs/next/organ-brain.toml`
# does this with an organ.

# %%
body = done(
    "next/organ-brain",
    "model.body={kind='box', size=[0.02, 0.02, 0.01], cells=[2, 2, 1]}",
    "model.clamp=['z-min']",
    "model.loads=[{kind='gravity', direction=[0, 0, -1], density=1040}]",
    "model.outputs=[{name='sag', kind='mean-displacement', on='z-max', component='z'}]",
    f"parameters.from.file='{results}/brain'",
    "method.samples=6",
)
body[["mean", "std", "within", "between"]].to_dataframe()

# %%
tissuq.plots.selection.parts_of_variance(body).figure

# %% [markdown]
# ## Which test next?
#
# The population is what is known of a region before it is tested.

# %%
design = done(
    "next/brain-design",
    f"parameters.from='{results}/brain-population'",
    "model.body.cells=[1, 1, 1]",
    "method.draws=2",
    "method.number=2",
)
design[["candidate_information", "candidate_cost"]].to_dataframe().round(3)
