"""Functions on which no constant of an estimator was chosen: two lists, written before it was tried."""

from __future__ import annotations

from math import gamma
from typing import Any

import numpy as np

from benchmarks import coverage
from benchmarks.coverage import Case, truth
from uq.estimators.doubts import of_tails
from uq.estimators.moments import Z, estimate, monomials
from uq.estimators.tails import counted
from uq.inputs.distributions import Gamma, LogNormal, Normal, Uniform
from uq.inputs.random_parameters import Inputs

SETS = 400
UNIT = Uniform(lower=0.0, upper=1.0)
STANDARD = Normal(mean=0.0, std=1.0)


def _of(d: int, marginal: Any = UNIT) -> Inputs:
    return Inputs({f"x{i}": marginal for i in range(d)})


def _between(**ranges: tuple[float, float]) -> Inputs:
    return Inputs({name: Uniform(lower=low, upper=high) for name, (low, high) in ranges.items()})


MIXED = Inputs({"z": STANDARD, "y": STANDARD, "u": UNIT})


def _log_normals(*spreads: float) -> Inputs:
    return Inputs({f"x{i}": LogNormal(mean=1.0, std=cv) for i, cv in enumerate(spreads)})


def _positive(x: Any) -> Any:
    return np.where(np.real(x) > 0, x, 0 * x)


def _absolute(x: Any) -> Any:
    return np.where(np.real(x) < 0, -x, x)


def _root(x: Any) -> Any:
    """Return √x for x > 0, with a derivative that stays finite where x is 0."""
    return np.sqrt(x + 1e-12)


def _contaminated(x: Any) -> Any:
    """Return a normal quantity that is five times as wide in a tenth of all cases."""
    return x[:, 0] * np.where(np.real(x[:, 2]) < 0.1, 5.0, 1.0) + x[:, 1] / 2


def _mixture(x: Any) -> Any:
    return np.where(np.real(x[:, 2]) < 0.2, np.exp(x[:, 0]), x[:, 1])


def _steps_on_a_slope(x: Any) -> Any:
    return (1 + x[:, 1]) * np.floor(np.real(4 * x[:, 0])) + x[:, 0]


def _wave(x: Any) -> Any:
    """Return a wave of triangles, and a slope."""
    phase = 6 * x[:, 0] - np.floor(np.real(6 * x[:, 0]))
    return _absolute(2 * phase - 1) + x[:, 1]


def _circuit(x: Any) -> Any:
    """Return the voltage of an amplifier (E. N. Ben-Ari, D. M. Steinberg, Qual. Eng. 19 (2007) 327–338)."""
    b1, b2, f, c1, c2, beta = x.T
    base, gain = 12 * b2 / (b1 + b2), beta * (c2 + 9)
    return (base + 0.74) * gain / (gain + f) + 11.35 * f / (gain + f) + 0.74 * f * gain / ((gain + f) * c1)


def _piston(x: Any) -> Any:
    """Return the cycle time of a piston (the same)."""
    mass, area, volume, k, pressure, ambient, temperature = x.T
    a = pressure * area + 19.62 * mass - k * volume / area
    filled = area / (2 * k) * (np.sqrt(a**2 + 4 * k * pressure * volume / temperature * ambient) - a)
    return 2 * np.pi * np.sqrt(mass / (k + area**2 * pressure * volume * ambient / (temperature * filled**2)))


def _friedman(x: Any) -> Any:
    return 10 * np.sin(np.pi * x[:, 0] * x[:, 1]) + 20 * (x[:, 2] - 0.5) ** 2 + 10 * x[:, 3] + 5 * x[:, 4]


def _rosenbrock(x: Any) -> Any:
    return (1 - x[:, 0]) ** 2 + 100 * (x[:, 1] - x[:, 0] ** 2) ** 2


def _largest(x: Any) -> Any:
    return np.take_along_axis(x, np.real(x).argmax(axis=1)[:, None], axis=1)[:, 0]


def _student(x: Any) -> Any:
    """Return Student's t with seven degrees of freedom, of eight normals."""
    return x[:, 0] / np.sqrt(1e-12 + (x[:, 1:] ** 2).mean(axis=1))


