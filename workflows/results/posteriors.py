"""Posteriors that `select` and `invert` have left as draws of numbers of another model."""

from __future__ import annotations

import io
import json
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from forward.model import FloatArray
from forward.settings import nearest
from inverse.data.tables_of_draws import of_table
from inverse.fields.low_rank import symmetric_root
from inverse.low_dimensional.posterior import NOISE
from inverse.methods.predict import with_beside
from uq.evaluation.hdf5 import variables
from uq.inputs.draws import Draws
from workflows.config.blocks import AVERAGED, BESIDE, KEPT, STACKED

if TYPE_CHECKING:
    import xarray as xr


Arrays = Mapping[str, Any]
LETTERS = 16  # of a hash
BEST = "best"


def read(file: str, group: str | None, model: str | None) -> Draws:
    """Read draws by their names in a source.

    A ValueError says in one line that it is not there, unfinished, of another kind, without draws, or ambiguous.
    """
    path = Path(file)
    if path.name == KEPT:
        try:
            with np.load(path) as found:
                names, digest = tuple(map(str, found["names"])), str(found["digest"])
                return Draws(names, found["values"], found["weights"], float(found["effective"]), digest)
        except (OSError, KeyError, ValueError) as error:
            raise ValueError(f"{path}: cannot be read: {error}") from None
    if path.name == "results.nc" and (path.parent / "summary.json").exists():
        path = path.parent
    try:
        if path.is_dir():
            return Left(path).draws(group, model)
        if not path.exists():
            message = f"{path}: is not there, expected a results directory of 'select' or 'invert', or a table of draws"
            raise ValueError(message)
        for what, value in (("group", group), ("model", model)):
            if value is not None:
                raise ValueError(f"{what} = '{value}', but {path.name} is a table of draws, which has no {what}s")
        return of_table(path, sha256(path.read_bytes()).hexdigest()[:LETTERS])
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror or error}") from None


def to_file(draws: Draws) -> bytes:
    """Return the content of a file of draws."""
    file = io.BytesIO()
    np.savez(file, **asdict(draws))
    return file.getvalue()


# --- results of tissuq ---------------------------------------------------------------------------------------------


