"""The tables of reports: results as rounded numbers with units, in words."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from forward.words import NONE, duration, number, per, settings, with_error, with_unit, worth
from uq.estimators.moments import half_width
from uq.methods.compare import gains as gains_of
from uq.methods.compare import plain_samples
from workflows.config.study import Study
from workflows.report.words import unit_of

if TYPE_CHECKING:
    import xarray as xr


ROWS = 40  # parameters that a table lists


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

    def leading(self, effects: xr.DataArray) -> list[str]:
        """Names of the parameters, or of those with the largest effects (parameter,) where there are many."""
        if len(self.parameters) <= ROWS:
            return self.parameters
        largest = (-abs(effects)).argsort().to_numpy()[:ROWS]
        return [str(name) for name in effects["parameter"].to_numpy()[largest]]

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
    body = results.study.body
    for field, paths in [(field, field.paths(body.body)) for field in body.fields] if body is not None else []:
        kept = float(results.dataset["variance_kept"].sel(random_field=field.label))
        law = f"independent standard normal; {100 * kept:.3g} % of the variance of the field"
        rows.append((f"fields.{field.label}.0 to {len(paths) - 1}", law, "0", "1", "1"))
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
            f"a 95 % interval is ± {number(half_width(dataset), 3)} of them.",
            hurts=False,
        )
    if "control_samples" in dataset:
        error, fitted = number(float(dataset["loo_error"].max()), 2), int(dataset["control_samples"])
        yield Gain(
            f"The control variate is an expansion fitted to {fitted} samples of its own, with a leave-one-out "
            f"error of at most {error} standard deviations.",
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


def total_errors(results: Results) -> Table:
    """Errors of means and standard deviations by where they come from."""
    rows = []
    for output in results.outputs:
        of_output = results.dataset.sel(output=output)
        for word, first in (("mean", ""), ("standard deviation", "std_")):
            names = (f"{first or 'mean_'}error", f"{first}bias_error", f"{first}total_error")
            errors = [with_unit(number(float(of_output[name]), 2), results.unit(output)) for name in names]
            rows.append((f"{word} of {output}", *errors))
    return Table(("estimate", "sampling", "mesh", "total"), rows)


def meshes(results: Results) -> Table:
    """The meshes, and what was solved on them."""
    dataset, rows = results.dataset, []
    for level, found in zip(dataset["level"].to_numpy(), results.summary["meshes"], strict=True):
        here = dataset.sel(level=level)
        seconds = found["cpu_seconds"] / max(found["solves"], 1)
        samples, failed = f"{int(here['mesh_samples']):,}", f"{int(here['mesh_failed']):,}"
        cost = f"{float(here['mesh_cost']):.2g} s"
        rows.append(
            (f"{level}", f"{found['unknowns']:,}", samples, failed, f"{found['solves']:,}", cost, duration(seconds))
        )
    head = (
        "level",
        "unknowns",
        "samples",
        "failed",
        "solves",
        "a solve, predicted",
        "a solve, measured (with the linearisation)",
    )
    return Table(head, rows)


def differences(results: Results, output: str) -> Table:
    """What every mesh adds to the mean of an output, and whether that can be trusted."""
    rows = []
    for level in results.dataset["level"].to_numpy():
        here = results.dataset.sel(output=output, level=level)
        text = with_error(float(here["difference_mean"]), float(here["difference_mean_error"]))
        rest = (
            "mesh_variance",
            "difference_variance",
            "difference_variance_ratio",
            "difference_kurtosis",
            "consistency",
        )
        rows.append((f"{level}", with_unit(text, results.unit(output)), *(number(float(here[n]), 3) for n in rest)))
    head = (
        "level",
        "mean of the difference",
        "variance",
        "variance of the difference",
        "÷ by the control",
        "kurtosis",
        "consistency",
    )
    return Table(head, rows)


def rates(results: Results, output: str) -> str:
    """The rates of convergence of an output, in words."""
    of_output = results.dataset.sel(output=output)
    weak, strong, cost = (float(of_output[f"{name}_rate"]) for name in ("weak", "strong", "cost"))
    return (
        f"From one mesh to the next, the mean difference falls by 2^{weak:.2f}, its variance by 2^{strong:.2f}, and "
        f"the predicted cost of a solve grows by 2^{cost:.2f}. A consistency below 1 says that the sum over the meshes "
        "telescopes."
    )


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


def levels(results: Results) -> Table:
    """What the levels of multilevel chaos have cost and reached."""
    rows = []
    for k in results.dataset["level"].to_numpy():
        level = results.dataset.sel(level=k)
        work = {str(name): int(level["level_work"].sel(operation=name)) for name in level["operation"].to_numpy()}
        iterations = int(level["level_iterations"])
        rows.append(
            (
                f"{k}",
                f"{iterations}" if iterations else "to the tolerance",
                f"{int(level['level_solves'])}",
                f"{int(level['level_converged'])}",
                number(float(level["level_residual"]), 2),
                number(float(level["level_residual_median"]), 2),
                number(float(level["level_change"]), 2),
                *(f"{work[name]:,}" for name in ("residuals", "back_substitutions", "factorisations")),
            )
        )
    head = (
        *("level", "iterations", "samples", "at equilibrium", "largest residual", "median residual"),
        *("change of the moments", "residuals", "back-substitutions", "factorisations"),
    )
    return Table(head, rows)


def controlled(results: Results) -> Table:
    """Moments from the samples of the last level, with the expansion of the level before as control variate."""
    names = ("control_mean", "control_std")
    rows = [(output, *(results.estimate(output, name) for name in names)) for output in results.outputs]
    return Table(("output", "mean", "standard deviation"), rows)


def sobol(results: Results, output: str) -> Table:
    """Sobol' indices of an output."""
    of_output = results.dataset.sel(output=output)
    rows = []
    for name in results.leading(of_output["sobol_total"]):
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
    for name in results.leading(slopes["derivative_per_std"]):
        of_parameter = slopes.sel(parameter=name)
        slope = with_unit(number(float(of_parameter["derivative"]), 5), per(unit, unit_of(name)))
        scaled = [float(of_parameter[f"derivative_per_{spread}"]) for spread in ("std", "range")]
        rows.append((name, slope, *(with_unit(number(value), unit) for value in scaled)))
    return Table(("parameter", "derivative", "× standard deviation", "× range"), rows)


