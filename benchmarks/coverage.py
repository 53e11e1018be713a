"""Coverage of claimed 95 % intervals: awkward and smooth functions under all methods, and how wide the claims are."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np

from forward.model import WORK, FloatArray, SolveError
from uq.estimators.moments import half_width
from uq.evaluation.request import Evaluations, Failure, Request
from uq.inputs.distributions import LogNormal, Normal, Uniform
from uq.inputs.random_parameters import Inputs
from uq.inputs.sampling import sobol_points
from uq.methods import chaos
from uq.methods.chaos import Chaos
from uq.methods.derivative_based import DerivativeBased
from uq.methods.monte_carlo import MonteCarlo, SensitivityMonteCarlo
from uq.methods.multilevel_chaos import MultilevelChaos
from uq.methods.quasi_monte_carlo import QuasiMonteCarlo
from uq.methods.sobol import Sobol

REPEATS = 100
REFERENCE = 16  # 2^16 points of each of 16 scrambles give what is true
UNIT = Uniform(lower=0.0, upper=1.0)


# --- functions -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Case:
    """A function of points (n, d), real or complex, and the distributions of its parameters.

    Attributes
    ----------
    smooth
        Whether intervals are to cover 92 to 98 %.
    exact
        Mean and standard deviation, where they are known in closed form.
    """

    name: str
    function: Callable[[Any], Any]
    inputs: Inputs
    smooth: bool = False
    exact: tuple[float, float] | None = None


def _uniform(d: int) -> Inputs:
    return Inputs({f"x{i}": UNIT for i in range(d)})


def _positive(x: Any) -> Any:
    return np.where(np.real(x) > 0, x, 0 * x)


def _absolute(x: Any) -> Any:
    return np.where(np.real(x) < 0, -x, x)


def _jump(x: Any) -> Any:
    return x[:, 0] + np.where(np.real(x[:, 1] + 0.5 * x[:, 2]) > 0.9, 1.0, 0.0)


def _sobol_g(x: Any) -> Any:
    a = np.array([0, 1, 4.5, 9])
    return np.prod((_absolute(4 * x - 2) + a) / (1 + a), axis=1)


def _borehole(x: Any) -> Any:
    rw, r, tu, hu, tl, hl, length, kw = x.T
    logarithm = np.log(r / rw)
    return 2 * np.pi * tu * (hu - hl) / (logarithm * (1 + 2 * length * tu / (logarithm * rw**2 * kw) + tu / tl))


def _wing(x: Any) -> Any:
    """Weight of a wing (A. Forrester, A. Sobester, A. Keane, Engineering Design via Surrogate Modelling (2008))."""
    s, wfw, a, sweep, q, taper, tc, nz, wdg, wp = x.T
    cosine = np.cos(sweep * np.pi / 180)
    return (
        0.036 * s**0.758 * wfw**0.0035 * (a / cosine**2) ** 0.6 * q**0.006 * taper**0.04
        * (100 * tc / cosine) ** -0.3 * (nz * wdg) ** 0.49 + s * wp
    )  # fmt: skip


def _ishigami(x: Any) -> Any:
    return np.sin(x[:, 0]) + 7 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])


def _quadratic(x: Any) -> Any:
    return x @ np.array([1, 0.5, 0.3, 0.2, 0.1]) + 0.2 * x[:, 0] ** 2 + 0.1 * x[:, 1] * x[:, 2]


_NORMALS = Inputs({f"x{i}": Normal(mean=0.0, std=1.0) for i in range(10)})
_BOREHOLE = {
    "rw": Normal(mean=0.1, std=0.0161812),
    "r": LogNormal(mean=3698.3, std=4891.5),
    **{
        name: Uniform(lower=float(lower), upper=float(upper))
        for name, lower, upper in (
            ("Tu", 63070, 115600), ("Hu", 990, 1110), ("Tl", 63.1, 116), ("Hl", 700, 820), ("L", 1120, 1680),
            ("Kw", 9855, 12045),
        )
    },
}  # fmt: skip
_WING = (
    (150, 200),
    (220, 300),
    (6, 10),
    (-10, 10),
    (16, 45),
    (0.5, 1),
    (0.08, 0.18),
    (2.5, 6),
    (1700, 2500),
    (0.025, 0.08),
)

CASES = (
    Case("hinge", lambda x: _positive(x @ np.array([1, 0.7, 0.4]) - 1.1), _uniform(3)),
    Case("jump", _jump, _uniform(3)),
    Case("oscillation", lambda x: np.cos(0.6 * np.pi + x @ np.array([9.0, 7.25, 1.85, 7.03])), _uniform(4)),
    Case("absolute value", lambda x: _absolute(x[:, 0] - 0.4) + _absolute(x[:, 1] - x[:, 2]), _uniform(3)),
    Case("Sobol' g", _sobol_g, _uniform(4)),
    Case("peak", lambda x: np.exp(-((x - 0.6) ** 2).sum(axis=1) / (2 * 0.15**2)), _uniform(2)),
    # 2^20 points do not know the standard deviation of the exponential.
    Case(
        "exponential",
        lambda x: np.exp(x.sum(axis=1) / 10**0.5),
        _NORMALS,
        exact=(float(np.exp(0.5)), float(np.exp(0.5) * (np.e - 1) ** 0.5)),
    ),
    Case("log-normals", lambda x: x[:, 0] * x[:, 1], Inputs({n: LogNormal(mean=1.0, std=0.5) for n in "ab"})),
    Case("borehole", _borehole, Inputs(_BOREHOLE), smooth=True),
    Case("Ishigami", _ishigami, Inputs(dict.fromkeys("abc", Uniform(lower=-np.pi, upper=np.pi))), smooth=True),
    Case(
        "wing weight",
        _wing,
        Inputs({f"x{i}": Uniform(lower=float(lower), upper=float(upper)) for i, (lower, upper) in enumerate(_WING)}),
        smooth=True,
    ),
    Case("quadratic", _quadratic, Inputs({f"x{i}": Normal(mean=0.0, std=1.0) for i in range(5)}), smooth=True),
)


@dataclass(frozen=True)
class Vectorised:
    """Evaluation of a function of all points at once, with derivatives by complex steps."""

    case: Case
    outputs: tuple[str, ...] = ("f",)
    differentiable: bool = True
    displacements: int = 0
    node_volumes: FloatArray | None = None

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.case.inputs.names

    def on(self, model: int) -> Vectorised:
        """Return itself: there is one model."""
        return self

    def __call__(self, request: Request) -> Evaluations:
        """Evaluate the function at all points."""
        points = request.points
        n, d = points.shape
        tangents = None
        if request.tangents:
            steps = 1e-30j * np.eye(d)
            columns = [self.case.function(points + step).imag / 1e-30 for step in steps]
            tangents = np.stack(columns, axis=1)[:, None, :]
        values = np.real(self.case.function(points))[:, None]
        lost = np.flatnonzero(np.isnan(values[:, 0]))
        return Evaluations(
            points,
            values,
            tangents,
            tuple(Failure(int(i), tuple(points[i].tolist()), "not a number") for i in lost),
            np.full(n, 1e-3),
            np.zeros((n, len(WORK)), dtype=np.int64),
            np.zeros(n),
            ~np.isnan(values[:, 0]),
            np.zeros(n, dtype=np.int8),
            np.zeros((0, 0)),
        )


@cache
def truth(case: Case, probabilities: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Mean, standard deviation and quantiles from 2^20 points, and what they are known to."""
    d = len(case.inputs.names)
    rows = []
    for scramble in range(16):
        points = case.inputs.points(sobol_points(1, scramble, 0, 2**REFERENCE, d))
        values = np.real(case.function(points))
        rows.append([np.nanmean(values), np.nanstd(values), *np.nanquantile(values, probabilities)])
    exact, floor = np.mean(rows, axis=0), np.std(rows, axis=0) / 15**0.5
    if case.exact is not None:
        exact[:2], floor[:2] = case.exact, 0.0
    return exact, floor