def first() -> tuple[Case, ...]:
    """Return the first list."""
    two, normals, e = _of(2), _of(2, STANDARD), np.exp(1)
    return (
        Case("exp(z/2)", lambda x: np.exp(x[:, 0] / 2) + x[:, 1] / 2, normals, exact=(
            np.exp(0.125), (np.exp(0.25) * np.expm1(0.25) + 0.25) ** 0.5)),
        Case("cosh(z)", lambda x: np.cosh(x[:, 0]) + x[:, 1] / 2, normals, exact=(
            e**0.5, ((e**2 + 1) / 2 - e + 0.25) ** 0.5)),
        Case("a √c / b of log-normals", lambda x: x[:, 0] / x[:, 1] * np.sqrt(x[:, 2]), _log_normals(0.4, 0.3, 0.8)),
        Case("sum of five log-normals", lambda x: x.sum(axis=1), _log_normals(*[1.0] * 5), exact=(5, 5**0.5)),
        Case("ln(1 + exp(3 z))", lambda x: np.log1p(np.exp(3 * x[:, 0])) + x[:, 1] / 2, normals),
        Case("hinge of normals", lambda x: _positive(x.sum(axis=1) - 2.0), _of(4, STANDARD)),
        Case("contaminated normal", _contaminated, MIXED, exact=(0, (0.9 + 2.5 + 0.25) ** 0.5)),
        Case("logistic", lambda x: np.log(x[:, 0] / (1 - x[:, 0])) + x[:, 1], two, exact=(
            0.5, (np.pi**2 / 3 + 1 / 12) ** 0.5)),
        Case("u^-0.2", lambda x: x[:, 0] ** -0.2 + x[:, 1], two, exact=(
            1 / 0.8 + 0.5, (1 / 0.6 - 1 / 0.64 + 1 / 12) ** 0.5)),
        Case("u^-0.35", lambda x: x[:, 0] ** -0.35 + x[:, 1], two, exact=(
            1 / 0.65 + 0.5, (1 / 0.3 - 1 / 0.65**2 + 1 / 12) ** 0.5)),
        Case("pole beside the range", lambda x: (1 + x[:, 1]) / (1.05 - x[:, 0]), two),
        Case("narrow peak", lambda x: np.exp(-((x[:, 0] - 0.3) ** 2 + (x[:, 1] - 0.6) ** 2) / 0.0128), two),
        Case("root of a distance", lambda x: _root(_absolute(x[:, 0] - 0.1)) + x[:, 1] / 3, two),
        Case("Rayleigh", lambda x: np.sqrt(-2 * np.log(x[:, 0])) + x[:, 1] / 3, two, exact=(
            (np.pi / 2) ** 0.5 + 1 / 6, (2 - np.pi / 2 + 1 / 108) ** 0.5)),
        Case("steps on a slope", _steps_on_a_slope, two),
        Case("exp(5 u^8)", lambda x: np.exp(5 * x[:, 0] ** 8) + x[:, 1], two),
        Case("Runge", lambda x: 1 / (1 + 25 * (2 * x[:, 0] - 1) ** 2) + x[:, 1] / 5, two),
        Case("damped oscillation", lambda x: np.exp(-3 * x[:, 0]) * np.sin(20 * x[:, 1]), two),
        Case("amplifier", _circuit, _between(
            b1=(50, 150), b2=(25, 70), f=(0.5, 3), c1=(1.2, 2.5), c2=(0.25, 1.2), beta=(50, 300))),
        Case("z |z|", lambda x: x[:, 0] * _absolute(x[:, 0]) + x[:, 1], normals, exact=(0, 2.0)),
        Case("u^-0.4 v^-0.1", lambda x: x[:, 0] ** -0.4 * x[:, 1] ** -0.1, two, exact=(
            1 / 0.54, (1 / 0.16 - 1 / 0.54**2) ** 0.5)),
        Case("square of an exponential", lambda x: x[:, 0] ** 2 + x[:, 1], _of(2, Gamma(shape=1.0, scale=1.0)), exact=(
            3, 21**0.5)),
    )  # fmt: skip


