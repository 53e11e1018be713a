"""The deformed body."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from forward.words import number
from workflows.report import bodies
from workflows.report.blocks import Block, Heading, Picture, Pictures, Text
from workflows.report.section import Results, Section

if TYPE_CHECKING:
    import xarray as xr

DERIVATIVES_DRAWN = 6  # parameters whose effect on the body is drawn
MAPS_DRAWN = 4  # parameters whose indices are drawn on the body
NO_BODY = "The body could not be drawn on this machine: drawing needs OpenGL without a display (Debian: libegl1)."


class Body(Section):
    """The deformed body, coloured by its displacement."""

    def applies(self, results: Results) -> bool:
        """Whether one body was deformed, with or without a stored displacement."""
        return "nominal" in results.dataset and bool(results.study.spec.meshed)

    def content(self, results: Results) -> Iterator[Block]:
        """Pictures, or why there are none."""
        dataset = results.dataset
        yield Heading("The deformed body")
        if "cell_nodes" not in dataset:
            yield Text("This study stores no displacement field.")
            return
        captions = captions_of(dataset)
        drawn = bodies.pictures(dataset, list(captions))
        if drawn is None:
            yield Text(NO_BODY)
            return
        where = "its mean displacement" if "field_mean" in dataset else "the displacement at the mean parameters"
        yield Text(f"Deformed by {where}, to scale; the grey lines are the undeformed body.")
        yield Pictures([Picture.of(drawn[name], caption) for name, caption in captions.items()])


def captions_of(dataset: xr.Dataset) -> dict[str, str]:
    """Return the pictures of the body by name, with their captions."""

    def largest(field: str) -> str:
        return f"at most {number(float(np.linalg.norm(dataset[field].to_numpy(), axis=1).max()))} m"

    if "field_mean" in dataset:
        captions = {
            "mean": f"Mean displacement, {largest('field_mean')}.",
            "std": f"Standard deviation of the displacement, {largest('field_std')}. Orange lines: the edges of the "
            "body where every component is one standard deviation larger, and smaller, than its mean.",
        }
    else:
        captions = {"nominal": f"Displacement at the mean parameters, {largest('field_nominal')}."}
    if "field_derivative" in dataset:
        effects = dataset["field_derivative_rms"] * dataset["parameter_std"]
        strongest = dataset["parameter"].to_numpy()[np.argsort(-effects.to_numpy())][:DERIVATIVES_DRAWN]
        for name in strongest:
            captions[f"derivative {name}"] = f"Displacement by one standard deviation of {name}, to first order."
    if "dominating" in dataset:
        strongest = dataset["parameter"].to_numpy()[np.argsort(-dataset["field_sobol_total"].to_numpy())]
        for name in strongest[:MAPS_DRAWN]:
            captions[f"sobol_first {name}"] = f"First-order index of the displacement for {name}, node by node."
            captions[f"sobol_total {name}"] = f"Total index of the displacement for {name}, node by node."
        captions["dominating"] = "The parameter with the largest total index, node by node."
    if "factor" in dataset:
        for field in dataset["random_field"].to_numpy():
            for i, factor in enumerate(dataset["factor"].sel(random_field=field).to_numpy()):
                ends = f"{number(float(factor.min()), 3)} to {number(float(factor.max()), 3)}"
                captions[f"factor {field} {i}"] = (
                    f"Realisation {i + 1} of the random factor '{field}', {ends}, on the undeformed body."
                )
    return captions
