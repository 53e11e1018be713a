"""Priors with values for which there is no model: what is refused, and what is said about the rest."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from forward.findings import Finding
from forward.materials.admissible import Materials
from forward.scalars import Mistake
from forward.settings import nearest
from uq.inputs.distributions import Distribution, Normal
from uq.inputs.random_parameters import Inputs

if TYPE_CHECKING:
    from forward.spec import ModelSpec
    from uq.inputs.draws import Draws
    from workflows.config.blocks import Correlation

NEGLIGIBLE = 5.9978070150076865  # standard normal value: a tail of probability 1e-9 may lie outside what is admissible
LEAST = 0.5  # smallest probability of admissible constants


def ranges(parameters: Mapping[str, Distribution]) -> dict[str, tuple[float, float]]:
    """Return the ranges of parameters, by their paths."""
    return {path: distribution.range for path, distribution in parameters.items()}


def inputs_of(
    parameters: Mapping[str, Distribution],
    correlations: Iterable[Correlation] = (),
    coefficients: Iterable[str] = (),
    materials: Materials | None = None,
    draws: Draws | None = None,
) -> Inputs:
    """Return random parameters: given ones, then standard normal coefficients of random fields; then those of draws."""
    own = {**parameters, **dict.fromkeys(coefficients, Normal(mean=0.0, std=1.0))}
    if draws is not None:
        own = {name: one for name, one in own.items() if name not in draws.names}
    pairs = tuple((*one.between, one.value) for one in correlations)
    return Inputs(own, pairs, materials, draws=draws)


def impossible_draws(spec: ModelSpec, draws: Draws, paths: Collection[str]) -> Iterator[tuple[str, float, str]]:
    """Go through draws by name, with the share where the model is impossible and why it is at the first of them.

    Those of the parameters, by `paths`, that are constants of materials are judged together, elsewhere.
    """
    scalars, constants = spec.scalars, _constants(spec, paths)
    for name, values in zip(draws.names, draws.values.T, strict=True):
        known = {} if name in constants else {one: scalars[name].objection(float(one)) for one in np.unique(values)}
        bad = np.array([known.get(one) is not None for one in values])
        yield name, float(draws.weights[bad].sum()), next((why for why in known.values() if why is not None), "")


def mistakes_of_factor(prior: Distribution | None, *place: str) -> Iterator[Mistake]:
    """Find a prior of the factor on standard deviations of errors that allows values ≤ 0."""
    if prior is None:
        return
    lowest, _ = prior.ends(NEGLIGIBLE)
    if lowest < 0:
        message = f"reaches {lowest:.4g}, expected a factor on standard deviations, which is positive"
        yield place, message, prior.model_dump()


def mistakes_of_parameters(spec: ModelSpec, parameters: Mapping[str, Distribution]) -> Iterator[Mistake]:
    """Find parameters, by paths, that are not numbers of a model, or that allow values for which it is impossible.

    Constants of materials are left out, which are judged together. Numbers that are unavailable come with the reason.
    """
    scalars, constants = spec.scalars, _constants(spec, parameters)
    for path, distribution in parameters.items():
        why = spec.unavailable.get(path)
        if why is not None or path not in scalars:
            yield ("parameters",), why or f"not a number of the model; {nearest(path, tuple(scalars))}", path
            continue
        if path in constants:
            continue
        for end in distribution.ends(NEGLIGIBLE):
            objection = scalars[path].objection(end)
            if objection is not None:
                message = f"reaches {end:.4g}, where the model is impossible ({objection})"
                yield ("parameters", path), message, distribution.model_dump()
                break


def _constants(spec: ModelSpec, paths: Collection[str]) -> tuple[str, ...]:
    """Those of some paths that are constants of materials."""
    materials = spec.materials(paths)
    return () if materials is None else materials.names


def mistakes_of_materials(inputs: Inputs, materials: Materials) -> Iterator[Mistake]:
    """Find distributions of constants most of which are inadmissible; constants are judged together."""
    if inputs.admitted >= LEAST:
        return
    middle = inputs.points(np.full((1, len(inputs.names)), 0.5))[0]
    objection = materials.objection(dict(zip(inputs.names, map(float, middle), strict=True)))
    said = f"; at the medians, {objection}" if objection is not None else ""
    message = f"{100 * (1 - inputs.admitted):.3g} % of the values are impossible{said}"
    yield ("parameters",), message, list(materials.names)


def findings_of_materials(inputs: Inputs, *, fail: bool = False) -> Iterator[Finding]:
    """Say how much of a prior is inadmissible and that the rest is rescaled, or how many samples `fail` for it."""
    if inputs.admitted < 1:
        share = 100 * (1 - inputs.admitted)
        values = {"share": f"{share:.2g} %" if share > 0.01 else "less than 0.01 %"}
        if fail:
            yield Finding("samples-inadmissible", "warning", values)
        else:
            yield Finding("prior-inadmissible", "note", values)