# --- methods -------------------------------------------------------------------------------------------------------

_plain = {"fields": False}


def _methods() -> dict[str, Any]:
    qmc = partial(QuasiMonteCarlo, **_plain)
    return {
        "monte-carlo 64": MonteCarlo(samples=64, **_plain),
        "monte-carlo 256": MonteCarlo(samples=256, **_plain),
        "sensitivity 64": SensitivityMonteCarlo(samples=64, **_plain),
        "sensitivity, linear 64": SensitivityMonteCarlo(samples=64, second_moment="linear", **_plain),
        "sensitivity, optimal 128": SensitivityMonteCarlo(samples=128, coefficient="optimal", **_plain),
        "qmc, none 64": qmc(samples=64, control="none"),
        "qmc, none 256": qmc(samples=256, control="none"),
        "qmc, tangent 64": qmc(samples=64),
        "qmc, tangent 256": qmc(samples=256),
        "qmc, quadratic 128": qmc(samples=128, control="quadratic"),
        "qmc, quadratic 256": qmc(samples=256, control="quadratic"),
        "qmc, chaos 64": qmc(samples=64, control="chaos"),
        "qmc, chaos 256": qmc(samples=256, control="chaos"),
        "chaos 40": Chaos(samples=40, **_plain),
        "chaos 128": Chaos(samples=128, **_plain),
        "chaos, values 64": Chaos(samples=64, gradients=False, **_plain),
        "chaos, values 200": Chaos(samples=200, gradients=False, **_plain),
        "multilevel-chaos": MultilevelChaos(max_levels=4, order=3, **_plain),
        "sobol 40": Sobol(samples=40, **_plain),
        "sobol, exchanged 32 rows": Sobol(design="saltelli", samples=32, **_plain),
        "derivative-based 64": DerivativeBased(samples=64, **_plain),
    }


