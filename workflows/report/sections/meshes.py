"""The contribution of each mesh of a multilevel method."""

from __future__ import annotations

from collections.abc import Iterator

from forward.readable import and_error
from forward.words import duration, number
from workflows.report import plots
from workflows.report.blocks import Block, Heading, Picture, Pictures, Table, Text
from workflows.report.section import Results, Section


class Meshes(Section):
    """The meshes of a multilevel method, and the contribution of each."""

    def applies(self, results: Results) -> bool:
        """Whether there are several."""
        return "mesh_samples" in results.dataset

    def content(self, results: Results) -> Iterator[Block]:
        """A table of meshes, and rates, differences and pictures of each output."""
        yield Heading("Meshes")
        yield meshes(results)
        for output in results.outputs:
            yield Heading(output, level=3)
            yield Text(rates(results, output))
            yield differences(results, output)
            yield Pictures(
                [
                    Picture.drawn(
                        plots.mesh_variance(results.dataset, output),
                        f"Variance of {output} and of its difference between meshes.",
                    ),
                    Picture.drawn(
                        plots.mesh_mean(results.dataset, output),
                        f"Mean of {output} and of its difference between meshes.",
                    ),
                    Picture.drawn(
                        plots.mesh_samples(results.dataset, output),
                        "Samples on every mesh: taken, and optimal for other errors.",
                    ),
                    Picture.drawn(
                        plots.mesh_cost(results.dataset, output), "Predicted time of sampling, without linearisations."
                    ),
                ]
            )


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
    """The contribution of every mesh to the mean of an output, and whether it can be trusted."""
    rows = []
    for level in results.dataset["level"].to_numpy():
        here = results.dataset.sel(output=output, level=level)
        unit = results.unit(output)
        text = and_error(float(here["difference_mean"]), float(here["difference_mean_error"]), unit)
        rest = (
            "mesh_variance",
            "difference_variance",
            "difference_variance_ratio",
            "difference_kurtosis",
            "consistency",
        )
        rows.append((f"{level}", text, *(number(float(here[n]), 3) for n in rest)))
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
    of_output = results.of(output)
    weak, strong, cost = (float(of_output[f"{name}_rate"]) for name in ("weak", "strong", "cost"))
    return (
        f"From one mesh to the next, the mean difference falls by 2^{weak:.2f}, its variance by 2^{strong:.2f}, and "
        f"the predicted cost of a solve grows by 2^{cost:.2f}. A consistency below 1 confirms that the sum over the "
        "meshes telescopes."
    )
