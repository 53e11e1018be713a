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
# # Your own forward model in 15 lines
#
# Everything that maps numbers to numbers is a model: a formula, a table, another program. Here: the tip deflection of
# a slender beam.

# %%
# %matplotlib inline
import numpy as np

from forward.pointwise import FunctionModel


def deflection(p):
    """Tip deflection (m) from Young's modulus (Pa), weight per length (N/m) and length (m)."""
    E, q, L = p
    return q * L**4 / (8 * E * 0.02 * 0.01**3 / 12)


def slopes(p):
    E, q, L = p
    return deflection(p) * np.array([[-1 / E, 1 / q, 4 / L]])


model = FunctionModel(deflection, ("E", "q", "L"), ("tip",), slopes)

# %% [markdown]
# Derivatives are optional; methods that need them say so. If you provide them, check them once:

# %%
from forward.conformance import check_derivatives

mean = np.array([1e6, 1.0, 0.1])
check_derivatives(model, mean, 0.1 * mean).require()

# %% [markdown]
# ## Any method takes it

# %%
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import LogNormal, Uniform
from uq.inputs.random_parameters import Inputs
from uq.methods.chaos import Chaos
from uq.methods.quasi_monte_carlo import QuasiMonteCarlo

inputs = Inputs(
    {
        "E": LogNormal(mean=1e6, std=1e5),
        "q": Uniform(lower=0.8, upper=1.2),
        "L": Uniform(lower=0.09, upper=0.11),
    }
)
for method in (Chaos(samples=20), QuasiMonteCarlo(samples=256, control="tangent")):
    found = method.run(inputs, SerialEvaluate(model)).sel(output="tip")
    print(f"{method.kind:18} {found['mean'].item():.6e} ± {found['mean_error'].item():.1e} m")

# %% [markdown]
# The exact mean is a product, since the parameters are independent: for a log-normal modulus,
# E[1/E] = (1 + v²)/1e6 with v = 0.1.

# %%
L4 = (0.11**5 - 0.09**5) / (5 * 0.02)
print(f"{'exact':18} {L4 / (8 * 0.02 * 0.01**3 / 12) * 1.01 / 1e6:.6e} m")

# %% [markdown]
# ## As a study
#
# The same function can be the model of a study, which adds findings, reports and all methods. In its own module, which
# a study names as `function = "own_beam.deflection"`, it also runs with `tissuq run`, on many processors, and can be
# interrupted and continued.

# %%
import tissuq

study = tissuq.Study(
    model={
        "kind": "python",
        "function": deflection,
        "jacobian": slopes,
        "parameters": {"E": 1e6, "q": 1.0, "L": 0.1},
        "outputs": [{"name": "tip", "unit": "m"}],
    },
    parameters={
        "E": {"kind": "log-normal", "mean": 1e6, "std": 1e5},
        "q": {"kind": "uniform", "lower": 0.8, "upper": 1.2},
        "L": {"kind": "uniform", "lower": 0.09, "upper": 0.11},
    },
    method={"kind": "chaos", "samples": 40, "seed": 1},
)
data = study.run()
data.tissuq.show()

# %%
tissuq.plots.histogram(data, "tip").figure

# %%
tissuq.plots.index_bars(data, "tip").figure
