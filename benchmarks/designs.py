"""Designs: chosen points against random ones, and chosen load cases against what synthetic inversions find.

The shipped designs are run as they are (`configs/next/inclusion-design.toml`, `field-design.toml`,
`field-prediction-design.toml`), with all criteria that apply, and that of a field with other errors. The load case is
chosen for a cube with a ball (`benchmarks.calibration`), and then specimens are drawn from the prior, measured in one
load case each, and inverted: ln p(y | truth) − ln p(y), with the evidence from weighted points, is on average the
information that was predicted, if the linearisation is right.
"""

from __future__ import annotations

import time
from argparse import ArgumentParser
from collections.abc import Sequence

import numpy as np
from mpi4py import MPI

from benchmarks.beams import CONFIG
from benchmarks.calibration import PRIORS, specimen
from forward.fem.joined import SpecimenModel
from forward.model import FloatArray, ReferenceSolution
from forward.specimen import LoadCase, Specimen
from inverse.data.noise import Noise
from inverse.low_dimensional.evidence import evidence
from inverse.low_dimensional.laplace import laplace
from inverse.low_dimensional.posterior import Posterior
from inverse.methods.design import Design
from inverse.methods.synthesize import SyntheticNoise
from uq.evaluation.evaluate import SerialEvaluate
from uq.evaluation.request import Prediction
from uq.inputs.random_parameters import Inputs
from workflows.config.study import load
from workflows.studies.design import values_of

CELLS, NOISE, SPECIMENS, DRAWS = 3, 0.02, 16, 32
SAMPLES = 64
LARGEST = 0.5  # error of an evidence (nat) that counts
PARTS = ("cases", "inclusion", "field", "noise", "prediction")
NOISES = (0.01, 0.03, 0.1, 0.3)  # of the field
CASES = {
    "shear along x": ("traction", (1.0, 0.0, 0.0)),
    "shear along y": ("traction", (0.0, 1.0, 0.0)),
    "extension": ("traction", (0.0, 0.0, 1.0)),
    "compression": ("traction", (0.0, 0.0, -1.0)),
}


def shipped(name: str, *settings: str) -> None:
    """Print how many random observations the chosen ones of a shipped design are worth."""
    begin = time.process_time()
    study = load(CONFIG.parent / "next" / f"{name}.toml", settings)
    found = study.run()
    n, equal = found.sizes["choice"], float(found["random_equal"])
    many = f"{equal:.0f}" if np.isfinite(equal) else f"more than {found.sizes['random_number']}"
    at_n = [float(found[f"random_{which}"][n - 1]) for which in ("lower", "median", "upper")]
    print(
        f"{name}, {study.method.criterion}: {n} of {found.sizes['candidate']:,} are worth {many} random ones: "
        f"{float(found['worth'][-1]):.4g} against {at_n[1]:.4g} ({at_n[0]:.4g} to {at_n[2]:.4g}); "
        f"{time.process_time() - begin:.0f} s of CPU",
        flush=True,
    )


def several() -> Specimen:
    """Return the cube in all load cases."""
    one = specimen(CELLS)
    cases = tuple(
        LoadCase.model_validate(
            {
                "name": name.replace(" ", "-"),
                "clamp": ("z-min",),
                "loads": ({"kind": kind, "on": "z-max", "direction": direction, "size": 1500.0},),
            }
        )
        for name, (kind, direction) in CASES.items()
    )
    return one.model_copy(update={"cases": cases})