def field_norms(results: Results) -> Table:
    """Root mean squares over the body of the derivatives of the displacement field."""
    dataset = results.dataset
    rows = []
    for name in results.leading(dataset["field_derivative_rms"] * dataset["parameter_std"]):
        of_parameter = dataset.sel(parameter=name)
        size, std, wide = (
            float(of_parameter[key]) for key in ("field_derivative_rms", "parameter_std", "parameter_range")
        )
        slope = with_unit(number(size, 5), per("m", unit_of(name)))
        rows.append((name, slope, with_unit(number(size * std), "m"), with_unit(number(size * wide), "m")))
    return Table(("parameter", "root mean square of the derivative", "× standard deviation", "× range"), rows)


def failures(results: Results) -> Table:
    """The solves that failed: parameters (without the coefficients of random fields) and reason."""
    names = list(results.study.parameters)
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
    count = max(_count(summary), 1)
    yield "wall time", f"{duration(summary['wall_seconds'])} (of the run that finished the study)"
    cpu = summary["cpu_seconds"]
    yield "processor time of the solves", f"{duration(cpu)}; {duration(cpu / count)} a solve"
    if any(summary["work"].values()):  # of inversions side by side it is not known
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


def references(results: Results) -> Table:
    """What methods are compared with, and what the solver and the mesh leave of it."""
    rows = []
    for output in results.outputs:
        of_output, unit = results.dataset.sel(output=output), results.unit(output)
        floors = (with_unit(number(float(of_output[f"{name}_error"]), 2), unit) for name in ("solver", "mesh"))
        rows.append((output, *(results.estimate(output, name) for name in ("mean", "std")), *floors))
    return Table(("output", "mean", "standard deviation", "error of the solver", "error of the mesh"), rows)


def errors(results: Results, output: str, estimated: str) -> Table:
    """What each method errs and costs at each budget, for one estimate of an output."""
    dataset = results.dataset.sel(output=output)
    scale = abs(float(dataset[estimated]))
    plain, gained = plain_samples(dataset, estimated).to_numpy(), gains_of(dataset, estimated)
    methods = dataset["row_method"].to_numpy().tolist()
    rates = {}
    for name in dataset["estimator"].to_numpy().tolist():
        of_method = dataset.sel(estimator=name)
        rates[name] = with_error(*(float(of_method[f"{estimated}_rate{end}"]) for end in ("", "_error")))
    rows = []
    for i, name in enumerate(methods):
        row = dataset.isel(row=i)
        rmse, resolved = float(row[f"{estimated}_rmse"]), bool(row[f"{estimated}_resolved"])
        coverage = NONE
        if resolved:
            coverage = f"{100 * float(row[f'{estimated}_coverage']):.0f} %"
            coverage += " (understated)" if bool(row[f"{estimated}_understated"]) else ""
        bound = "" if resolved else "≥ "
        ratios = [plain[i], *(float(gain[i]) for gain in gained.values())]
        rows.append(
            (
                name,
                f"{int(row['budget']):,}",
                f"{int(row['solves']):,}",
                duration(float(row["cpu_seconds"])),
                number(rmse, 2) + ("" if resolved else " (not resolved)"),
                number(rmse / scale if scale else float("nan"), 2),
                number(float(row[f"{estimated}_claimed"]), 2),
                coverage,
                *(NONE if math.isnan(ratio) else bound + number(ratio, 2) for ratio in ratios),
                rates[name] if name not in methods[i + 1 :] else "",
            )
        )
    head = (
        "method",
        "samples",
        "solves",
        "CPU time",
        with_unit("RMSE", f"({results.unit(output)})"),
        "relative",
        "claimed",
        "coverage",
        "plain samples for this error",
        "gain in solves",
        "gain in CPU time",
        "gain over the textbook",
        "rate",
    )
    return Table(head, rows)


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
    count = _count(summary)
    return "1 solve" if count == 1 else f"{count:,} solves"


def _count(summary: dict[str, Any]) -> int:
    """Number of solves; a data set of several that are inverted side by side is one evaluation of many solves."""
    return int(max(summary["evaluations"], summary.get("solves", 0)))