class Left:
    """What a finished study has left in a directory; a ValueError says in one line what is not there."""

    def __init__(self, file: str | Path) -> None:
        path = Path(file)
        self.path = path.parent if path.name == "results.nc" else path

    @cached_property
    def kind(self) -> str:
        """Kind of its method."""
        try:
            found = json.loads((self.path / "summary.json").read_text(encoding="utf-8"))
            return str(found.get("method"))  # a list has nothing to get
        except (OSError, ValueError, AttributeError):
            begun, there = (self.path / "study.toml").exists(), self.path.exists()
            what = "holds an unfinished study" if begun else "holds no results" if there else "is not there"
            message = f"{self.path}: {what}, expected the directory of a finished study of kind 'select' or 'invert'"
            raise ValueError(message) from None

    @cached_property
    def _content(self) -> tuple[Arrays, Mapping[str, Any]]:
        try:
            found, attributes = variables((self.path / "results.nc").read_bytes())
        except (OSError, KeyError, RuntimeError, ValueError):
            message = f"{self.path / 'results.nc'}: missing or damaged, expected that of a finished study: run it again"
            raise ValueError(message) from None
        return {name: one.values for name, one in found.items()}, attributes

    @property
    def found(self) -> Arrays:
        """The variables of results.nc."""
        return self._content[0]

    @cached_property
    def blocks(self) -> dict[str, Any]:
        """The blocks of the study."""
        return tomllib.loads(str(self._content[1]["config"]))

    @property
    def digest(self) -> str:
        """Hash of the results."""
        _ = self.kind, self._content
        return sha256((self.path / "results.nc").read_bytes()).hexdigest()[:LETTERS]

    def candidate(self, model: str | None) -> str:
        """Return the name of the candidate that is meant, or that is the most probable."""
        best = str(self.found["model"][int(np.nanargmax(self.found["probability"]))])
        return best if model in (None, BEST) else str(model)

    def material(self, model: str | None) -> dict[str, Any]:
        """Return the block of the material of a candidate, or of an inversion; empty where there is none."""
        chosen = self.blocks.get("model", {})
        if "candidates" in self.blocks:
            candidate = self.blocks["candidates"].get(self.candidate(model), {})
            chosen = {**chosen, **candidate, **candidate.get("model", {})}
        block = chosen.get("material", {})
        return dict(block) if isinstance(block, dict) else {}

    def draws(self, group: str | None, model: str | None, *, beside: bool = True) -> Draws:
        """Return the draws of a posterior, with what was uncertain beside the parameters or without it."""
        if self.kind not in READERS:
            known = f"expected one of: {', '.join(READERS)}"
            raise ValueError(f"{self.path}: is a study of kind '{self.kind}', which has no posterior, {known}")
        try:
            found = self.found if beside else _alone(self.found)
            return replace(READERS[self.kind](self.path, found, group, model), digest=self.digest)
        except KeyError as error:
            raise ValueError(
                f"{self.path}: its results.nc has no {error}, expected one that this version has made: run it again"
            ) from None

    def specimens(self, model: str | None) -> dict[str, Draws]:
        """Return the posteriors of the groups of a comparison, or of the data sets of a batch, by their names."""
        if self.kind not in ("select", "invert"):
            raise ValueError(f"{self.path}: is a study of kind '{self.kind}', expected 'select' or 'invert'")
        names = _texts(self.found, "group" if self.kind == "select" else "data_set")
        return {name: self.draws(name, model, beside=False) for name in names if name not in self.lost}

    def shared(self, model: str | None, parameters: Sequence[str]) -> dict[str, FloatArray]:
        """By how many (d,) deviations of its posterior what is uncertain moves the median specimen, for one of its own.

        By what is uncertain, in deviations with a sign; of first order.
        """
        there = "assumption_shift" in self.found and "uncertain" in self.found
        groups = _texts(self.found, "uncertain") if there else []
        if not groups:
            return {}
        shifts, rows = np.asarray(self.found["assumption_shift"]), _texts(self.found, "assumption")
        if self.kind == "select":
            shifts = shifts[_texts(self.found, "model").index(self.candidate(model))]
        known = _texts(self.found, "parameter")
        each = np.nan_to_num(np.nanquantile(shifts[..., [known.index(name) for name in parameters]], 0.5, axis=0))
        # What is uncertain comes first; what has one member has its name.
        return {name: each[rows.index(name) if name in rows else k] for k, name in enumerate(groups)}

    @cached_property
    def lost(self) -> list[str]:
        """The data sets that could not be inverted."""
        if self.kind != "invert":
            return []
        each = zip(_texts(self.found, "data_set"), np.atleast_1d(self.found["ok"]), strict=True)
        return [name for name, inverted in each if not inverted]


def _texts(found: Arrays, name: str) -> list[str]:
    return [str(one) for one in np.atleast_1d(found[name])]


def _chosen(what: str, given: str | None, known: Sequence[str], path: Path) -> int:
    if given is None and len(known) > 1:
        raise ValueError(f"{path}: has several {what}s, expected {what} = one of: {', '.join(known)}")
    if given is not None and given not in known:
        words = [*known, BEST, AVERAGED, STACKED] if what == "model" else list(known)
        raise ValueError(f"{what} = '{given}' is not in {path}; {nearest(given, words)}")
    return 0 if given is None else known.index(given)


def _alone(found: Arrays) -> Arrays:
    """Return results without what was uncertain beside the parameters."""
    return {name: one for name, one in found.items() if name != "uncertain_point"}


def _drawn(names: Sequence[str], values: FloatArray, weights: FloatArray, worth: float = np.inf) -> Draws:
    """Return draws (n, d) with positive weights (n,), without the size of the errors."""
    here = [i for i, name in enumerate(names) if name != NOISE]
    weights = weights / weights.sum()
    most = float(1 / (weights**2).sum())
    return Draws(tuple(names[i] for i in here), values[:, here], weights, min(most, worth))


def _selected(path: Path, found: Arrays, group: str | None, model: str | None) -> Draws:
    """Weighted points of one candidate in one group of data."""
    models, parameters = _texts(found, "model"), np.array(_texts(found, "parameter"))
    k = int(np.nanargmax(found["probability"])) if model == BEST else _chosen("model", model, models, path)
    g = _chosen("group", group, _texts(found, "group"), path)
    weights, values = np.nan_to_num(found["point_weight"][k, g]), found["point"][k, g]
    here, some = np.isfinite(values).any(axis=0), weights > 0
    if not some.any() or not (here & (parameters != NOISE)).any():
        raise ValueError(f"{path}: candidate '{models[k]}' has no draws, as its evidence was not found")
    return _drawn(parameters[here].tolist(), values[some][:, here], weights[some])


