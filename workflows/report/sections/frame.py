"""What every report has: header, findings, model, priors, failures, run time, provenance."""

from __future__ import annotations

import re
import tomllib
from collections import Counter
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from forward.findings import Finding
from forward.readable import NONE, duration, number, settings, size, with_unit
from uq import findings as of_results
from workflows.report.blocks import Block, Code, Folded, Heading, Pairs, Table, Text, Tone, first_within, words
from workflows.report.section import Results, section
from workflows.report.words import counted, joined, law, solves, stability

if TYPE_CHECKING:
    from workflows.studies.sampling import Study

NOTES = 1  # that are read at once, unless there is something graver
FIRST = 2  # findings that stand before the answers: errors, and these
LONG = 25  # words of a finding that is read at once
WORDS = 30  # of findings that are read at once
BEFORE = {"best-of-bad", "mesh-unknown", "mesh-not-checked", "mesh-not-estimable"}


@section()
def header(results: Results) -> Iterator[Block]:
    """Which study it is, and how it went."""
    summary = results.summary
    yield Heading(f"Study {summary['study']}", level=1)
    yield Text(str(type(results.study.method).__doc__).partition("\n")[0].replace("`", ""), "lead")
    sets, failed = len(summary.get("data_sets", ())), f"{summary['failed']:,} failed"
    took = counted(solves(summary))
    yield Text(f"{sets} data sets, {failed}; {took}" if sets > 1 else f"{summary['stopped']}; {took}, {failed}")


def _left(results: Results) -> list[Finding]:
    """Return the findings that do not stand before the answers."""
    return [one for one in of_results.findings(results.dataset) if one not in gravest(results)]


@section(when=lambda results: "note" in results.summary or bool(_left(results)))
def findings(results: Results) -> Iterator[Block]:
    """Findings, the most severe first."""
    if "note" in results.summary:
        yield Text(results.summary["note"], "warning")
    grave, notes = ([one for one in _left(results) if (one.severity == "note") == kind] for kind in (False, True))
    read = [told(one) for one in grave or notes[: 0 if gravest(results) else NOTES]]
    at_once = first_within(WORDS, [words(one.text) for one in read])
    yield from read[:at_once]
    for kind, of, first in (("finding", grave, at_once), ("note", notes, 0 if grave else at_once)):
        if rest := of[first:]:
            title = f"{len(rest)} {'more ' * (first > 0)}{kind}{'s' * (len(rest) > 1)}"
            yield Folded(title, [Text(one.text) for one in rest])


def gravest(results: Results) -> list[Finding]:
    """Return the first of what is to be read before any number: that it cannot be trusted, or does not hold all."""
    found = of_results.findings(results.dataset)
    first = [one for one in found if one.severity == "error" or (one.severity == "warning" and one.code in BEFORE)]
    return first[:FIRST]


def told(one: Finding) -> Text:
    """Write a finding; of a long one, what follows the first sentence, or part of one, is folded."""
    tone: Tone = "" if one.severity == "note" else one.severity
    found = re.match(r"(.+?[.;]) (.+)", one.text) if words(one.text) > LONG else None
    return Text(one.text, tone) if found is None else Text(found[1].replace(";", "…"), tone, found[2])


@section("nominal", heading="What was computed")
def model(results: Results) -> Iterator[Block]:
    """The model in words, and its random parameters."""
    yield Pairs(list(model_in_words(results.study)))
    rows = []
    for name, distribution in results.study.given.items():
        both = (results.dataset[f"parameter_{which}"].sel(parameter=name) for which in ("mean", "std"))
        mean, std = (number(float(value)) for value in both)
        rows.append((name, law(distribution.model_dump()), mean, std, results.parameter_unit(name)))
    for field, count in Counter(path.split(".")[1] for path in results.study.model.coefficients).items():
        kept = float(results.dataset["variance_kept"].sel(random_field=field))
        normal = f"independent standard normal; {100 * kept:.3g} % of the variance of the field"
        rows.append((f"fields.{field}.0 to {count - 1}", normal, "0", "1", "1"))
    rows += [
        (" and ".join(c.between), f"joined by a Gaussian copula with correlation {c.value:g}", "", "", "")
        for c in results.study.correlations
    ]
    head = ("random parameter", "distribution", "mean", "standard deviation", "unit")
    yield Table(head, rows, text={0, 1, 4})