@dataclass(frozen=True)
class Row:
    """What claims of mean, std and all quantiles are worth, as shares of the runs.

    Attributes
    ----------
    covered
        Whose 95 % intervals hold the truth.
    claimed
        Claimed over true errors.
    silent
        Whose intervals miss it while no finding says so.
    found
        With a finding.
    lost
        Number of runs without an estimate.
    """

    covered: FloatArray
    claimed: FloatArray
    silent: FloatArray
    found: float
    lost: int


def measure(case: Case, method: Any, repeats: int) -> Row:
    """Run a method with many seeds."""
    exact, floor = truth(case, tuple(method.quantiles))
    evaluate = Vectorised(case)
    rows, warned, lost = [], [], 0
    for seed in range(repeats):
        try:
            data = method.model_copy(update={"seed": seed}).run(case.inputs, evaluate)
        except SolveError:
            lost += 1
            continue
        half = half_width(data)
        estimates = np.concatenate([[data[n].item() for n in ("mean", "std")], data["quantiles"].to_numpy()[:, 0]])
        errors = [data[f"{n}_error"].item() for n in ("mean", "std")]
        claims = half * np.array([*errors, *data["quantiles_error"].to_numpy()[:, 0]])
        within = np.abs(estimates - exact) <= np.hypot(claims, 3 * floor) + 1e-12 * np.abs(exact)
        if "quantiles_lower" in data:
            low, high = (data[f"quantiles_{side}"].to_numpy()[:, 0] for side in ("lower", "upper"))
            within[2:] |= (low <= exact[2:]) & (exact[2:] <= high)
        rows.append((within, claims / half, np.abs(estimates - exact)))
        # A note says that solves have failed and how these were counted.
        warned.append("note" in data.attrs or any(f["severity"] != "note" for f in _findings(data)))
    if not rows:
        nothing = np.full(len(exact), np.nan)
        return Row(nothing, nothing, nothing, 1.0, lost)
    within, claims, errors = (np.array(column) for column in zip(*rows, strict=True))
    ratio = np.sqrt(np.mean(claims**2, axis=0) / np.maximum(np.mean(errors**2, axis=0), 1e-300))
    silent = ~within & ~np.array(warned)[:, None]
    return Row(within.mean(axis=0), ratio, silent.mean(axis=0), float(np.mean(warned)), lost)


def _findings(data: Any) -> list[dict[str, str]]:
    import json

    return json.loads(data.attrs.get("findings", "[]"))


def main(words: Sequence[str] = ()) -> None:
    """Print coverage of mean, standard deviation and quantiles, claimed over true errors, and findings."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks coverage")
    parser.add_argument("--repeats", type=int, default=REPEATS)
    parser.add_argument("--cases", default="")
    parser.add_argument("--methods", default="")
    options = parser.parse_args(words)
    chaos.DRAWN = 13
    print("| function | method | mean | std | quantiles | claimed/true: mean | std | quantiles | with a finding |")
    print("|" + "---|" * 9, flush=True)
    for name, method in _methods().items():
        for case in CASES:
            if options.cases not in case.name or options.methods not in name:
                continue
            row = measure(case, method, options.repeats)
            covered = " | ".join(
                [*(f"{c:.0%}" for c in row.covered[:2]), " ".join(f"{c:.0%}" for c in row.covered[2:])]
            )
            ratios = " | ".join([*(f"{c:.2g}" for c in row.claimed[:2]), " ".join(f"{c:.2g}" for c in row.claimed[2:])])
            print(f"| {case.name} | {name} | {covered} | {ratios} | {row.found:.0%} |{row.lost or ''}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
