"""Sensitivity from derivatives: bounds on total indices, active subspaces."""

from __future__ import annotations

from collections.abc import Iterator

from forward.readable import percent
from forward.words import NONE, number, per, with_error, with_unit
from workflows.report import plots
from workflows.report.blocks import Block, Heading, Picture, Pictures, Table, Text
from workflows.report.section import Results, Section


class DerivativeBased(Section):
    """Bounds on total indices, and active subspaces."""

    def applies(self, results: Results) -> bool:
        """Whether there are some."""
        return "total_bound" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """Tables and pictures of each output."""
        dataset = results.dataset
        yield Heading("Sensitivity from derivatives")
        yield Text(
            "The total index of a parameter is at most its mean squared derivative times the Poincaré constant of its "
            "distribution over the variance of the output. The active subspace is spanned by the directions along "
            "which the output changes most, in parameters over their standard deviations."
        )
        for output in results.drawn:
            yield Heading(output, level=3)
            yield bounds(results, output)
            yield leading_direction(results, output)
            yield eigenvalues(results, output)
            summary = f"{output} against its leading direction: a curve if only that direction matters."
            spectrum = f"Eigenvalues of the active subspace of {output} with 95 % ranges."
            yield Pictures(
                [
                    Picture.drawn(plots.active_summary(dataset, output), summary),
                    Picture.drawn(plots.spectrum(dataset, output), spectrum),
                ]
            )


def slope_unit(results: Results, output: str, name: str) -> str:
    """Unit of a squared derivative."""
    unit = per(results.unit(output), results.parameter_unit(name))
    return unit if unit == "1" else f"({unit})²"


def bounds(results: Results, output: str) -> Table:
    """Derivative-based measures of an output and the bounds on total indices, beside local and total indices."""
    of_output = results.of(output)
    rows = []
    for name in results.parameters:
        of = of_output.sel(parameter=name)
        squared = with_unit(with_error(float(of["dgsm"]), float(of["dgsm_error"])), slope_unit(results, output, name))
        total = with_error(float(of["sobol_total"]), float(of["sobol_total_error"])) if "sobol_total" in of else NONE
        bound = with_error(float(of["total_bound"]), float(of["total_bound_error"]))
        corrected = results.corrected("total_bound", {"output": output, "parameter": name})
        share, constant = number(float(of["local_share"])), number(float(of["poincare"]))
        rows.append((name, share, squared, constant, total, bound, *corrected))
    head = (
        "parameter",
        "share of the local variance",
        "mean squared derivative",
        "Poincaré constant",
        "total index (expansion)",
        "is at most",
        *(("is at most, corrected",) if "total_bound_corrected" in results.dataset else ()),
    )
    return Table(head, rows)


def leading_direction(results: Results, output: str) -> Table:
    """Components of the direction along which an output changes most, in parameters over their deviations."""
    of_output = results.of(output)
    directions = zip(of_output["active_direction"], of_output["active_direction_error"], strict=True)
    rows = [
        (name, with_error(float(component), float(error)))
        for name, (component, error) in zip(results.parameters, directions, strict=True)
    ]
    return Table(("parameter", "leading direction"), rows)


def eigenvalues(results: Results, output: str) -> Table:
    """Eigenvalues of the mean of ∇ψ∇ψᵀ of an output, each with its share of their sum."""
    of_output = results.of(output)
    values = [of_output[f"active_eigenvalue{end}"].to_numpy() for end in ("", "_lower", "_upper")]
    whole = max(float(values[0].sum()), 1e-300)
    rows = [
        (str(i), number(value), f"{number(lower)} to {number(upper)}", percent(value / whole))
        for i, (value, lower, upper) in enumerate(zip(*values, strict=True), start=1)
    ]
    return Table(("direction", "eigenvalue", "95 % range", "share of their sum"), rows)
