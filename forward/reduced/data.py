"""What a reduced model consists of, and the file that holds it.

A state is Σ_k c_k φ_k: coordinates c begin with what prescribed displacements move (`lifts`), then fields that only
test (`tests`, virtual displacements whose work is an output; their c is 0), then the modes, of which a smaller model
takes the first. Integrals know the values of these fields where they are evaluated, so nothing depends on the mesh.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from forward.graph import Tape, from_arrays, to_arrays
from forward.hyperelastic import Hyperelastic
from forward.machine import write_whole
from forward.model import FloatArray, ModelError
from forward.settings import shown

FORMAT = 1


@dataclass(frozen=True, eq=False)
class Points:
    """Where an integrand is evaluated.

    Attributes
    ----------
    weights
        Weights (n,) of the points; volumes or areas with those of a rule.
    fields
        Values (m, n, N) of the m components that the integrand takes of each of the N coordinate fields.
    given
        What else it takes there (g, n): places, normals, indicators of regions.
    logs
        For each random field that it depends on: its number, the logarithm (n,) without coefficients and the change
        (n, k) by each coefficient.
    """

    weights: FloatArray
    fields: FloatArray
    given: FloatArray
    logs: tuple[tuple[int, FloatArray, FloatArray], ...] = ()

    def of(self, coordinates: int) -> Points:
        """Return the points with the first coordinates."""
        return replace(self, fields=np.ascontiguousarray(self.fields[:, :, :coordinates]))

    def some(self, chosen: NDArray[np.int64], weights: FloatArray, coordinates: int) -> Points:
        """Return some of the points with other weights, and the first coordinates."""
        return Points(
            weights,
            np.ascontiguousarray(self.fields[:, chosen, :coordinates]),
            self.given[:, chosen],
            tuple((number, log[chosen], slopes[chosen]) for number, log, slopes in self.logs),
        )


@dataclass(frozen=True, eq=False)
class Output:
    """An output.

    Attributes
    ----------
    kind
        "linear": `row` · c. "work": that of all forces on the test field number `which`. "integral": of a density,
        divided by `size`, over `points`, or over those that a level has for integral number `which`. "peak": the
        largest value of a density over `points`. "largest": the largest displacement over the nodes along axis
        `which`, or its length if that is 3.
    """

    name: str
    unit: str
    kind: str
    row: FloatArray | None = None
    which: int = 0
    size: float = 1.0
    density: Tape | None = None
    points: Points | None = None


@dataclass(frozen=True, eq=False)
class LevelData:
    """Equations of so many modes: virtual works with their points, and points of the outputs that are integrals."""

    modes: int
    works: tuple[Points, ...]
    integrals: tuple[Points, ...]


@dataclass(frozen=True, eq=False)
class ReducedData:
    """A reduced model.

    Attributes
    ----------
    spec
        The body that was reduced, as a table.
    parameters
        Paths of its parameters, in the order of the arrays.
    nominal, spread, lower, upper
        Means, standard deviations, and smallest and largest values in the snapshots, of the parameters (d,).
    numbers
        Which parameters (p,) integrands depend on, in the order of the numbers of tapes.
    coefficients
        For each random field, its label and which parameters (k,) are its coefficients.
    lifts
        For each field that prescribed displacements move: its parameter (−1: none) and its value otherwise.
    tests
        How many test fields there are.
    dead
        Loads that are proportional to a number: its parameter (−1: none), its value otherwise, and the works (N,) on
        the coordinate fields.
    works
        Virtual works whose integrands are evaluated at points. Inputs of these tapes are the components of the state,
        what is given, the logarithms of random fields, and the numbers of the model; outputs (m,) are what works on the
        m components. Those of densities return a value.
    levels
        The model, and the nested larger one with which its errors are estimated.
    outputs
        Outputs.
    fields
        The coordinate fields (N, U), at the nodes.
    places, cells, cell_kind, regions
        Nodes (n, 3), cells and regions as in `NodalSpace`.
    factors
        Of each random field at the nodes: logarithm (n,) without coefficients, slopes (n, k), variance that is kept.
    snapshots, coordinates
        Parameters (s, d) of the snapshots and their coordinates (s, N).
    about
        How it was made, and the errors that it has on unseen samples; read by people.
    """

    spec: dict[str, Any]
    parameters: tuple[str, ...]
    nominal: FloatArray
    spread: FloatArray
    lower: FloatArray
    upper: FloatArray
    numbers: NDArray[np.int64]
    coefficients: tuple[tuple[str, NDArray[np.int64]], ...]
    lifts: tuple[tuple[int, float], ...]
    tests: int
    dead: tuple[tuple[int, float, FloatArray], ...]
    works: tuple[Tape, ...]
    levels: tuple[LevelData, ...]
    outputs: tuple[Output, ...]
    fields: FloatArray
    places: FloatArray
    cells: NDArray[np.int64]
    cell_kind: int
    regions: NDArray[np.int64] | None
    factors: tuple[tuple[FloatArray, FloatArray, float], ...]
    snapshots: FloatArray
    coordinates: FloatArray
    about: dict[str, Any] = field(default_factory=dict)

    @property
    def before(self) -> int:
        """How many coordinates come before the modes."""
        return len(self.lifts) + self.tests


def save(data: ReducedData, path: Path) -> None:
    """Write a reduced model to one file: arrays of NumPy, and a table that says what they are."""
    arrays: dict[str, NDArray[Any]] = {}
    table = _packed(data, "", arrays)
    buffer = BytesIO()
    np.savez_compressed(buffer, table=np.array(json.dumps({"format": FORMAT, "model": table})), **arrays)
    write_whole(path, buffer.getvalue())


def load(path: Path) -> ReducedData:
    """Read a reduced model.

    Raises
    ------
    ModelError
        If the file is not there, or holds something else.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            table = json.loads(str(file["table"]))
            found: ReducedData | None = _unpacked(table["model"], file) if table["format"] == FORMAT else None
    except OSError as error:
        raise ModelError(f"{path}: cannot be read: {error.strerror or 'it is not a reduced model'}") from None
    except (KeyError, ValueError, TypeError, zipfile.BadZipFile):
        raise ModelError(f"{path}: is not a reduced model, expected a file that `tissuq reduce` has made") from None
    if found is None:
        raise ModelError(f"{path}: made by another version, expected format {FORMAT}; run `tissuq reduce` again")
    return found


