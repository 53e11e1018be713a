"""The expansion of a study for viewer.js: outputs and displacements for any parameters, some fixed and some random."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.model import FloatArray
from forward.readable import spoken
from forward.words import named
from uq.surrogates.expansion import Expansion
from workflows.report.scene.pack import Packer
from workflows.results.level import IntArray

if TYPE_CHECKING:
    import xarray as xr

    from uq.inputs.distributions import Distribution

MOST = 24  # parameters
BYTES = 3_500_000  # of the modes of a field, before they are written as text
STEPS = (1e-7, 1e-6, 1e-5, 1e-4, 1e-3)  # of the largest displacement, from fine to coarse
QUANTILES = 256  # of each parameter
SINGLE = 2.0**-21  # relative rounding of sums in the browser, which are of single precision
CHECKED = 64  # points at which the error of the packed field is measured
FARTHEST = 3.72  # standard normal deviations that a slider reaches where a distribution has tails


@dataclass(frozen=True)
class Sliders:
    """An expansion, and what its parameters are."""

    expansion: Expansion
    given: dict[str, Distribution | None]
    parameter_units: dict[str, str]
    units: dict[str, str]
    loo: FloatArray
    std: FloatArray
    drawn: list[str]
    field_loo: float

    def packed(self, pack: Packer, nodes: IntArray) -> dict[str, Any]:
        """Put the modes of the field at some nodes among other arrays, and return the rest."""
        basis, of = self.expansion.basis, self.expansion
        told: dict[str, Any] = {
            "parameters": [self._parameter(i, name) for i, name in enumerate(of.parameters)],
            "indices": basis.indices.tolist(),
            "outputs": [
                {
                    "name": name,
                    "unit": self.units[name],
                    "coefficients": of.coefficients[:, k].tolist(),
                    "error": float(self.loo[k] * self.std[k]) if np.isfinite(self.loo[k]) else 0.0,
                }
                for k, name in enumerate(of.output_names)
                if name in self.drawn
            ],
        }
        if of.fields is not None:
            told["field"] = self._field(pack, of.fields[:, nodes].reshape(len(of.coefficients), -1))
        return told

    def _parameter(self, i: int, name: str) -> dict[str, Any]:
        distribution, basis = self.given[name], self.expansion.basis
        z = np.linspace(-FARTHEST, FARTHEST, 401)
        u = (np.arange(QUANTILES) + 0.5) / QUANTILES
        from scipy.special import ndtri

        if distribution is None:  # a coefficient of a random field
            values, slopes, middle = z, np.ones_like(z), ndtri(u)
        else:
            values, slopes = distribution.from_normal(z)
            middle = distribution.from_normal(ndtri(u))[0]
        support = None if distribution is None else distribution.support
        low, high = support if support is not None else (float(values[0]), float(values[-1]))
        low, high = min(low, float(self.expansion.lower[i])), max(high, float(self.expansion.upper[i]))
        at = np.linspace(low, high, 61)
        density = np.interp(at, values, np.exp(-(z**2) / 2) / np.maximum(slopes, 1e-300), left=0, right=0)
        coordinates = basis.coordinates
        logarithmic = bool(coordinates.logarithmic[i])
        centre, scale = float(coordinates.centre[i]), float(coordinates.scale[i])
        degree = int(basis.indices[:, i].max(initial=0))
        return {
            "path": name,
            "name": named(spoken(name), self.parameter_units.get(name, "1")),
            "low": low,
            "high": high,
            "fitted": [float(self.expansion.lower[i]), float(self.expansion.upper[i])],
            "start": float(np.median(middle)),
            "density": [round(float(y), 4) for y in density / max(float(density.max()), 1e-300)],
            "quantiles": [(float(x) - centre) / scale for x in (np.log(middle) if logarithmic else middle)],
            "logarithmic": logarithmic,
            "centre": centre,
            "scale": scale,
            "alpha": basis.alpha[i, : degree + 1].tolist(),
            "beta": basis.beta[i, : degree + 1].tolist(),
        }

    def _field(self, pack: Packer, coefficients: FloatArray) -> dict[str, Any]:
        """Turn the terms (P, 3n) so that few modes are left, and round these to what the page can hold."""
        left, sizes, modes = np.linalg.svd(coefficients, full_matrices=False)
        largest = float(np.abs(coefficients).max()) or 1.0
        numbers = modes.shape[1]
        for relative in STEPS:
            step = relative * largest
            # A mode whose part of no node is above half a step is not seen.
            weights = np.linalg.norm(left, axis=0) * sizes
            count = max(1, int((weights * np.abs(modes).max(axis=1) > step / 2).sum()))
            bits = np.log2(2 + (sizes[:count] * np.abs(modes[:count]).max(axis=1)) / step)
            if numbers * float(np.ceil(bits / 8).max()) * count <= BYTES:
                break
        scaled = sizes[:count, None] * modes[:count]
        factors = left[:, :count]
        rounded = np.rint(scaled / step) * step
        points = np.column_stack([self._some(i) for i in range(len(self.expansion.parameters))])
        psi = self.expansion.basis.values(points)
        error = np.abs(psi @ (coefficients - factors @ rounded)).max()
        return {
            "modes": pack.add(scaled.reshape(count, -1, 3).transpose(1, 2, 0).reshape(-1, 3 * count), step),
            "factors": factors.tolist(),
            "rounding": float(1.5 * error + SINGLE * np.abs(psi @ coefficients).max()),
            "loo": self.field_loo if np.isfinite(self.field_loo) else None,
        }

    def _some(self, i: int) -> FloatArray:
        """Return values (n,) of a parameter, in an order of its own, over the whole of its slider."""
        told = self._parameter(i, self.expansion.parameters[i])
        return np.random.default_rng(i).permutation(np.linspace(told["fitted"][0], told["fitted"][1], CHECKED))


def sliders(dataset: xr.Dataset, study: Any) -> Sliders | None:
    """Return the sliders of a study; None without an expansion, or where parameters depend on each other."""
    if "multi_index" not in dataset or "joint_index" in dataset or "coordinate_mixing" in dataset:
        return None
    given = getattr(study, "given", None)
    if given is None or dataset.sizes["parameter"] > MOST or bool(getattr(study, "correlations", False)):
        return None
    expansion = Expansion.of(dataset)
    outputs = [str(name) for name in dataset["output"].values]
    drawn = outputs
    if "step" in dataset.coords:
        drawn = [str(name) for name in dataset["output"].values[dataset["step"] == dataset["step"].max()]]
    return Sliders(
        expansion,
        {name: given.get(name) for name in expansion.parameters},
        dict(study.units_of("/")),
        {name: str(dataset["unit"].sel(output=name).item()) for name in outputs},
        dataset["loo_error"].to_numpy(),
        dataset["std"].to_numpy(),
        drawn,
        float(dataset["field_loo_error"]) if "field_loo_error" in dataset else float("nan"),
    )
