"""Candidates for rubber and Treloar's data, for the tests of inversion."""

from functools import cache
from pathlib import Path

import numpy as np

from forward.materials.material_point import HomogeneousModel
from inverse.data.noise import Noise
from inverse.low_dimensional.posterior import Posterior
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import Distribution, LogNormal, LogUniform, Normal, Uniform
from uq.inputs.random_parameters import Inputs
from workflows.config.study import load
from workflows.studies.selection import Selection

CONFIGS = Path(__file__).parent.parent / "configs"
FACTOR = LogUniform(lower=0.2, upper=20.0)
LINEAR: dict[str, dict[str, Distribution]] = {
    "neo-hookean": {"C1": Normal(mean=2e5, std=1e5)},
    "mooney-rivlin": {"C1": Normal(mean=2e5, std=1e5), "C2": Normal(mean=0.0, std=1e5)},
    "yeoh": {
        "C10": Normal(mean=2e5, std=1e5),
        "C20": Normal(mean=0.0, std=5e3),
        "C30": Normal(mean=50.0, std=100.0),
    },
}
CURVED = {
    "gent": {"mu": LogNormal(mean=4e5, std=2e5), "Jm": LogUniform(lower=60.0, upper=300.0)},
    "demiray": {"a": LogNormal(mean=4e5, std=2e5), "b": Uniform(lower=0.001, upper=0.05)},
}


@cache
def treloar() -> Selection:
    """The shipped study."""
    study = load(CONFIGS / "treloar.toml")
    assert isinstance(study, Selection)
    return study


def on_treloar(kind: str, priors: dict[str, Distribution], noise: Distribution | None = None) -> Posterior:
    """The posterior of a material given all three tests, with errors of 5 %."""
    study = treloar()
    data = study.data_groups["all"]
    model = HomogeneousModel(kind, {}, study.data.tests, tuple(priors))
    sigma = np.maximum(0.05 * data.values, 5e3)
    return Posterior(Inputs(priors), SerialEvaluate(model), data.values, Noise(sigma, factor=noise))
