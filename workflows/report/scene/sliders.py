"""For viewer.js: arrays as text, and the expansion of a study, for any parameters, some fixed and some random."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from forward.model import FloatArray, SolveError
from forward.readable import named as with_its_unit
from forward.readable import spoken
from uq.inputs.distributions import Distribution, Normal
from uq.inputs.sampling import sobol_points
from uq.surrogates.expansion import Expansion
from workflows.report.plots.posterior import density as kernels
from workflows.report.section import Results
from workflows.results.surfaces import IntArray

if TYPE_CHECKING:
    import xarray as xr

    from workflows.studies.sampling import Study

MOST = 160  # parameters
MANY = 24  # parameters from which on each is told with fewer numbers
SAMPLES = 1024  # of dependent parameters
BYTES = 8_000_000  # of the modes of a field, before they are written as text
SOLVES = 128  # with derivatives, of a reduced model: some seconds of processor time
STEPS = (1e-7, 1e-6, 1e-5, 3e-5, 1e-4, 3e-4, 1e-3)  # of the largest displacement, from fine to coarse
QUANTILES, FEWER = 256, 64  # of each parameter
CURVE, SHORTER = 61, 31  # points of each density
SINGLE = 2.0**-21  # relative rounding of sums in the browser, which are of single precision
CHECKED = 64  # points at which the error of the packed field is measured
OF_FIELDS = Normal(mean=0.0, std=1.0)  # the distribution of coefficients of random fields
FARTHEST = 3.72  # standard normal deviations that a slider reaches where a distribution has tails


@dataclass
class Packer:
    """Arrays as text in a page: rounded to a step, differences from row to row, byte by byte, deflated, in base64.

    The browser inflates them by itself (`DecompressionStream`) and adds the differences up again (viewer.js).
    """

    told: list[dict[str, Any]] = field(default_factory=list)
    planes: list[bytes] = field(default_factory=list)

    def add(self, values: Any, step: float = 1.0) -> int:
        """Add an array (n,) or (n, m), rounded to multiples of a step (NaN: missing); return its number."""
        array = np.asarray(values, dtype=float)
        array = array.reshape(len(array), -1)
        missing = np.isnan(array)
        whole = np.rint(np.where(missing, 0.0, array) / step).astype(np.int64)
        differences = np.diff(whole, axis=0, prepend=0).T.ravel()
        zigzag = ((differences << 1) ^ (differences >> 63)).astype(np.uint64)
        count = max(1, -(-int(zigzag.max(initial=0)).bit_length() // 8))
        for k in range(count):
            self.planes.append((zigzag >> np.uint64(8 * k)).astype(np.uint8).tobytes())
        kept = {"n": array.shape[0], "m": array.shape[1], "step": step, "planes": count}
        if missing.any():
            kept["missing"] = np.flatnonzero(missing.any(axis=1)).tolist()
        self.told.append(kept)
        return len(self.told) - 1

    def field(self, values: FloatArray, relative: float) -> int:
        """Add an array, rounded to a part of its largest number."""
        finite = np.abs(values[np.isfinite(values)])
        size = float(finite.max(initial=0.0))
        return self.add(values, relative * size if size > 0 else 1.0)

    def text(self) -> str:
        """Return all arrays as one text."""
        return base64.b64encode(zlib.compress(b"".join(self.planes), 9)).decode()


@dataclass(frozen=True)
class Sliders:
    """An expansion of outputs and perhaps displacements, fitted to results `of` a study, and what its parameters are.

    Distributions are `given` by names, none of coefficients of random fields; of parameters that depend on each other
    there are samples (n, d).
    """

    expansion: Expansion
    of: Results
    given: Mapping[str, Distribution]
    samples: FloatArray | None = None

    def packed(self, pack: Packer, nodes: IntArray) -> dict[str, Any]:
        """Put the modes of the field at some nodes among other arrays, and return the rest."""
        basis, of, dataset = self.expansion.basis, self.expansion, self.of.dataset
        own = np.nan_to_num(dataset.get("own_error", 0.0))
        errors = np.nan_to_num(np.hypot(dataset["loo_error"] * dataset["std"], own), posinf=0.0)
        told: dict[str, Any] = {
            "parameters": [self._parameter(i, name) for i, name in enumerate(of.parameters)],
            "indices": basis.indices.tolist(),
            "outputs": [
                {"name": name, "unit": self.of.unit(name), "coefficients": column.tolist(), "error": float(error)}
                for name, column, error in zip(of.output_names, of.coefficients.T, errors, strict=True)
                if name in self.of.drawn
            ],
            "source": dataset.attrs.get("source", ""),  # what the expansion is of, if not of the model itself
        }
        if self.samples is not None:
            told["joint"] = self._joint(pack, self.samples)
        if of.fields is not None:
            told["field"] = self._field(pack, of.fields[:, nodes].reshape(len(of.coefficients), -1))
        return told

    def _joint(self, pack: Packer, samples: FloatArray) -> dict[str, Any]:
        """Return what dependent parameters are drawn by, and what functions of them are made of.

        Standardised samples of all parameters; some are fixed, and the others follow by x + (v − x_S) C_SS⁻¹ C_S, with
        the correlations C of the samples: exact of Gaussian parameters.
        """
        basis = self.expansion.basis
        coordinates = basis.coordinates
        mixing = coordinates.mixing
        assert basis.joint is not None
        assert mixing is not None
        start = int(basis.joint.members[0])
        x = np.where(coordinates.logarithmic, np.log(np.where(coordinates.logarithmic, samples, 1.0)), samples)
        x = (x - coordinates.centre) / coordinates.scale
        correlations = np.eye(x.shape[1])
        correlations[start:, start:] = mixing[start:, start:] @ mixing[start:, start:]
        # With the means and correlations of the draws themselves, which some samples of them have but nearly.
        own = np.cov(x.T, bias=True)
        x = (x - x.mean(axis=0)) @ np.linalg.solve(np.linalg.cholesky(own).T, np.linalg.cholesky(correlations).T)
        return {
            "samples": pack.add(x, 1e-6),
            "correlations": correlations.tolist(),
            "start": start,
            "parting": np.linalg.inv(mixing)[start:, start:].tolist(),
            "indices": basis.joint.indices.tolist(),
            "inverse": basis.joint.inverse.tolist(),
            "numbers": basis.joint.number(basis.indices).tolist(),
        }

    def _parameter(self, i: int, name: str) -> dict[str, Any]:
        from scipy.special import ndtri

        distribution, basis = self.given.get(name, OF_FIELDS), self.expansion.basis
        z = np.linspace(-FARTHEST, FARTHEST, 401)
        count, points = (FEWER, SHORTER) if len(self.expansion.parameters) > MANY else (QUANTILES, CURVE)
        u = (np.arange(count) + 0.5) / count
        (values, slopes), middle = distribution.from_normal(z), distribution.from_normal(ndtri(u))[0]
        fitted = [float(self.expansion.lower[i]), float(self.expansion.upper[i])]
        low, high = distribution.support or (float(values[0]), float(values[-1]))
        low, high = min(low, fitted[0]), max(high, fitted[1])
        at = np.linspace(low, high, points)
        density = np.interp(at, values, np.exp(-(z**2) / 2) / np.maximum(slopes, 1e-300), left=0, right=0)
        if (samples := self.samples) is not None:
            density = kernels(samples[:, [i]], np.full(len(samples), 1 / len(samples)), at[:, None])
        coordinates = basis.coordinates
        logarithmic = bool(coordinates.logarithmic[i])
        centre, scale = float(coordinates.centre[i]), float(coordinates.scale[i])
        joint = basis.joint if basis.joint is not None and i >= basis.joint.members[0] else None
        degree = int((basis.indices[:, i] if joint is None else joint.indices).max(initial=0))
        return {
            "path": name,
            "name": with_its_unit(spoken(name), self.of.parameter_unit(name)),
            "low": low,
            "high": high,
            "fitted": fitted,
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
        peaks = np.abs(modes).max(axis=1)
        for relative in STEPS:
            step = relative * largest
            # A mode whose part of no node is above half a step is not seen.
            count = max(1, int((np.linalg.norm(left, axis=0) * sizes * peaks > step / 2).sum()))
            bits = np.log2(2 + (sizes * peaks)[:count] / step)
            if modes.shape[1] * float(np.ceil(bits / 8).max()) * count <= BYTES:
                break
        scaled, factors = sizes[:count, None] * modes[:count], left[:, :count]
        rounded = np.rint(scaled / step) * step
        # Over the whole of each slider, each in an order of its own.
        ends = zip(self.expansion.lower, self.expansion.upper, strict=True)
        some = [np.random.default_rng(i).permutation(np.linspace(*end, CHECKED)) for i, end in enumerate(ends)]
        psi = self.expansion.basis.values(np.column_stack(some))
        error = np.abs(psi @ (coefficients - factors @ rounded)).max()
        loo = float(self.of.dataset.get("field_loo_error", np.nan))
        return {
            "modes": pack.add(scaled.reshape(count, -1, 3).transpose(1, 2, 0).reshape(-1, 3 * count), step),
            "factors": factors.tolist(),
            "rounding": float(1.5 * error + SINGLE * np.abs(psi @ coefficients).max()),
            "loo": loo if np.isfinite(loo) else None,
        }


def sliders(dataset: xr.Dataset, study: Study) -> Sliders | None:
    """Return the sliders of a study; None without an expansion, or of too many parameters.

    A reduced model is cheap enough to make an expansion of, where the study has none. Of parameters that depend on each
    other by a copula there are no sliders: expansions are not of these.
    """
    given = study.given
    if dataset.sizes["parameter"] > MOST or study.correlations:
        return None
    if "multi_index" not in dataset:
        spec: Any = study.spec
        if spec.kind != "reduced":
            return None
        try:
            dataset = expanded(Path(spec.file), study, alone=spec.larger)
        except SolveError:
            return None
    expansion, samples = Expansion.of(dataset), None
    if expansion.basis.joint is not None:
        given = study.inputs.marginals
        samples = study.inputs.points(sobol_points(0, 0, 0, SAMPLES, len(study.inputs.names)))
    return Sliders(expansion, Results(dataset, {}, study), given, samples)


def expanded(file: Path, study: Study, *, alone: bool = False) -> xr.Dataset:
    """Return the expansion of a reduced model over the inputs of a study, with its mesh, as `chaos` returns one.

    `own_error` (output,) is the root mean square error of the model itself on samples that it was not made of; NaN if
    none were solved. `alone` takes the larger model.

    Raises
    ------
    SolveError
        If the model has no answer at the means, or at too many samples.
    """
    from forward.reduced.data import load
    from forward.reduced.model import ReducedModel
    from forward.reduced.spec import Reduced
    from uq.evaluation.evaluate import SerialEvaluate
    from uq.methods.chaos import Chaos
    from workflows.results.directory import label, with_regions

    data, inputs = load(file), study.inputs
    model = ReducedModel(data, inputs.names, alone=alone, tested=False)
    found = Chaos(samples=SOLVES, quantiles=()).run(inputs, SerialEvaluate(model))
    units = {output.name: output.unit for output in data.outputs}
    found = label(found, units, model.space.coordinates, *model.space.cells())
    found = with_regions(found, model.spec.body.regions, model.space.regions())
    own = Reduced(file=str(file)).errors
    left = data.about.get("error of the state")
    itself = "" if left is None else f", which itself errs by {100 * left:.2g} % of the displacements"
    found.attrs["source"] = f"The expansion was fitted to {SOLVES} solves of the reduced model{itself}."
    return found.assign(own_error=("output", [own.get(str(name), np.nan) for name in found["output"].to_numpy()]))
