"""The tables of reports: results as rounded numbers with units, in words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from workflows.config import Study
from workflows.plots import band
from workflows.words import NONE, duration, number, per, settings, unit_of, with_error, with_unit, worth

if TYPE_CHECKING:
    import xarray as xr


@dataclass(frozen=True)
class Table:
    """A table; the columns `text` are flushed left, and those of them in `long` are wrapped."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    text: frozenset[int] = frozenset({0})
    long: frozenset[int] = frozenset()


@dataclass(frozen=True)
class Results:
    """What a results directory holds."""

    dataset: xr.Dataset
    summary: dict[str, Any]
    study: Study

    @property
    def outputs(self) -> list[str]:
        """Names of the outputs."""
        return [str(name) for name in self.dataset["output"].values]

    @property
    def parameters(self) -> list[str]:
        """Names of the parameters."""
        return [str(name) for name in self.dataset["parameter"].values]

    def estimate(self, output: str, name: str) -> str:
        """One estimate of an output with its error and unit."""
        of_output = self.dataset.sel(output=output)
        text = with_error(float(of_output[name]), float(of_output[f"{name}_error"]))
        return with_unit(text, self.unit(output))

    def unit(self, output: str) -> str:
        """SI unit of an output."""
        return str(self.dataset["unit"].sel(output=output).item())


def parameters(results: Results) -> Table:
    """The random parameters and their distributions."""
    rows = []
    for name, distribution in results.study.parameters.items():
        block = distribution.model_dump()
        of_parameter = results.dataset.sel(parameter=name)
        mean, std = (number(float(of_parameter[f"parameter_{which}"])) for which in ("mean", "std"))
        rows.append((name, f"{block['kind']}: {settings(block, 'kind')}", mean, std, unit_of(name)))
    rows += [
        (" and ".join(c.between), f"joined by a Gaussian copula with correlation {c.value:g}", "", "", "")
        for c in results.study.correlations
    ]
    head = ("random parameter", "distribution", "mean", "standard deviation", "unit")
    return Table(head, rows, text=frozenset({0, 1, 4}))


def nominal(results: Results) -> Table:
    """Outputs at the mean parameters."""
    values = results.dataset["nominal"].to_numpy()
    rows = [(o, with_unit(number(v, 6), results.unit(o))) for o, v in zip(results.outputs, values, strict=True)]
    return Table(("output", "value"), rows)


def moments(results: Results) -> Table:
    """Mean and standard deviation of the outputs, and those of plain Monte Carlo beside controlled ones."""
    names = [n for n in ("mean", "std", "plain_mean", "plain_std") if n in results.dataset]
    words = {
        "mean": "mean",
        "std": "standard deviation",
        "plain_mean": "mean, plain Monte Carlo",
        "plain_std": "standard deviation, plain Monte Carlo",
    }
    rows = [(output, *(results.estimate(output, name) for name in names)) for output in results.outputs]
    return Table(("output", *(words[name] for name in names)), rows)


@dataclass(frozen=True)
class Gain:
    """What a control variate is worth, in words."""

    text: str
    hurts: bool


def gains(dataset: xr.Dataset) -> Iterator[Gain]:
    """Say what the control variate, or quasi-random points, are worth, output by output."""
    if "variance_ratio" not in dataset:
        return
    means = "the control variate"
    if "scramble" in dataset:
        means = "Sobol' points and the control variate" if "coefficient" in dataset else "Sobol' points"
        R = int(dataset["scramble"].max()) + 1
        spread = number(100 * (2 / (R - 1)) ** 0.5, 2)
        yield Gain(
            f"Errors are from the scatter of {R} independent scrambles, and so known to {spread} % or so when squared; "
            f"a 95 % interval is ± {number(band(dataset), 3)} of them.",
            hurts=False,
        )
    for output in dataset["output"].values:
        mean, std = (float(dataset[name].sel(output=output)) for name in ("variance_ratio", "std_variance_ratio"))
        text = (
            f"{output}: with {means}, one sample is worth {worth(mean)} plain samples for the mean "
            f"and {worth(std)} for the standard deviation."
        )
        worse = [word for word, ratio in (("mean", mean), ("standard deviation", std)) if ratio < 1]
        if worse:
            text += f" It hurts the {' and the '.join(worse)}: there, plain Monte Carlo is better."
        yield Gain(text, bool(worse))


