"""What a study will cost, before anything is imported or computed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, NamedTuple

from forward.bodies.mesh_file import OwnMesh
from forward.fem.cost import ADDRESSES_OF_PROGRAM, BYTES_OF_PROGRAM, COMPILATION, REPORT, START, Times
from forward.fem.finer import finer
from forward.machine import MIB, Headroom, compiled_forms, limits
from forward.model import Finding
from forward.spec import ModelSpec
from uq.evaluation.evaluate import OWN
from workflows.config.study import Study, ranges
from workflows.run import own_code

if TYPE_CHECKING:
    from forward.fem.locking import Decision
    from forward.specimen import Specimen
    from workflows.config.study import AnyStudy
    from workflows.studies.inversion import Inversion, InversionStudy
    from workflows.studies.output_inversion import OutputInversion
    from workflows.studies.selection import Comparison
    from workflows.studies.synthesis import Synthesis


def memory(study: AnyStudy) -> float:
    """Predict the memory (bytes) of a group of ranks beside that of the program; 0 where there are no finite elements.

    A body that is sampled has a factor for its solutions and one for a reference, each load case of a specimen has one.
    """
    if isinstance(study, Study):
        return _of_models([study.spec, *study.models.values()])
    from workflows.studies.inversion import InversionStudy
    from workflows.studies.synthesis import Synthesis

    if isinstance(study, InversionStudy | Synthesis):
        return _of_models([study.model])
    return _of_models([*getattr(study, "specimens", {}).values()])


def _of_models(specs: Sequence[ModelSpec]) -> float:
    return sum(cost.bytes for cost in (spec.cost() for spec in specs) if cost is not None)


def shortage(study: AnyStudy, groups: int = 1) -> Finding | None:
    """Say that the memory of this machine may not do for a study, by so many groups of ranks on it."""
    need = memory(study)
    if not need:
        return None
    for limit in sorted(limits(), key=lambda one: one.size):
        wanted = need + of_program(limit)
        wanted *= 1 if limit.of_each_process else groups
        if wanted > limit.size:
            text = f"memory may run out: about {wanted / MIB:,.0f} MiB are needed, {limit}"
            return Finding("warning", text)
    return None


def of_program(limit: Headroom) -> float:
    """Memory (bytes) of the program itself, as a limit counts it."""
    return ADDRESSES_OF_PROGRAM if limit.of_addresses else BYTES_OF_PROGRAM


SECONDS_PER_SURROGATE = 0.8  # fits and clouds for one evidence


def plan(study: AnyStudy, groups: int = 1) -> list[str]:
    """Describe a study in lines: unknowns, solves, memory and predicted time."""
    short = shortage(study, groups)
    found = [*study.findings, *([] if short is None else [short])]
    return [*_planned(study, groups), *own_code.listed(study), *(f"{one.severity:10}  {one.text}" for one in found)]


def _planned(study: AnyStudy, groups: int) -> list[str]:
    if not isinstance(study, Study):
        return _of_other_kinds(study)
    method, spec, planned = study.method, study.spec, study.planned
    up_to = "up to " if method.open_ended and not method.undecided else ""
    later = f" for {method.undecided}, which decide how many more" if method.undecided else ""
    lines = [
        f"method      {method.kind}",
        *(f"{what:10}  {words}" for what, words in study.model.described(ranges(study.parameters))),
    ]
    for k, mesh in enumerate(study.meshes[1:], 1):
        cost = mesh.cost()
        taken = "" if cost is None else f" ({cost.sample:.2g} s a solve)"
        lines.append(f"            {mesh.unknowns:,} on mesh {k}{taken}")
    lines += [
        f"parameters  {', '.join([*study.parameters, *_in_series(spec.coefficients)])}",
        f"outputs     {', '.join(output.name for output in spec.outputs)}",
        f"solves      {up_to}{planned:,}{later}",
    ]
    if spec.cost() is None:  # no one knows how long a solve takes
        return lines
    return [
        *lines,
        f"memory      about {(memory(study) + BYTES_OF_PROGRAM) / MIB:,.0f} MiB for each group of ranks",
        *_told(parts(study), groups, up_to, later and ", then more"),
    ]


def _in_series(paths: Sequence[str]) -> Iterator[str]:
    """Name the coefficients of each random field by the first and the last."""
    for _, series in groupby(paths, lambda path: path.rpartition(".")[0]):
        first, *rest = series
        yield f"{first} to {len(rest)}"


class Part(NamedTuple):
    """What a part of a study takes: predicted processor time (s), what for, and whether groups of ranks share it."""

    seconds: float
    what: str
    shared: bool = False


def _times(spec: ModelSpec) -> Times:
    found = spec.cost()
    assert found is not None
    return found


def parts(study: Study) -> list[Part]:
    """Predict what a study of a body takes, part by part.

    Samples are the most that there may be; those that multilevel methods add after their pilots are not known.
    """
    method, dimension = study.method, len(study.inputs.names)
    costs = {OWN: _times(study.spec)} | {name: _times(model) for name, model in study.models.items()}
    found = [_times(mesh) for mesh in study.meshes]
    samples = study.planned - len(found)
    seconds = min(method.seconds(dimension, costs), getattr(method, "budget_seconds", None) or float("inf"))
    corrected = samples > 0 and found[0].predicted
    further = f"{samples:,} further solves, {found[0].sample:.2g} s each"
    return [
        Part(START, "start of the program"),
        *([] if _compiled_before() else [Part(COMPILATION, "compilation of the forms")]),
        Part(sum(one.first for one in found), f"first solve{' on every mesh' if len(found) > 1 else ''}"),
        Part(sum(one.tangents(dimension) for one in found), "its tangents"),
        *([Part(sum(one.reference(dimension) for one in found), "reference factor")] if corrected else []),
        *([Part(seconds, further, shared=True)] if samples > 0 else []),
        Part(REPORT, "results and report"),
    ]


def _compiled_before() -> bool:
    """Whether forms were compiled on this machine; which, only a run can tell."""
    return any(compiled_forms().glob("forms-*/*/"))


def _told(found: Sequence[Part], groups: int, up_to: str, more: str) -> list[str]:
    """Say what a study takes by the clock, if every group of ranks has a core, and of what that is the sum."""
    by_clock = [part.seconds / (groups if part.shared else 1) for part in found]
    cores = f"{groups} core{'s' if groups > 1 else ''}"
    lines = [f"time        {up_to}about {_duration(sum(by_clock))} on {cores}, to a factor of 2{more}:"]
    lines += [f"            {_duration(s):>8}  {part.what}" for s, part in zip(by_clock, found, strict=True)]
    if _compiled_before():
        lines.append(
            f"            and {COMPILATION:.0f} s or more where the forms of this kind of body are not compiled yet"
        )
    return lines


def _formulation(decision: Decision) -> str:
    """Say which formulation is taken, and why."""
    return f"form        {'mixed' if decision.mixed else 'displacement'}: {decision.why}"


def _of_other_kinds(study: Comparison | InversionStudy | Synthesis) -> list[str]:
    from workflows.studies.inversion import Inversion, InversionStudy
    from workflows.studies.output_inversion import OutputInversion
    from workflows.studies.synthesis import Synthesis

    if isinstance(study, Inversion):
        return _inversion(study)
    if isinstance(study, InversionStudy):
        assert isinstance(study, OutputInversion)
        return _inversion_of_outputs(study)
    return _synthesis(study) if isinstance(study, Synthesis) else _comparison(study)


PRODUCTS_OF_FIELD = 500  # for a mode and its pairs
PRODUCT = 0.12  # time of a product, of that of a solve by Newton's method from a state nearby


def _inversion(study: Inversion) -> list[str]:
    from workflows.studies.inversion import SOLVES_OF_FIELD

    spec, sets = study.specimen, study.data.sets
    usable = [m for m in study.measurements if m is not None]
    counts = [int(m.observations.measured.sum()) for m in usable]
    moved = [int((m.moved > 0).sum()) for m in usable]
    cases = [_times(spec.loaded(case)) for case in spec.cases]
    each, textbook = sum(one.corrected for one in cases), sum(one.textbook for one in cases)
    if study.field:
        unknown = f"{spec.body.vertex_count:,} values of ln stiffness"
        seconds = (
            textbook * (SOLVES_OF_FIELD + PRODUCT * PRODUCTS_OF_FIELD) + 2 * study.method.solves(field=True) * each
        )
    else:
        unknown = f"{len(study.names)}: {', '.join(study.names)}"
        seconds = textbook * 15 * study.method.starts + each * study.method.solves(field=False)
    seconds += each * study.method.chain_solves(len(study.names), field=study.field)
    once, checked = _mesh_check(spec) if study.method.mesh_check else (0.0, NOT_ASKED)
    seconds += once
    return [
        f"method      {study.method.kind}",
        f"unknown     {unknown}",
        *(f"{what:10}  {found}" for what, found in spec.body.listed.items()),
        f"load cases  {', '.join(case.name for case in spec.cases)}, of {spec.unknowns:,} unknowns each",
        _formulation(study.model.decision(ranges(study.parameters))),
        f"data sets   {len(usable)}, of {', '.join(f'{count:,}' for count in counts)} components",
        *([f"            {_moved(sum(moved), max(m.moved.max() for m in usable))}"] if sum(moved) else []),
        f"mesh check  {checked}",
        f"time        about {_duration(seconds)} for each on 1 core (rough)",
        *(f"warning     {item.refused}" for item in sets if item.refused),
    ]


def _inversion_of_outputs(study: OutputInversion) -> list[str]:
    from workflows.studies.output_inversion import derivable

    spec, sets, method = study.spec, study.data.sets, study.method
    counts = [len(found.values) for found in study.measurements if found is not None]
    lines = [
        f"method      {method.kind}",
        *(f"{what:10}  {words}" for what, words in study.model.described(ranges(study.parameters))),
        f"unknown     {len(study.names)}: {', '.join(study.names)}",
        f"outputs     {', '.join(study.parts)}",
        f"data sets   {len(counts)}, of {', '.join(f'{count:,}' for count in counts)} values",
        f"solves      about {study.solves // len(counts):,} for each",
    ]
    cost = spec.cost()
    if cost is None:
        derivable(study.spec.build(None, study.inputs.names), spec.kind)
    else:
        d = len(study.inputs.names)
        seconds = study.solves / len(counts) * (cost.sample + cost.tangents(d) / 4)
        if method.mesh_check:
            seconds += 8**2 * cost.textbook
            lines.append(f"mesh check  one solve of about {8 * spec.unknowns:,} unknowns")
        else:
            lines.append(f"mesh check  {NOT_ASKED}")
        lines.append(f"time        about {_duration(seconds)} for each on 1 core (rough)")
    return [*lines, *(f"warning     {item.refused}" for item in sets if item.refused)]


NOT_ASKED = "not asked for: nothing will be said to be trusted"


def _mesh_check(spec: Specimen) -> tuple[float, str]:
    """Predict the processor time (s) of a solve on a finer mesh, and say what is solved."""
    try:
        if isinstance(spec.body, OwnMesh):  # divided in a run; a factor grows faster than the mesh
            unknowns, once = 8 * spec.unknowns, 8**2 * sum(_times(spec.loaded(case)).textbook for case in spec.cases)
        else:
            fine = finer(spec)
            unknowns, once = fine.unknowns, sum(_times(fine.loaded(case)).textbook for case in fine.cases)
    except ValueError as error:
        return 0.0, f"not possible: {error}; nothing will be said to be trusted"
    return once, f"one solve of {unknowns:,} displacements, about {_duration(once)}"


def _moved(count: int, farthest: float) -> str:
    are = "point outside the body is" if count == 1 else "points outside the body are"
    return f"{count} {are} moved to its surface, by up to {farthest:.2g} m"


def _synthesis(study: Synthesis) -> list[str]:
    spec, sets = study.specimen, len(study.method.fraction)
    seconds = sets * sum(_times(spec.loaded(case)).textbook for case in spec.cases)
    return [
        f"method      {study.method.kind}",
        *(f"{what:10}  {found}" for what, found in spec.body.listed.items()),
        f"load cases  {', '.join(case.name for case in spec.cases)}, of {spec.unknowns:,} unknowns each",
        _formulation(study.model.decision(ranges(study.parameters))),
        f"data sets   {sets}",
        f"time        about {_duration(seconds)} on 1 core (rough)",
    ]


def _comparison(study: Comparison) -> list[str]:
    method = study.method
    evidences = study.evidences
    seconds = study.seconds_per_solve * study.planned + SECONDS_PER_SURROGATE * evidences
    meshes = [_mesh_check(one) for one in getattr(study, "specimens", {}).values() if study.unchecked]
    if not getattr(method, "mesh_check", True):
        meshes = [(0.0, NOT_ASKED)]
    seconds += sum(once for once, _ in meshes)
    check = " and nested sampling, which takes minutes" if method.check else ""
    data = study.groups.values()
    tests = sum(len(study.tests(group)) for group in study.group_names)
    groups = f" in {len(data)} groups" if len(data) > 1 else ""
    kind = "stresses" if study.quantity == "stress" else "displacements"
    count = (
        f"{sum(one.values.size for one in data)} {kind} of {tests} {'tests' if kind == 'stresses' else 'load cases'}"
    )
    return [
        f"method      {method.kind}",
        f"candidates  {', '.join(f'{name} ({len(c.parameters)})' for name, c in study.candidates.items())}",
        f"data        {count}{groups}",
        f"evidences   {evidences}{check}",
        *(f"mesh check  {words}" for words in dict.fromkeys(words for _, words in meshes)),
        f"solves      about {study.planned:,}",
        f"time        about {_duration(seconds)} on 1 core (rough)",
    ]


def _duration(seconds: float) -> str:
    if seconds < 9.5:
        return f"{seconds:.2g} s"
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