def told(spec: Specimen, case: str, count: int) -> FloatArray:
    """Return ln p(y | truth) − ln p(y) (count,) of specimens of one load case; NaN where weights cannot be trusted."""
    inputs = Inputs(PRIORS)
    alone = spec.model_copy(update={"cases": tuple(one for one in spec.cases if one.name == case)})
    model = alone.build(MPI.COMM_SELF, inputs.names)
    evaluate, start = SerialEvaluate(model), started(model, inputs)
    truths = np.random.default_rng(1).standard_normal((count, len(inputs.names)))  # the same in all load cases
    gained = np.full(count, np.nan)
    for k, truth in enumerate(truths):
        clean = model.solve(inputs.from_normals(truth[None])[0][0]).outputs
        sigma = np.full(len(clean), NOISE * np.sqrt((clean**2).mean()))
        data = clean + sigma * np.random.default_rng([2, k]).standard_normal(len(clean))
        posterior = Posterior(inputs, evaluate, data, Noise(sigma), start=start)
        found = evidence(posterior, laplace(posterior, starts=1, first=truth), SAMPLES)
        if found.error < LARGEST:
            gained[k] = posterior.at(truth[None]).log_likelihood[0] - found.log_evidence
    return gained


def started(model: SpecimenModel, inputs: Inputs) -> Prediction:
    """Return the prediction of states from the medians of the prior."""
    centre = inputs.from_normals(np.zeros((1, len(inputs.names))))[0][0]
    solution = model.solve(centre)
    state, slopes = map(model.space.gather, (solution.state[None], solution.state_tangent(np.eye(len(centre)))))
    assert state is not None
    assert slopes is not None
    return Prediction(ReferenceSolution(centre, state[0], inputs.std), slopes, inputs.coordinates)


def load_cases(count: int) -> None:
    """Print what each load case is predicted to tell, and what it told."""
    spec, inputs = several(), Inputs(PRIORS)
    model = spec.build(MPI.COMM_SELF, inputs.names)
    method = Design(number=1, each="case", noise=SyntheticNoise(relative=NOISE), draws=DRAWS, seed=3)
    found = method.run(inputs, SerialEvaluate(model), values_of(spec, model))
    predicted = dict(zip(map(str, found["candidate"].values), found["candidate_information"].values, strict=True))
    chosen = str(found["candidate"][int(found["chosen"][0])].item())
    print("| load case | predicted (nat) | told in inversions (nat) |\n|---|---|---|")
    ranked = sorted(predicted, key=lambda name: -predicted[name])
    gained = {}
    for name in ranked:
        gained[name] = told(spec, name, count)
        known = gained[name][np.isfinite(gained[name])]
        error = known.std() / np.sqrt(len(known))
        words = f"{known.mean():.2f} ± {error:.2f} ({len(known)} specimens)"
        print(f"| {name} | {predicted[name]:.2f} | {words} |", flush=True)
    for name in ranked[1:]:  # on the same specimens
        more = gained[ranked[0]] - gained[name]
        more = more[np.isfinite(more)]
        by, error = predicted[ranked[0]] - predicted[name], more.std() / np.sqrt(len(more))
        print(f"{ranked[0]} over {name}: {by:.2f} predicted, {more.mean():.2f} ± {error:.2f} told")
    best = max(gained, key=lambda name: np.nanmean(gained[name]))
    print(f"chosen: {chosen}; best in {count} synthetic specimens: {best}", flush=True)


def main(words: Sequence[str] = ()) -> None:
    """Print what chosen observations are worth."""
    parser = ArgumentParser(prog="designs")
    parser.add_argument("--specimens", type=int, default=SPECIMENS)
    parser.add_argument("--only", choices=PARTS, nargs="*", default=PARTS, help="all of them take a quarter of an hour")
    options = parser.parse_args(words)
    if "cases" in options.only:
        load_cases(options.specimens)
    if "inclusion" in options.only:
        shipped("inclusion-design")
        shipped("inclusion-design", "method.criterion=parameters")
    if "field" in options.only:
        shipped("field-design")
        shipped("field-design", "method.criterion=parameters")
    for noise in NOISES if "noise" in options.only else ():
        shipped("field-design", "method.draws=2", "method.mesh_error=false", f"method.noise.relative={noise}")
    if "prediction" in options.only:
        shipped("field-prediction-design")
