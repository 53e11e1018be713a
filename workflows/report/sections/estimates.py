"""Moments, quantiles and distributions of outputs, and what controls and expansions did for them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from forward.readable import and_error, margin, size
from forward.words import number, worth
from uq.estimators.estimate import estimate_of, part, single
from uq.estimators.moments import half_width
from workflows.report import plots
from workflows.report.blocks import Block, Heading, Pictures, Table, Text
from workflows.report.plots.moments import WORDS
from workflows.report.section import Results, section


@section("mean", "nominal", heading="Mean and standard deviation")
def moments(results: Results) -> Iterator[Block]:
    """Mean and standard deviation of the outputs, with their errors."""
    yield Text("± is one standard error; a 95\u00a0% interval is about twice as wide on either side.")
    kinds = [
        *WORDS.items(),
        *((part(name, "corrected"), f"{word}, error of the mesh added") for name, word in WORDS.items()),
    ]
    kinds += [(f"plain_{name}", f"{word}, plain Monte Carlo") for name, word in WORDS.items()]
    yield results.estimates({name: word for name, word in kinds if name in results.dataset})


@section("bias_error", heading="Total errors", level=3)
def total_errors(results: Results) -> Iterator[Block]:
    """Errors of means and standard deviations by source."""
    yield Text("The error of the mesh is estimated from the differences between meshes.")
    rows = []
    for output in results.outputs:
        of_output = results.of(output)
        for name, word in WORDS.items():
            one, bias = single(of_output, name), "bias_error" if name == "mean" else "std_bias_error"
            found = (one.error, float(of_output[bias]), one.total)
            errors = [margin(error, results.unit(output)) for error in found]
            rows.append((f"{word} of {output}", *errors))
    yield Table(("estimate", "sampling", "mesh", "total"), rows)


@section("quantiles", heading="Quantiles", level=3)
def quantiles(results: Results) -> Iterator[Block]:
    """Quantiles of the outputs."""
    rows = []
    for output in results.outputs:
        found = estimate_of(results.of(output), "quantiles")
        for words, values, errors in (
            (output, found.value, found.error),
            (f"{output}, corrected for the mesh", found.corrected, found.left),
        ):
            if words == output or np.isfinite(values).all():
                pairs = zip(values.tolist(), errors.tolist(), strict=True)
                rows.append((words, *(and_error(value, error, results.unit(output)) for value, error in pairs)))
    yield Table(("output", *(f"{100 * p:g} %" for p in results.dataset["quantile"].to_numpy())), rows)


@section("nominal", heading="Outputs at the mean parameters")
def nominal(results: Results) -> Iterator[Block]:
    """The outputs at the mean parameters."""
    values = results.dataset["nominal"].to_numpy()
    rows = [(o, size(float(v), results.unit(o), 6)) for o, v in zip(results.outputs, values, strict=True)]
    yield Table(("output", "value"), rows)


@section(
    "values", "nominal", heading="Distribution and convergence", when=lambda results: "density" not in results.dataset
)
def distribution(results: Results) -> Iterator[Block]:
    """Samples of the outputs, and how their estimates converge."""
    dataset = results.dataset
    for output in results.drawn:
        yield Heading(output, level=3)
        yield Pictures.of(
            (plots.histogram(dataset, output), f"Samples of {output}: density, mean and quantiles."),
            (plots.convergence(dataset, output), f"Running mean of {output} with its 95 % confidence band."),
            (plots.standard_error(dataset, output), f"Standard error of the mean of {output}."),
            small=True,
        )


@section("density", heading="Distribution and convergence")
def density(results: Results) -> Iterator[Block]:
    """Densities of the outputs by an expansion."""
    drawn = {output: plots.histogram(results.dataset, output) for output in results.drawn}
    captions = ((ax, f"Density of {output} by the expansion, mean and quantiles.") for output, ax in drawn.items())
    yield Pictures.of(*captions, small=True)


@section("variance_ratio")
def control_variate(results: Results) -> Iterator[Block]:
    """What the control variate, or quasi-random points, gain, output by output."""
    dataset, means = results.dataset, "the control variate"
    if "scramble" in dataset:
        means = "Sobol' points and the control variate" if "coefficient" in dataset else "Sobol' points"
        R = int(dataset["scramble"].max()) + 1
        spread = number(100 * (2 / (R - 1)) ** 0.5, 2)
        yield Text(
            f"Errors come from the scatter of {R} independent scrambles, so that their squares are known to about "
            f"{spread} %; a 95 % interval is ± {number(half_width(dataset), 3)} of them."
        )
    if "control_samples" in dataset:
        error, fitted = number(float(dataset["loo_error"].max()), 2), int(dataset["control_samples"])
        yield Text(
            f"The control variate is an expansion fitted to {fitted} separate samples, with a leave-one-out "
            f"error of at most {error} standard deviations."
        )
    for output in dataset["output"].values:
        mean, std = (float(dataset[name].sel(output=output)) for name in ("variance_ratio", "std_variance_ratio"))
        text = (
            f"{output}: with {means}, one sample is worth {worth(mean)} plain samples for the mean "
            f"and {worth(std)} for the standard deviation."
        )
        worse = [word for word, ratio in (("mean", mean), ("standard deviation", std)) if ratio < 1]
        if worse:
            text += f" For the {' and the '.join(worse)}, plain Monte Carlo is better."
        yield Text(text, "warning" if worse else "")


@section("multi_index", heading="Polynomial chaos")
def expansion(results: Results) -> Iterator[Block]:
    """The polynomials of an expansion, and their errors."""
    yield Text("The leave-one-out error is that at each sample of the expansion fitted to the others.")
    dataset = results.dataset
    sizes = (f"{int(dataset['order'])}", f"{dataset.sizes['term']}", f"{int(dataset['ok'].sum())}")
    errors = [number(float(error), 2) for error in dataset["loo_error"].sel(output=results.outputs)]
    rows = [(output, *sizes, error) for output, error in zip(results.outputs, errors, strict=True)]
    yield Table(("output", "order", "terms", "samples", "leave-one-out error / standard deviation"), rows)