def second() -> tuple[Case, ...]:
    """Return the second list."""
    two, normals = _of(2), _of(2, STANDARD)
    weibull = gamma(4) - gamma(2.5) ** 2
    return (
        Case("exp(0.9 z) − z'", lambda x: np.exp(0.9 * x[:, 0]) - x[:, 1], normals, exact=(
            np.exp(0.405), (np.exp(0.81) * np.expm1(0.81) + 1) ** 0.5)),
        Case("product of three log-normals", lambda x: np.prod(x, axis=1), _log_normals(0.6, 0.6, 0.6), exact=(
            1, (1.36**3 - 1) ** 0.5)),
        Case("Weibull", lambda x: (-np.log(x[:, 0])) ** 1.5 + x[:, 1], two, exact=(
            gamma(2.5) + 0.5, (weibull + 1 / 12) ** 0.5)),
        Case("exp(z²/10)", lambda x: np.exp(x[:, 0] ** 2 / 10) + x[:, 1] / 4, normals, exact=(
            0.8**-0.5, (0.6**-0.5 - 1 / 0.8 + 1 / 16) ** 0.5)),
        Case("Student, 7", _student, _of(8, STANDARD), exact=(0, (7 / 5) ** 0.5)),
        Case("a fifth of a log-normal", _mixture, MIXED, exact=(
            0.2 * np.exp(0.5), (0.2 * np.exp(2) + 0.8 - 0.04 * np.exp(1)) ** 0.5)),
        Case("1/(0.1 + u + v)", lambda x: 1 / (0.1 + x.sum(axis=1)), two),
        Case("ln(1e-4 + u v)", lambda x: np.log(1e-4 + x[:, 0] * x[:, 1]), two),
        Case("front", lambda x: np.tanh(40 * (x[:, 0] - x[:, 1])) + x[:, 2], _of(3)),
        Case("(1 + u)/(0.05 + v)", lambda x: (1 + x[:, 0]) / (0.05 + x[:, 1]), two),
        Case("piston", _piston, _between(
            mass=(30, 60), area=(0.005, 0.02), volume=(0.002, 0.01), k=(1000, 5000), pressure=(90000, 110000),
            ambient=(290, 296), temperature=(340, 360))),
        Case("Rosenbrock", _rosenbrock, _of(2, Uniform(lower=-2.0, upper=2.0))),
        Case("Friedman", _friedman, _of(5)),
        Case("square of the largest of 4", lambda x: _largest(x) ** 2, _of(4, STANDARD)),
        Case("u^-0.3 v^-0.2", lambda x: x[:, 0] ** -0.3 * x[:, 1] ** -0.2, two, exact=(
            1 / 0.56, (1 / 0.24 - 1 / 0.56**2) ** 0.5)),
        Case("tan(1.5 u)", lambda x: np.tan(1.5 * x[:, 0]) + x[:, 1], two),
        Case("wide peak in 3", lambda x: np.exp(-((x - 0.4) ** 2).sum(axis=1) / 0.045), _of(3)),
        Case("z + z^5/10", lambda x: x[:, 0] + x[:, 0] ** 5 / 10 + x[:, 1], normals, exact=(0, (2 + 3 + 9.45) ** 0.5)),
        Case("wave of triangles", _wave, two),
        Case("a/b − c of log-normals", lambda x: x[:, 0] / x[:, 1] - x[:, 2], _log_normals(0.5, 0.4, 0.7)),
        Case("z − exp(−z)/3", lambda x: x[:, 0] - np.exp(-x[:, 0]) / 3, _of(1, STANDARD)),
        Case("√u cos(8 v)", lambda x: _root(x[:, 0]) * np.cos(8 * x[:, 1]), two),
    )  # fmt: skip


def main() -> None:
    """Print what plain Monte Carlo claims, without its bookkeeping, so that many sets of samples cost little.

    Shares (%) of sets whose 95 % intervals of mean and standard deviation hold the truth; in brackets those that miss
    it without a finding; and of those with a finding.
    """
    coverage.REFERENCE = 14
    print("| function | 64: mean | standard deviation | found | 256: mean | standard deviation | found |")
    print("|---" * 7 + "|")
    for case in (*first(), *second()):
        cells = [cell for n in (64, 256) for cell in _plain(case, n)]
        print(f"| {case.name} | " + " | ".join(cells) + " |", flush=True)


def _plain(case: Case, n: int) -> tuple[str, ...]:
    points = np.random.default_rng(1).random((n * SETS, len(case.inputs.names)))
    values = np.real(case.function(case.inputs.points(points))).reshape(n, SETS)
    offset = np.full(SETS, values.mean())
    found = counted(estimate(monomials(values - offset, None).sum(axis=1), n, offset), case.inputs, values)
    relative = found.relative_std_error
    told = np.array([any(True for _ in of_tails(["f"], values[:, [i]], relative[[i]])) for i in range(SETS)])
    exact, _ = truth(case, (0.5,))
    cells = []
    for value, error, right in ((found.mean, found.mean_error, exact[0]), (found.std, found.std_error, exact[1])):
        held = np.abs(value - right) <= Z * error
        cells.append(f"{100 * held.mean():.0f} ({100 * (~held & ~told).mean():.0f})")
    return *cells, f"{100 * told.mean():.0f}"
