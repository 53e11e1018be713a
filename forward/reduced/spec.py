"""The specification of a reduced model: the file that `tissuq reduce` has made, read without FEniCSx."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple
from zipfile import BadZipFile

import numpy as np
from pydantic import Field, model_validator

from forward.findings import Finding
from forward.hyperelastic import Hyperelastic
from forward.loaded import LoadedBody
from forward.materials.admissible import Materials
from forward.model import FloatArray, ModelError
from forward.reduced.data import body_of
from forward.registry import named
from forward.scalars import Ranges, Scalar
from forward.spec import ModelSpec

LETTERS = 16  # of a hash
BY_CHANCE = 0.01  # so rarely an end of the distribution is farther from all snapshots than a study may go beyond them
DOUBTFUL = 0.05  # error on unseen samples, relative to the spread of an output, above which it is one
_APART = ("outputs", "solver", "stresses")  # blocks of a body in which one and its reduced model may differ


class _About(NamedTuple):
    """What a study needs to know of a file."""

    body: Hyperelastic
    parameters: tuple[str, ...]
    told: dict[str, Any]
    digest: str
    nominal: FloatArray
    spread: FloatArray
    lower: FloatArray
    upper: FloatArray


def digest_of(file: str) -> str:
    """Return the hash of a reduced model; a ModelError says that its file cannot be read."""
    try:
        return sha256(Path(file).read_bytes()).hexdigest()[:LETTERS]
    except OSError as error:
        raise ModelError(f"{file}: cannot be read: {error.strerror}") from None


class Reduced(ModelSpec):
    """A reduced model of a body: few modes at few points, with estimates of its errors.

    Its parameters are those that were random when it was made; those that a study does not name keep their means.

    Parameters
    ----------
    file
        What `tissuq reduce` has made.
    tolerance
        Estimated error of any output, relative to the standard deviation that it has in the snapshots, above which the
        full model is asked instead; none by default. Needs FEniCSx.
    larger
        Take the nested larger model, that estimates the errors of the other one: closer to the body and some times as
        expensive, with no estimates of its own.
    accept_unstable
        Whether equilibria are accepted without a test of their stability; these are found in lockstep, which is several
        times as fast.
    unbalanced
        What part of the forces may then be left out of balance: 1e-4, which takes half of the time, changes outputs by
        some 1e-4 of their spread.
    within
        Whether outputs are cut off a quarter of their range beyond those of the snapshots, as beside a body, which says
        what is beyond: a largest stress where a cell is nearly turned inside out may be several times too large.
    digest
        Hash of the file, kept with results: another file of the same name is refused.
    """

    kind: Literal["reduced"] = "reduced"
    file: str
    tolerance: Annotated[float, Field(gt=0)] | None = None
    larger: bool = False
    accept_unstable: bool = False
    unbalanced: Annotated[float, Field(gt=0, lt=1)] = 1e-9
    within: bool = False
    digest: str = Field(default_factory=lambda known: digest_of(known["file"]))

    @model_validator(mode="after")
    def _check(self) -> Reduced:
        now = self._about.digest
        if self.digest != now:
            raise ModelError(f"{self.file} has changed since the study was begun: hash {self.digest} → {now}")
        if self.larger and self.tolerance is not None:
            raise ModelError(
                "larger = true with a tolerance, expected one of them: nothing estimates errors of the larger model"
            )
        return self

    @cached_property
    def _about(self) -> _About:
        digest = digest_of(self.file)
        try:
            with np.load(self.file, allow_pickle=False) as file:
                parts = json.loads(str(file["table"]))["model"]["parts"]
                told, body = parts["about"]["table"], parts["spec"]["table"]
                names = tuple(parts["parameters"]["tuple"])
                arrays = [file[f".{name}"] for name in ("nominal", "spread", "lower", "upper")]
        except (KeyError, ValueError, TypeError, OSError, BadZipFile):
            message = f"{self.file}: is not a reduced model, expected a file that `tissuq reduce` has made"
            raise ModelError(message) from None
        return _About(body_of(body, self.file), names, told, digest, *arrays)

    @property
    def outputs(self) -> Sequence[Any]:
        """The outputs of the body."""
        return self._about.body.outputs

    @property
    def scalars(self) -> Mapping[str, Scalar]:
        about, known = self._about, self._about.body.scalars
        pairs = zip(about.parameters, about.nominal, strict=True)
        return {path: known[path]._replace(value=float(value)) for path, value in pairs if path in known}

    @property
    def coefficients(self) -> tuple[str, ...]:
        return tuple(path for path in self._about.parameters if path not in self._about.body.scalars)

    @property
    def unavailable(self) -> Mapping[str, str]:
        """Numbers of the body that were not random when it was made."""
        others = set(self._about.body.scalars) - set(self._about.parameters)
        why = "kept its value when the model was reduced; make it random in that study"
        return dict.fromkeys(others, why)

    @property
    def seconds_together(self) -> float:
        """Weigh a solve in lockstep against solves of bodies, see `uq.methods.method.seconds_per_solve`.

        Fitted to 0.40 and 0.95 ms with 40 and 60 modes at 313 and 372 points of 4,641 and 32,175 unknowns, 1.0 and 4.6
        ms with 128 and 300 modes at 694 and 1,413 points (a 2.8 GHz core, 64 in lockstep, a ten-thousandth of the
        forces left, the largest stress among the outputs).
        """
        told, which = self._about.told, " of the larger model" if self.larger else ""
        modes, points = told[f"modes{which}"], told[f"points{which}"]
        return float(5e-4 + 9e-9 * points * modes)

    def materials(self, parameters: Collection[str] = ()) -> Materials:
        return self._about.body.materials(parameters)

    @property
    def symmetric(self) -> bool:
        """Whether the stiffness of the body is symmetric."""
        return self._about.body.symmetric

    @property
    def description(self) -> str:
        told = self._about.told
        size = f"{told['modes']} modes, {told['points']} points, from {told['snapshots']} snapshots"
        return f"reduced model of a body of {told['unknowns']:,} unknowns: {size}"

    @property
    def hidden(self) -> str:
        """That of the mesh of the body."""
        size = f"{self._about.told['unknowns']:,}"
        of_body = f"what the mesh of its body ({size} unknowns) errs"
        return f"the model is a reduced one, and {of_body} is in all that it computes"

    def described(self, ranges: Ranges) -> Iterator[tuple[str, str]]:
        """Say how large it is, and what errors it has on samples that it was not made of."""
        yield "model", self.description
        errors = self._about.told.get("errors")
        if errors:
            each = ", ".join(f"{name} {100 * error:.2g} %" for name, error in errors.items())
            yield "errors", f"{each} of the spread (root mean square of {self._about.told['unseen']} unseen samples)"

    def findings_over(self, ranges: Ranges) -> tuple[Finding, ...]:
        """Say where a study goes beyond the snapshots, and which outputs have large errors."""
        return (*self.outside(ranges), *without_answer(self._about.told), *self._of_errors())

    def outside(self, ranges: Ranges) -> Iterator[Finding]:
        """Find parameters that go beyond the snapshots.

        Snapshots do not reach the ends of a distribution: all n of a uniform one are farther from an end than a share x
        of its range with probability (1 − x)ⁿ, here `BY_CHANCE`. Half a standard deviation is always allowed.
        """
        about = self._about
        seen = BY_CHANCE ** (1 / max(int(about.told["snapshots"]), 1))
        rows = zip(about.parameters, about.lower, about.upper, about.spread, strict=True)
        for path, low, high, spread in rows:
            if path not in ranges:
                continue
            margin = max((1 - seen) / seen * (high - low), 0.5 * spread)
            first, last = ranges[path]
            if first < low - margin or last > high + margin:
                values = {"path": path, "first": first, "last": last, "low": low, "high": high}
                yield Finding("reduced-extrapolates", "warning", values)

    @property
    def errors(self) -> Mapping[str, float]:
        """Root mean square errors of the outputs on samples that it was not made of, in their units."""
        about = self._about
        spread = dict(zip((output.name for output in self.outputs), about.told["spread"], strict=True))
        return {name: error * spread[name] for name, error in about.told.get("errors", {}).items()}

    def _of_errors(self) -> Iterator[Finding]:
        errors = self._about.told.get("errors", {})
        if not errors:
            yield Finding("reduced-unmeasured", "warning")
        large = [f"{name} {100 * error:.2g} %" for name, error in errors.items() if error > DOUBTFUL]
        if large:
            yield Finding("reduced-errs", "warning", {"large": ", ".join(large)})

    def differences(self, body: Hyperelastic, unknown: Collection[str]) -> Iterator[str]:
        """Say why it cannot stand for a body with these parameters, one line each."""
        about = self._about
        trained = dict(zip(about.parameters, zip(about.lower, about.upper, strict=True), strict=True))
        for path in unknown:
            if path not in trained:
                yield f"'{path}' kept its value when the model was reduced, expected it among the parameters then"
        here, there = body.scalars, about.body.scalars
        for path in here:
            value = here[path].value
            if path in trained:
                low, high = trained[path]
                if path not in unknown and not low <= value <= high:
                    yield f"{path} = {value:.6g}, but the model was trained from {low:.6g} to {high:.6g}"
            elif path in there and value != there[path].value:
                yield f"{path} = {value:.6g}, but the model was made with {there[path].value:.6g}"
        numbers = {path.rsplit(".", 1)[-1] for path in here}
        ours, theirs = (_shape(one, numbers) for one in (body, about.body))
        off = [block for block in ours | theirs if ours.get(block) != theirs.get(block)]
        if off:
            yield f"made of another body, which has other {', '.join(off)}"
        outputs = {output.name: output for output in about.body.outputs}
        lost = [output.name for output in body.outputs if outputs.get(output.name) != output]
        if lost:
            yield f"made without the outputs {', '.join(lost[:5])}"

    def standing_for(self, body: ModelSpec, parameters: tuple[str, ...]) -> Any:
        """Load it with the outputs of a body, and its values of all numbers that are not parameters."""
        data = named("forward.reduced.data:load")(Path(self.file))
        kept = {path: number.value for path, number in body.scalars.items() if path in data.parameters}
        names = tuple(output.name for output in body.outputs)
        return named("forward.reduced.model:ReducedModel")(data, parameters, names, kept=kept)

    def identity(self) -> dict[str, Any]:
        """Return everything that results depend on; the file counts by its hash, not by its path."""
        found = super().identity()
        found.pop("file")
        return found

    def build(self, comm: Any, parameters: tuple[str, ...]) -> Any:
        """Load it; every rank has all of it.

        Raises
        ------
        ModelError
            If the full model is to be asked for parameters other than those of the file.
        """
        data = named("forward.reduced.data:load")(Path(self.file))
        if self.tolerance is not None and set(parameters) != set(data.parameters):
            missing = ", ".join(path for path in data.parameters if path not in parameters)
            raise ModelError(
                f"model.tolerance asks the full model, for which all its parameters are random; missing: {missing}"
            )
        body = self._about.body
        return named("forward.reduced.model:ReducedModel")(
            data,
            parameters,
            tolerance=self.tolerance,
            full=lambda: body.build(comm, parameters),
            alone=self.larger,
            tested=not self.accept_unstable,
            unbalanced=self.unbalanced,
            within=self.within,
        )


def _shape(body: Hyperelastic, numbers: set[str]) -> dict[str, Any]:
    """Return the blocks of a body on which a reduced model depends, without numbers that can be parameters."""

    def bare(table: dict[str, Any]) -> dict[str, Any]:
        return {key: value for key, value in table.items() if key not in numbers or isinstance(value, dict | list)}

    whole = body.model_dump(mode="json", exclude_none=True, exclude={*_APART})
    found: dict[str, Any] = json.loads(json.dumps(whole), object_hook=bare)
    return found | {"body": whole["body"]}


def mistakes(spec: LoadedBody) -> Iterator[str]:
    """Say what of a body cannot be reduced, one line each."""
    rubbing = [load.label for load in spec.loads if load.contact and not load.symmetric]
    if rubbing:
        yield (
            f"a reduced model has no friction, which depends on the way that a tool went, expected friction = 0 of "
            f"{', '.join(rubbing)}"
        )
    if spec.strains == "small":
        yield "strains are small, and the energy of a reduced model is that of finite ones, expected strains = 'finite'"
    for load in (load for load in spec.loads if not load.written):
        yield f"the load '{load.label}' is no form and cannot be reduced, expected loads that are written as forms"
    known = {"displacement", "mean-displacement", "max-displacement", "reaction", "strain-energy", "volume-change"}
    known |= {"max-von-mises", "force"}
    for output in spec.outputs:
        kind = str(getattr(output, "kind"))  # noqa: B009 - every output has a kind
        if kind not in known and "." not in kind:
            yield f"the output '{output.name}' of kind '{kind}' cannot be reduced"


def without_answer(told: Mapping[str, Any]) -> Iterator[Finding]:
    """Find that the body had no answer at some points: a reduced model knows none of these, and may answer there."""
    lost = told.get("without an answer", 0) + told.get("unseen without an answer", 0)
    if lost:
        unseen, answered = told.get("unseen without an answer", 0), told.get("of these answered all the same", 0)
        how = f" (at {answered} of {unseen} such unseen samples it does)" if unseen else ""
        yield Finding("reduced-body-fails", "warning", {"lost": lost, "how": how})
    own = told.get("unseen that only the body answers", 0)
    if own:
        yield Finding("reduced-finds-none", "warning", {"lost": own})