def quantiles(results: Results) -> Table:
    """Quantiles of the outputs."""
    rows = []
    for output in results.outputs:
        of_output = results.dataset.sel(output=output)
        pairs = zip(of_output["quantiles"].to_numpy(), of_output["quantiles_error"].to_numpy(), strict=True)
        rows.append((output, *(with_unit(with_error(float(q), float(e)), results.unit(output)) for q, e in pairs)))
    return Table(("output", *(f"{100 * p:g} %" for p in results.dataset["quantile"].to_numpy())), rows)


def expansion(results: Results) -> Table:
    """The polynomials of an expansion and what they are worth, output by output."""
    dataset = results.dataset
    used, order = int(dataset["ok"].sum()), int(dataset["order"])
    rows = [
        (
            output,
            f"{order}",
            f"{dataset.sizes['term']}",
            f"{used}",
            number(float(dataset["loo_error"].sel(output=output)), 2),
        )
        for output in results.outputs
    ]
    return Table(("output", "order", "terms", "samples", "leave-one-out error / standard deviation"), rows)


def sobol(results: Results, output: str) -> Table:
    """Sobol' indices of an output."""
    of_output = results.dataset.sel(output=output)
    rows = []
    for name in results.parameters:
        of_parameter = of_output.sel(parameter=name)
        pairs = [(of_parameter[f"sobol_{which}"], of_parameter[f"sobol_{which}_error"]) for which in ("first", "total")]
        rows.append((name, *(with_error(float(value), float(error)) for value, error in pairs)))
    for name in map(str, results.dataset["group"].values if "group" in results.dataset.coords else ()):
        of_group = of_output.sel(group=name)
        kinds = [f"sobol_group_{which}" for which in ("first", "total")]
        texts = [with_error(float(of_group[kind]), float(of_group[f"{kind}_error"])) for kind in kinds]
        rows.append((f"group {name}", *texts))
    return Table(("parameter", "first order", "total"), rows)


def second_order(results: Results, output: str) -> Table:
    """Shares of the variance of an output that two parameters have together and neither has alone."""
    of_output = results.dataset.sel(output=output)
    names = results.parameters
    rows = []
    for i, name in enumerate(names):
        for partner in names[i + 1 :]:
            of_pair = of_output.sel(parameter=name, partner=partner)
            share = with_error(float(of_pair["sobol_second"]), float(of_pair["sobol_second_error"]))
            rows.append((name, partner, share))
    return Table(("parameter", "with", "second order"), rows, text=frozenset({0, 1}))


def field_sobol(results: Results) -> Table:
    """Generalised Sobol' indices of the displacement field."""
    rows = []
    for name in results.parameters:
        of = results.dataset.sel(parameter=name)
        pairs = [(of[f"field_sobol_{which}"], of[f"field_sobol_{which}_error"]) for which in ("first", "total")]
        rows.append((name, *(with_error(float(value), float(error)) for value, error in pairs)))
    return Table(("parameter", "first order", "total"), rows)


def bounds(results: Results, output: str) -> Table:
    """Derivative-based measures of an output and the bounds on total indices, beside local and total indices."""
    of_output = results.dataset.sel(output=output)
    rows = []
    for name in results.parameters:
        of = of_output.sel(parameter=name)
        squared = with_error(float(of["dgsm"]), float(of["dgsm_error"]))
        total = with_error(float(of["sobol_total"]), float(of["sobol_total_error"])) if "sobol_total" in of else NONE
        bound = with_error(float(of["total_bound"]), float(of["total_bound_error"]))
        rows.append((name, number(float(of["local_share"])), squared, number(float(of["poincare"])), total, bound))
    head = (
        "parameter",
        "share of the local variance",
        "mean squared derivative",
        "Poincaré constant",
        "total index (expansion)",
        "is at most",
    )
    return Table(head, rows)


def active_subspace(results: Results, output: str) -> Table:
    """Eigenvalues of the mean of ∇ψ∇ψᵀ of an output, and the leading direction."""
    of_output = results.dataset.sel(output=output)
    values = [of_output[f"active_eigenvalue{end}"].to_numpy() for end in ("", "_lower", "_upper")]
    directions = zip(of_output["active_direction"], of_output["active_direction_error"], strict=True)
    rows = [
        (name, with_error(float(component), float(error)), str(i), number(value), f"{number(lower)} to {number(upper)}")
        for i, (name, (component, error), value, lower, upper) in enumerate(
            zip(results.parameters, directions, *values, strict=True), start=1
        )
    ]
    return Table(("parameter", "leading direction", "number", "eigenvalue", "95 % range"), rows)


