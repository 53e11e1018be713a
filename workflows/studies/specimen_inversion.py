"""Studies of what is inside: a specimen in several load cases with measured displacements."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import ValidationError

from forward.bodies.inclusions import log_factor
from forward.model import Finding
from forward.registry import named
from forward.scalars import Mistake
from forward.specimen import Specimen
from inverse.methods.invert import ByReduced, names_of
from uq.inputs.distributions import Normal
from uq.inputs.random_parameters import Inputs
from workflows.config.priors import findings_of_materials, ranges
from workflows.studies.inversion import InversionStudy
from workflows.studies.measured import DataFiles, read_measurement

if TYPE_CHECKING:
    from forward.model import FloatArray
    from forward.reduced.spec import Reduced
    from forward.spec import ModelSpec
    from inverse.data.observations import Components
    from inverse.data.shared_motion import SharedMotion
    from workflows.studies.measured import Measurement

OF_GEOMETRY = frozenset({"m", "m²", "m³", "1"})  # units of outputs that are no forces


class Inversion(InversionStudy):
    """What to invert.

    Parameters
    ----------
    model
        The specimen: body, material, inclusions or a field, load cases.
    parameters
        Priors by the paths of the unknown numbers of the specimen; none for a field of nodal values.
    correlations
        Correlations between them.
    data
        What was measured.
    method
        How it is inverted.
    parallel
        Use of ranks.
    report
        Your own sections of the report.
    predict
        What else is to be known by the posterior; by default nothing.
    """

    model: Specimen
    data: DataFiles

    quantity: ClassVar[str] = "displacement"

    @cached_property
    def specimen(self) -> Specimen:
        """The specimen, in the formulation that suits all values of its parameters."""
        specimen: Specimen = self.model.over(ranges(self.parameters))
        return specimen

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Findings about the specimen before anything is solved."""
        return (
            *self.model.findings,
            *self.model.locking(ranges(self.parameters)),
            *findings_of_materials(self.inputs),
            *self._ratios_alone(),
        )

    def _ratios_alone(self) -> Iterator[Finding]:
        """Find that no force acts or is measured: then displacements do not change if all stiffnesses are doubled."""
        pressed = any(not load.contact for case in self.model.cases for load in case.loads)
        units = self.model.measurable
        seen = [found.observations.readings for found in self.measurements if found is not None]
        names = {(self.parts[case], name) for one in seen for case, name in zip(one.case, one.names, strict=True)}
        if pressed or any(units[case][name] not in OF_GEOMETRY for case, name in names):
            return
        moduli = [
            path
            for path, number in self.model.scalars.items()
            if number.unit == "Pa" and path.startswith(("material.", "regions."))
        ]
        unknown = [path for path in moduli if path in self.parameters]
        fields = [field.label for field in self.model.fields if field.of == "stiffness"]
        known = [path for path in moduli if path not in self.parameters]
        if not unknown and not fields:
            return
        sought = ", ".join([*unknown, *(f"the mean of the field '{label}'" for label in fields)])
        source = f"{', '.join(known)} as stated" if known and not fields else "the prior alone"
        yield Finding(
            "warning",
            "No force acts on the specimen or is among the data, so displacements tell ratios of stiffnesses only: "
            f"the absolute size of {sought} comes from {source}. Measure a force too (outputs of a load case).",
        )

    @cached_property
    def reduced(self) -> tuple[Reduced, ...]:
        """The reduced models that stand for the load cases; none where the specimen is asked itself.

        Raises
        ------
        pydantic.ValidationError
            If a file cannot be used.
        """
        asked = self.method.reduced
        if asked is None:
            return ()
        assert isinstance(asked.file, dict)
        digests = asked.digest if isinstance(asked.digest, dict) else {}
        made: Any = named("forward.reduced.spec:Reduced")
        return tuple(made(file=asked.file[name], digest=digests.get(name)) for name in self.parts)

    @property
    def field(self) -> bool:
        """Whether values of a field at the vertices are what is unknown."""
        return any(field.basis == "nodes" for field in self.model.fields)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters in results; for a field, its mean."""
        if self.field:
            label = f"fields.{self.model.fields[0].label}.mean"
            return names_of(Inputs({label: Normal(mean=0.0, std=1.0)}), self.method)
        return super().names

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of the load cases."""
        return tuple(case.name for case in self.model.cases)

    @property
    def together(self) -> bool:
        """Whether all groups of ranks work on one data set, point by point."""
        return super().together and not self.model.fields

    @property
    def specs(self) -> tuple[ModelSpec, ...]:
        """The specimen, and the same on the finer meshes that it is looked at on."""
        return self._with_finer(self.specimen)

    def measured(self, number: int) -> Components:
        """Return a data set that can be used."""
        found: Components = self.measurements[number].observations.components()
        return found

    def motion(self, number: int) -> SharedMotion | None:
        """Return the uncertain motions of a data set; None if there are none."""
        found: SharedMotion | None = self.measurements[number].motion(self.model.body)
        return found

    def labels(self, number: int) -> list[str]:
        """Say of each datum of a data set where it stands."""
        found: list[str] = self.measurements[number].observations.data_labels()
        return found

    def read(self, path: Path) -> Measurement:
        """Read a file of displacements; errors as in every inversion."""
        return read_measurement(path, self.model, self.data)

    def plan(self, rank_groups: int) -> list[str]:
        """Say what is inverted, and how long that will take."""
        found: list[str] = named("workflows.studies.inversion_plan:plan")(self)
        return found

    def stiffness(self, places: FloatArray, points: FloatArray) -> FloatArray:
        """Return ln of the factor (n, k) of the inclusions on the stiffness at places (k, 3) and parameters (n, d)."""
        return log_factor(self.model.inclusions, self.inputs.names, points, places)

    def _mistakes(self) -> Iterator[Mistake]:
        nodal = [i for i, field in enumerate(self.model.fields) if field.basis == "nodes"]
        if nodal and (len(self.model.fields) > 1 or self.parameters):
            message = "a field of nodal values is inverted alone, expected no other fields and no parameters"
            yield ("model", "fields", nodal[0], "basis"), message, "nodes"
        if nodal and self.model.fields[nodal[0]].of != "stiffness":
            yield ("model", "fields", nodal[0], "of"), "expected stiffness", self.model.fields[nodal[0]].of
        if nodal and self.method.chains in {"emcee", "hmc"}:
            yield ("method", "chains"), "expected 'pcn', the chains for fields", self.method.chains
        if nodal and self.method.noise is not None and self.data.errors.kind != "normal":
            message = "the size of such errors is not inferred with a field, expected { kind = 'normal' } or no noise"
            yield ("data", "errors"), message, self.data.errors.kind
        if not self.parameters and not self.model.fields:
            yield ("parameters",), "nothing is unknown, expected at least one prior, or one of model.fields", {}
        if self.method.expansion is not None:
            message = "data sets of a specimen are observed at places of their own, expected outputs of another model"
            yield ("method", "expansion"), message, self.method.expansion
        if self.method.reduced is not None:
            yield from self._mistakes_of_reduced(self.method.reduced)
        yield from super()._mistakes()

    def _mistakes_of_reduced(self, given: ByReduced) -> Iterator[Mistake]:
        if self.field:
            message = "a field of nodal values has no reduced model, expected few parameters, or the modes of a field"
            yield ("method", "reduced"), message, given.files
            return
        if not isinstance(given.file, dict) or set(given.file) != set(self.parts):
            example = ", ".join(f'{name} = "FILE"' for name in self.parts)
            message = f"a specimen has a reduced model for each load case, expected file = {{ {example} }}"
            yield ("method", "reduced", "file"), message, given.file
            return
        try:
            found = dict(zip(self.parts, self.reduced, strict=True))
        except ValidationError as error:
            yield ("method", "reduced"), str(error.errors()[0]["msg"]), given.files
            return
        object.__setattr__(given, "digest", {name: one.digest for name, one in found.items()})
        unknown = (*self.parameters, *self.model.coefficients)
        for case in self.specimen.cases:
            body = self.specimen.loaded(case)
            known = {*body.scalars, *body.coefficients}
            for said in found[case.name].differences(body, [path for path in unknown if path in known]):
                yield ("method", "reduced", "file", case.name), said, given.file[case.name]