def body_of(table: Mapping[str, Any], name: str = "") -> Hyperelastic:
    """Return the body that a reduced model was made of, from its table; a name says of which file.

    Raises
    ------
    ModelError
        If it has kinds of its own, whose module is not there.
    """
    try:
        return Hyperelastic.model_validate(table)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        said = f"{'.'.join(map(str, first['loc']))}: {first['msg']}; given {shown(first['input'])}"
        raise ModelError(f"{name or 'the reduced model'}: its body: {said}") from None


_CLASSES = (Points, Output, LevelData, ReducedData)


def _packed(value: Any, name: str, arrays: dict[str, NDArray[Any]]) -> Any:
    """Return a value as a table; arrays go to `arrays`, by their place."""
    match value:
        case np.ndarray():
            arrays[name] = value
            return {"array": name}
        case Tape():
            parts = {key: _packed(one, f"{name}.tape.{key}", arrays) for key, one in to_arrays(value).items()}
            return {"class": "Written", "parts": {"tape": {"tape": parts}}}
        case Points() | Output() | LevelData() | ReducedData():
            parts = {key: _packed(one, f"{name}.{key}", arrays) for key, one in vars(value).items()}
            return {"class": type(value).__name__, "parts": parts}
        case tuple():
            return {"tuple": [_packed(one, f"{name}.{i}", arrays) for i, one in enumerate(value)]}
        case dict():
            return {"table": value}
        case np.generic():
            return value.item()
        case _:
            return value


def _unpacked(value: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    match value:
        case {"array": name}:
            return arrays[name]
        case {"class": "Written", "parts": {"tape": {"tape": parts}}}:
            return from_arrays({key: _unpacked(one, arrays) for key, one in parts.items()})
        case {"class": kind, "parts": parts}:
            (made,) = (one for one in _CLASSES if one.__name__ == kind)
            return made(**{key: _unpacked(one, arrays) for key, one in parts.items()})
        case {"tuple": items}:
            return tuple(_unpacked(one, arrays) for one in items)
        case {"table": table}:
            return table
        case _:
            return value


class ReducedSpace:
    """The `NodalSpace` of a reduced model: every rank has all of it."""

    def __init__(self, data: ReducedData, places: NDArray[np.int64], base: FloatArray) -> None:
        self._data, self._places, self._base = data, places, base
        self.coordinates = data.places
        self.displacements = data.places.size

    def cells(self) -> tuple[NDArray[np.int64], int]:
        """Return all cells as nodes, and VTK's number of their type."""
        return self._data.cells, self._data.cell_kind

    def regions(self) -> NDArray[np.int64] | None:
        """Return the region of each cell; None without regions."""
        return self._data.regions

    def gather(self, rows: FloatArray) -> FloatArray:
        """Return the rows: they are whole."""
        return rows

    scatter = gather

    def factors(self, points: FloatArray, degree: int | None = None) -> dict[str, FloatArray]:
        """Return the factors (n, N) of each random field at parameters (n, d), at the nodes."""
        whole = np.tile(self._base, (len(points), 1))
        whole[:, self._places] = points
        pairs = zip(self._data.coefficients, self._data.factors, strict=True)
        return {label: np.exp(log + whole[:, which] @ slopes.T) for (label, which), (log, slopes, _) in pairs}

    @property
    def variance_kept(self) -> dict[str, float]:
        """Fraction of the variance of each random field that its modes make."""
        pairs = zip(self._data.coefficients, self._data.factors, strict=True)
        return {label: kept for (label, _), (_, _, kept) in pairs}