def _inverted(path: Path, found: Arrays, group: str | None, model: str | None) -> Draws:
    """Weighted points of the posterior of one data set; its draws in results that have none."""
    if model is not None:
        raise ValueError(f"model = '{model}', but {path} is an inversion, which has one model")
    if "draw" not in found:
        message = f"{path}: is an inversion of a field, which has no draws of numbers, expected one with few parameters"
        raise ValueError(message)
    k = _chosen("group", group, _texts(found, "data_set"), path)
    values = np.asarray(found["point" if "point" in found else "draw"])[k]
    weights = np.nan_to_num(found["point_weight"][k]) if "point" in found else np.ones(len(values))
    whole = np.isfinite(values).all(axis=1) & (weights > 0)
    if not whole.any() or not bool(np.atleast_1d(found["ok"])[k]):
        raise ValueError(f"{path}: has no draws of that data set, which could not be inverted")
    chains = int(np.nan_to_num(np.atleast_1d(found["chains"])[k])) if "chains" in found else 0
    worth = float(np.atleast_1d(found["chain_effective" if chains else "effective"])[k])
    drawn = _drawn(_texts(found, "parameter"), values[whole], weights[whole], worth if worth > 0 else np.inf)
    if "uncertain_point" not in found or "number" not in found:
        return drawn
    by, names = np.asarray(found["uncertain_weight"]), [f"{BESIDE}{name}" for name in _texts(found, "number")]
    means = found["uncertain_value"] + found["uncertain_point"][k][whole] @ by.T
    root = by @ symmetric_root(found["uncertain_covariance"][k])
    both = with_beside(drawn.values, drawn.weights, means, root)
    return Draws((*drawn.names, *names), *both, drawn.effective)


def _of_population(path: Path, found: Arrays, group: str | None, model: str | None) -> Draws:
    """Draws of a new specimen or, with its name, of one of the population."""
    if model is not None:
        raise ValueError(f"model = '{model}', but {path} is a population, which has one model")
    values = np.asarray(found["population_draw"])
    if group is not None:
        values = np.asarray(found["specimen_draw"])[_chosen("group", group, _texts(found, "specimen"), path)]
    weights = np.full(len(values), 1 / len(values))
    worth = min(float(found["population_effective"]), len(values))
    return Draws(tuple(_texts(found, "parameter")), values, weights, worth)


READERS = {"select": _selected, "invert": _inverted, "population": _of_population}


def draws_in(found: xr.Dataset, kind: str) -> Draws:
    """Return the draws in the results of a study of one group of data or data set; errors as of `read`."""
    values = _alone({str(name): one.values for name, one in found.variables.items()})
    return READERS[kind](Path("results"), values, None, None)


class NamedCandidate(NamedTuple):
    """A candidate of a comparison: its probability with the error of that, and the block of its material."""

    name: str
    probability: float
    error: float
    material: dict[str, Any]


def candidates(file: str, by: str) -> list[NamedCandidate]:
    """Return the candidates of a comparison, the most probable first, or that of the largest weight ("stacking").

    A ValueError says in one line that it is none of materials.
    """
    left = Left(file)
    if left.kind != "select":
        raise ValueError(
            f"{left.path}: is a study of kind '{left.kind}', expected 'select' for model = 'averaged' or 'stacked'"
        )
    if by not in left.found:
        raise ValueError(f"{left.path}: has no weights of stacking, as it was made by an earlier version: run it again")
    shares = zip(left.found["model"], left.found[by], left.found[f"{by}_error"], strict=True)
    every = [NamedCandidate(str(m), float(p), float(e), left.material(str(m))) for m, p, e in shares]
    without = [one.name for one in every if "kind" not in one.material]
    if without:
        message = f"{left.path}: candidates {', '.join(without)} have no material, expected a comparison of materials"
        raise ValueError(message)
    return sorted(every, key=lambda one: -one.probability)