def model_in_words(study: Study) -> Iterator[tuple[str, list[str]]]:
    """Say what was solved: headings, each with its lines."""
    scalars = study.model.scalars

    def said(path: str) -> str:
        return "random" if path in study.given else with_unit(number(scalars[path].value, 6), scalars[path].unit)

    return study.spec.words(said, " on the coarsest mesh" if len(study.meshes) > 1 else "")


@section("alone_eigenvalue", heading="Priors")
def priors(results: Results) -> Iterator[Block]:
    """The priors of the unknowns."""
    config, rows = tomllib.loads(results.dataset.attrs["config"]), []
    for path, block in config.get("parameters", {}).items():
        unit = results.parameter_unit(path)
        rows.append((path, law(block), NONE if unit == "1" else unit))
    for block in config["model"].get("fields", ()):
        prior = f"log-normal field: {settings(block, 'of', 'name')}"
        rows.append((f"fields.{block.get('name') or block['of']}", prior, NONE))
    if "noise" in config["method"]:
        rows.append(("factor on all sigma", law(config["method"]["noise"]), NONE))
    yield Table(("unknown", "prior", "unit"), rows, text=range(3))


@section(heading="Failed solves")
def failures(results: Results) -> Iterator[Block]:
    """Which solves failed, and why."""
    failed, found = results.summary["failed"], results.summary["failures"]
    listed = len(found)
    if "stability" in results.summary:
        yield Text(f"{stability(results.summary['stability']).capitalize()}.")
    if "joined" in results.summary:
        said = joined(results.summary["joined"], results.summary["work"])
        yield Text(f"{said[0].upper()}{said[1:]}.")
    if not listed:
        yield Text("None failed.")
        return
    line = f"{failed:,} of {counted(solves(results.summary))} failed."
    yield Text(line if listed == failed else f"{line} These are the first {listed}; evaluations.h5 holds all.")
    every = dict.fromkeys(name for failure in found for name in failure["parameters"])
    names = [name for name in every if not name.startswith("fields.")]  # coefficients say nothing to a reader
    first, rows = ["model"] if any("model" in failure for failure in found) else [], []
    for failure in found:
        model, at = str(failure.get("model", "/")), failure["parameters"]
        shown = (NONE if name not in at else size(at[name], results.parameter_unit(name, model), 6) for name in names)
        rows.append((*([model] if first else []), *shown, failure["reason"]))
    last = len(first) + len(names)
    yield Table((*first, *names, "reason"), rows, text={last, *range(len(first))}, long={last})


@section(heading="Run time")
def run_time(results: Results) -> Iterator[Block]:
    """What the study took."""
    summary, count = results.summary, max(solves(results.summary), 1)
    cpu, work = summary["cpu_seconds"], summary["work"].items()
    told = {
        "wall time": f"{duration(summary['wall_seconds'])} (of the run that finished the study)",
        "processor time of the solves": f"{duration(cpu)}; {duration(cpu / count)} a solve",
    }
    if "own_seconds" in summary:
        told["processor time of the method itself"] = duration(summary["own_seconds"])
    if any(amount for _, amount in work):  # unknown for inversions in parallel
        told |= {name.replace("_", " "): f"{amount:,}; {amount / count:.1f} a solve" for name, amount in work}
    yield Pairs.of(*told.items())


@section(heading="Provenance")
def provenance(results: Results) -> Iterator[Block]:
    """When, from which study and on which machine the results were made."""
    found = results.summary["provenance"]
    ranks, groups = found["ranks"], found["groups"]
    yield Pairs.of(
        ("date", f"{datetime.fromisoformat(found['date']).astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC"),
        ("commit", found["commit"] or "not from a git checkout"),
        ("seed", NONE if found["seed"] is None else str(found["seed"])),
        ("ranks", f"{ranks} in {groups} group{'s' if groups > 1 else ''}, {found['processor']}"),
        ("versions", ", ".join(f"{name} {version}" for name, version in found["versions"].items())),
    )
    yield Folded("The study, complete with defaults", [Code(results.dataset.attrs["config"])], printed=False)
