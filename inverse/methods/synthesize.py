"""The method `synthesize`: data of a known specimen, with errors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from forward.model import FloatArray, SolveError
from forward.settings import Settings
from inverse.data.registration import Given, Rigid
from inverse.data.table import factor
from uq.evaluation.request import Evaluate, Request
from uq.inputs.random_parameters import Inputs

if TYPE_CHECKING:
    import xarray as xr


class SyntheticNoise(Settings):
    """Independent normal errors of all components.

    Parameters
    ----------
    relative
        Standard deviation over the root mean square of the displacements of the load case.
    absolute
        Standard deviation (m).
    """

    relative: Annotated[float, Field(gt=0)] | None = None
    absolute: Annotated[float, Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _check(self) -> SyntheticNoise:
        if (self.relative is None) == (self.absolute is None):
            raise ValueError("expected either relative or absolute")
        return self


class Synthesize(Settings):
    """Synthetic data: displacements of a known specimen, with errors.

    Parameters
    ----------
    noise
        The errors.
    fraction
        Share of the points in each data set; one number for each data set.
    missing
        Share of the components that are missing in addition.
    format
        Of the files of displacements: tables, or clouds of points with a file in TOML that says what they are, or
        surfaces before and after ("stl", of the vertices of boundaries that are observed).
    units
        Unit of their lengths.
    frame
        The rigid motion from their frame to that of the body, as in `data.registration`; lengths in `units`.
    seed
        Of the errors, of the points, and of parameters that have distributions.
    """

    kind: Literal["synthesize"] = "synthesize"
    noise: SyntheticNoise
    fraction: tuple[Annotated[float, Field(gt=0, le=1)], ...] = Field(default=(1.0,), min_length=1)
    missing: Annotated[float, Field(ge=0, lt=1)] = 0.0
    format: Literal["csv", "vtu", "vtk", "ply", "xdmf", "stl"] = "csv"
    units: str = "m"
    frame: Given | None = None
    seed: Annotated[int, Field(ge=0)] = 0

    @property
    def metres(self) -> float:
        """How many m a unit of the files is."""
        return factor(self.units, "m")

    @property
    def motion(self) -> Rigid:
        """The motion from the frame of the files to that of the body."""
        return Rigid() if self.frame is None else self.frame.at(self.metres)

    @field_validator("units")
    @classmethod
    def _known(cls, units: str) -> str:
        factor(units, "m")
        return units

    def truths(self, inputs: Inputs) -> FloatArray:
        """Draw parameters (n, d) for every data set."""
        count, d = len(self.fraction), len(inputs.names)
        normals = np.random.default_rng(self.seed).standard_normal((count, d))
        return inputs.from_normals(normals)[0] if d else np.zeros((count, 0))

    def run(
        self, inputs: Inputs, evaluate: Evaluate, cases: NDArray[np.int64], points: NDArray[np.int64]
    ) -> xr.Dataset:
        """Solve for every data set, and measure.

        Parameters, of which there may be none, are drawn anew for every data set. Relative errors are shares of the
        root mean square of a group of outputs (m,), such as the load case; those at no point (-1) are in every data
        set. Raises `SolveError` if the specimen has no equilibrium.
        """
        import xarray as xr

        count, m = len(self.fraction), len(evaluate.outputs)
        rng = np.random.default_rng([self.seed, 1])
        truths = self.truths(inputs)
        found = evaluate(Request(truths))
        for failure in found.failures:
            raise SolveError(f"data set {failure.index}: {failure.reason}", failure.history)
        sigma = np.empty((count, m))
        for case in np.unique(cases):
            of_case = cases == case
            size = np.sqrt((found.outputs[:, of_case] ** 2).mean(axis=1, keepdims=True))
            relative, absolute = self.noise.relative, self.noise.absolute
            sigma[:, of_case] = size * relative if relative is not None else absolute
        values = found.outputs + sigma * rng.standard_normal((count, m))
        for k, share in enumerate(self.fraction):
            kept = np.zeros(points.max() + 1, dtype=bool)
            number = max(round(share * len(kept)), 1)
            kept[np.sort(rng.permutation(len(kept))[:number])] = True
            seen = np.append(kept, True)[points]
            left_out = ~seen | (rng.uniform(size=m) < self.missing)
            values[k, left_out & (points >= 0)] = np.nan
        return xr.Dataset(
            {
                "clean": (("data_set", "output"), found.outputs),
                "values": (("data_set", "output"), values),
                "sigma": (("data_set", "output"), sigma),
                "truth": (("data_set", "parameter"), truths),
            },
            {"output": list(evaluate.outputs), "parameter": list(inputs.names)},
        )