def sensitivities(results: Results, output: str) -> Table:
    """Derivatives of an output, in physical units and times the spread of the parameter."""
    unit, slopes = results.unit(output), results.dataset.sel(output=output)
    rows = []
    for name in results.parameters:
        of_parameter = slopes.sel(parameter=name)
        slope = with_unit(number(float(of_parameter["derivative"]), 5), per(unit, unit_of(name)))
        scaled = [float(of_parameter[f"derivative_per_{spread}"]) for spread in ("std", "range")]
        rows.append((name, slope, *(with_unit(number(value), unit) for value in scaled)))
    return Table(("parameter", "derivative", "× standard deviation", "× range"), rows)


def field_norms(results: Results) -> Table:
    """Norms of the derivatives of the displacement field."""
    dataset = results.dataset
    rows = []
    for name in results.parameters:
        of_parameter = dataset.sel(parameter=name)
        norm, std = float(of_parameter["field_derivative_norm"]), float(of_parameter["parameter_std"])
        over_range = float(of_parameter["field_derivative_norm_per_range"])
        slope = with_unit(number(norm, 5), per("m", unit_of(name)))
        rows.append((name, slope, with_unit(number(norm * std), "m"), with_unit(number(over_range), "m")))
    return Table(("parameter", "norm of the derivative", "× standard deviation", "× range"), rows)


def failures(results: Results) -> Table:
    """The solves that failed: parameters and reason."""
    names = results.parameters
    rows = [
        (*(with_unit(number(f["parameters"][name], 6), unit_of(name)) for name in names), f["reason"])
        for f in results.summary["failures"]
    ]
    last = frozenset({len(names)})
    return Table((*names, "reason"), rows, text=last, long=last)


def failures_line(summary: dict[str, Any]) -> str:
    """How many solves failed, and whether all are listed."""
    failed, listed = summary["failed"], len(summary["failures"])
    line = f"{failed:,} of {solves(summary)} failed."
    return line if listed == failed else f"{line} These are the first {listed}; evaluations.h5 holds all."


def times(summary: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """What the study took."""
    count = max(summary["evaluations"], 1)
    yield "wall time", f"{duration(summary['wall_seconds'])} (of the run that finished the study)"
    cpu = summary["cpu_seconds"]
    yield "processor time of the solves", f"{duration(cpu)}; {duration(cpu / count)} a solve"
    for name, amount in summary["work"].items():
        yield name.replace("_", " "), f"{amount:,}; {amount / count:.1f} a solve"


def provenance(summary: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """When, from what and on what the results were made."""
    found = summary["provenance"]
    date = datetime.fromisoformat(found["date"]).astimezone(UTC)
    yield "date", f"{date:%Y-%m-%d %H:%M:%S} UTC"
    yield "commit", found["commit"] or "not from a git checkout"
    yield "seed", NONE if found["seed"] is None else str(found["seed"])
    ranks, groups = found["ranks"], found["groups"]
    yield "ranks", f"{ranks} in {groups} group{'s' if groups > 1 else ''}, {found['processor']}"
    yield "versions", ", ".join(f"{name} {version}" for name, version in found["versions"].items())


def costs(studies: dict[str, Results]) -> Table:
    """Methods and costs of several studies."""
    rows = [
        (
            name,
            results.summary["method"],
            f"{results.summary['evaluations']:,}",
            f"{results.summary['failed']:,}",
            duration(results.summary["cpu_seconds"]),
            duration(results.summary["wall_seconds"]),
        )
        for name, results in studies.items()
    ]
    return Table(("study", "method", "solves", "failed", "CPU time", "wall time"), rows, text=frozenset({0, 1}))


def estimates(studies: dict[str, Results], output: str) -> Table:
    """Estimates of an output by several studies."""
    rows: list[tuple[str, ...]] = []
    for name, results in studies.items():
        if output not in results.outputs:
            rows.append((name, NONE, NONE, NONE))
            continue
        central = number(float(results.dataset["nominal"].sel(output=output)), 6)
        shown = [results.estimate(output, n) if n in results.dataset else NONE for n in ("mean", "std")]
        rows.append((name, *shown, with_unit(central, results.unit(output))))
    return Table(("study", "mean", "standard deviation", "at the mean parameters"), rows)


def solves(summary: dict[str, Any]) -> str:
    """The number of solves."""
    return "1 solve" if summary["evaluations"] == 1 else f"{summary['evaluations']:,} solves"
