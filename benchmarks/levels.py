"""Multilevel chaos on the published beam: full Newton iterations, as published, against corrections with one factor."""

from __future__ import annotations

from mpi4py import MPI

from benchmarks.beams import beam
from forward.model import WORK
from uq.evaluation.evaluate import Recorder, SerialEvaluate
from uq.methods.multilevel_chaos import MultilevelChaos
from uq.surrogates.linearisation import linearise

OUTPUT = "uy_max"
CASES = (
    ("published, 1 iteration", "newton", "mean", 1),
    ("published, 2 iterations", "newton", "mean", 2),
    ("Newton from the tangent", "newton", "tangent", 1),
    ("this, 1 iteration", "predict-correct", "tangent", 1),
    ("this, 2 iterations", "predict-correct", "tangent", 2),
    ("this, 4 iterations", "predict-correct", "tangent", 4),
    ("this, from the mean", "predict-correct", "mean", 2),
)
PUBLISHED = ("published, 1 iteration", "published, 2 iterations")
COUNTS = ("factorisations", "residuals", "back_substitutions")


def main() -> None:
    """Print moments, counts and processor time of all solves; ratios are against the published algorithm's best."""
    names = ("", "levels", "mean (m)", "standard deviation (m)", *COUNTS, "CPU (s)", "ratio", "stopped")
    print(f"| {' | '.join(name.replace('_', '-') for name in names)} |\n|{'---|' * len(names)}")
    seconds: dict[str, float] = {}
    for name, solver, first, iterations in CASES:
        study = beam((12, 2, 4), f'model.solver="{solver}"')
        evaluate = Recorder(SerialEvaluate(study.model.build(MPI.COMM_SELF, study.inputs.names)))
        # What is compiled or allocated once is charged to neither.
        linearise(study.inputs, evaluate)
        evaluate.log.clear()
        data = MultilevelChaos(first=first, iterations=iterations, seed=1).run(study.inputs, evaluate)
        row, work = data.sel(output=OUTPUT), evaluate.log[0].work.sum(axis=0)
        for evaluations in evaluate.log[1:]:
            work = work + evaluations.work.sum(axis=0)
        counts = dict(zip(WORK, work.tolist(), strict=True))
        seconds[name] = evaluate.seconds
        best = min(seconds[case] for case in PUBLISHED if case in seconds)
        moments = (f"{row[m].item():.7f} ± {row[f'{m}_error'].item():.1g}" for m in ("mean", "std"))
        cells = (
            *(name, f"{data.sizes['level']}", *moments, *(f"{counts[c]:,}" for c in COUNTS)),
            *(f"{seconds[name]:.2f}", f"{best / seconds[name]:.1f}", data.attrs["stopped"]),
        )
        print(f"| {' | '.join(cells)} |", flush=True)
