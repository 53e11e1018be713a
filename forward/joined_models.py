"""Several models of a study as one, with numbers that they share: such as a body and tests of its material."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, Literal

from pydantic import Field
from scipy.sparse import block_diag, csr_matrix, identity, kron, vstack

from forward.combine import Joined, Rows, sums_of, taking
from forward.fem.cost import Times, sum_of
from forward.findings import Finding
from forward.materials.admissible import Materials
from forward.model import ForwardModel
from forward.registry import OfKind
from forward.scalars import Mistake, Ranges, Scalar
from forward.settings import nearest
from forward.spec import MODELS, ModelSpec, NamedOutput, PlainOutput

Name = Annotated[str, Field(pattern=r"^[^.\s]+$")]


class JoinedModels(ModelSpec):
    """Several models, whose outputs and numbers are called NAME.OUTPUT and NAME.PATH by the names of the models.

    Parameters
    ----------
    models
        The models by name, without random fields.
    shared
        Paths of numbers that are one number in all models that have them, and keep their path: ``["material.C1"]``.
    """

    kind: Literal["joined"] = "joined"
    models: dict[Name, Annotated[ModelSpec, OfKind(MODELS, "hyperelastic", but="joined")]] = Field(min_length=2)
    shared: tuple[str, ...] = ()

    def path_of(self, name: str, path: str) -> str:
        return path if path in self.shared else f"{name}.{path}"

    def own(self, name: str, ranges: Ranges) -> dict[str, Any]:
        """Return what is said by paths of numbers of all models, of those of one, by its own paths."""
        paths = {path: self.path_of(name, path) for path in self.models[name].scalars}
        return {path: ranges[whole] for path, whole in paths.items() if whole in ranges}

    @property
    def scalars(self) -> dict[str, Scalar]:
        found: dict[str, Scalar] = {}
        for name, model in self.models.items():
            for path, scalar in model.scalars.items():
                found.setdefault(self.path_of(name, path), scalar)
        return found

    @property
    def unavailable(self) -> Mapping[str, str]:
        pairs = ((name, model.unavailable.items()) for name, model in self.models.items())
        return {self.path_of(name, path): why for name, every in pairs for path, why in every}

    @cached_property
    def outputs(self) -> tuple[NamedOutput, ...]:
        """What all models return, of one after that of the other."""
        return tuple(
            PlainOutput(f"{name}.{one.name}", one.unit, getattr(one, "estimable", True), getattr(one, "negative", True))
            for name, model in self.models.items()
            for one in model.returned
        )

    @property
    def parts(self) -> Mapping[str, ModelSpec]:
        return self.models

    @property
    def hidden(self) -> str:
        """That errors of meshes are not estimated where it is sampled."""
        of = [f"'{name}'" for name, model in self.models.items() if model.bodies]
        return f"the error of the mesh of {', '.join(of)} is not estimated where models are joined" if of else ""

    def materials(self, parameters: Collection[str] = ()) -> Materials | None:
        """Return the materials of all models, which are of one kind, as functions of some numbers, by their paths."""
        energy, places = "", dict[str, Mapping[str, float | str]]()
        for name, model in self.models.items():
            found = model.materials([path for path in model.scalars if self.path_of(name, path) in parameters])
            if found is None:
                continue
            energy = found.energy
            for place, values in found.constants.items():
                renamed = {constant: self.path_of(name, path) for constant, path in found.varied[place].items()}
                places[f"models.{name}.{place}"] = {**values, **renamed}
        return Materials(energy, places) if places else None

    def over(self, ranges: Ranges) -> JoinedModels:
        models = {name: model.over(self.own(name, ranges)) for name, model in self.models.items()}
        return self.model_copy(update={"models": models})

    def findings_over(self, ranges: Ranges) -> tuple[Finding, ...]:
        every = ((name, model.findings_over(self.own(name, ranges))) for name, model in self.models.items())
        return tuple(one.of(f"Model '{name}'") for name, found in every for one in found)

    def mistakes_of_samples(self) -> Iterator[Mistake]:
        for name, model in self.models.items():
            for (_, *place), message, given in model.mistakes_of_samples():
                yield ("model", "models", name, *place), message, given

    @property
    def description(self) -> str:
        return "; ".join(f"{name}: {model.description}" for name, model in self.models.items())

    def described(self, ranges: Ranges) -> Iterator[tuple[str, str]]:
        for name, model in self.models.items():
            for what, words in model.described(self.own(name, ranges)):
                yield what, f"{name}: {words}"

    def cost(self) -> Times | None:
        known = [cost for model in self.models.values() if (cost := model.cost()) is not None]
        return sum_of(known) if known else None

    def identity(self) -> dict[str, Any]:
        return super().identity() | {"models": {name: model.identity() for name, model in self.models.items()}}

    def build(self, comm: Any, parameters: tuple[str, ...]) -> Joined:
        made = []
        for name, model in self.models.items():
            own = [(path, self.path_of(name, path)) for path in model.scalars]
            acting = [(path, parameters.index(whole)) for path, whole in own if whole in parameters]
            part = model.build(comm, tuple(path for path, _ in acting))
            made.append(taking(part, [column for _, column in acting], parameters))
        return Joined(tuple(made), tuple(one.name for one in self.outputs), tuple(f"model '{n}'" for n in self.models))

    def _mistakes(self) -> Iterator[Mistake]:
        for i, path in enumerate(self.shared):
            values = {name: one.scalars[path].value for name, one in self.models.items() if path in one.scalars}
            if len(values) < 2:
                known = [path for model in self.models.values() for path in model.scalars]
                twice = tuple(dict.fromkeys(path for path in known if known.count(path) > 1))
                yield ("shared", i), f"not a number of two models; {nearest(path, twice)}", path
            elif len(set(values.values())) > 1:
                listed = ", ".join(f"{value:g} in {name}" for name, value in values.items())
                yield ("shared", i), f"{listed}, expected one value", path
        kinds = dict.fromkeys(found.energy for one in self.models.values() if (found := one.materials()) is not None)
        if len(kinds) > 1:
            yield ("models",), f"materials of kinds {', '.join(kinds)}, expected one kind", list(kinds)
        for name, model in self.models.items():
            if model.coefficients:
                yield ("models", name, "fields"), "random fields, expected numbers only", len(model.coefficients)


@dataclass(frozen=True)
class JoinedMeshes:
    """Joined models on finer meshes: of each, or None of those without meshes."""

    parts: tuple[Any, ...]

    def of(self, observed: Any) -> ForwardModel:
        """Return the model of what all outputs tend to, and of the gaps between the meshes (`forward.fem.finer`)."""
        joined: Any
        joined, sums = sums_of(observed)
        found = []
        for meshes, part in zip(self.parts, joined.models, strict=True):
            model, count = part.model, len(part.outputs)
            both = vstack([identity(count), csr_matrix((count, count))], format="csr")
            fine = Rows(model, both, tuple(map(str, range(2 * count)))) if meshes is None else meshes.of(model)
            found.append(replace(part, model=fine))
        whole = replace(joined, models=tuple(found), outputs=tuple(one for part in found for one in part.outputs))
        # Of each part both in turn, and so of all.
        sizes = [len(part.outputs) for part in joined.models]
        S = vstack([block_diag([kron(half, identity(n)) for n in sizes]) for half in ([1, 0], [0, 1])], format="csr")
        S = block_diag([sums] * 2, format="csr") @ S
        gaps = (f"{name} (between the meshes)" for name in observed.outputs)
        return Rows(whole, S, (*observed.outputs, *gaps))
