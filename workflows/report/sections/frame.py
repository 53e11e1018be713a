"""What every report has: header, findings, model, priors, failures, run time, provenance."""

from __future__ import annotations

import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from typing import Any

from forward.readable import size
from forward.words import NONE, duration, number, settings
from uq.findings import findings
from workflows.report.blocks import Block, Code, Folded, Heading, Pairs, Table, Text
from workflows.report.section import Results, Section
from workflows.report.words import counted, joined, model_in_words, stability


class Header(Section):
    """Which study it is, and how it went."""

    def content(self, results: Results) -> Iterator[Block]:
        """Title, method and number of solves."""
        summary = results.summary
        yield Heading(f"Study {summary['study']}", level=1)
        yield Text(str(type(results.study.method).__doc__).partition("\n")[0].replace("`", ""), "lead")
        sets, failed = len(summary.get("data_sets", ())), f"{summary['failed']:,} failed"
        if sets > 1:
            yield Text(f"{sets} data sets, {failed}; {counted(results.solves)}")
        else:
            yield Text(f"{summary['stopped']}; {counted(results.solves)}, {failed}")


NOTES = 2  # that are read at once
FIRST = 2  # errors that stand before the answers


class Findings(Section):
    """Findings, the most severe first."""

    def applies(self, results: Results) -> bool:
        """Whether there are some that the answer does not begin with."""
        return "note" in results.summary or len(findings(results.dataset)) > len(gravest(results))

    def content(self, results: Results) -> Iterator[Block]:
        """A paragraph for each; many notes are folded."""
        if "note" in results.summary:
            yield Text(results.summary["note"], "warning")
        found = findings(results.dataset)
        said = gravest(results)
        for one in found:
            if one.severity != "note" and one.text not in said:
                yield Text(one.text, one.severity)
        notes = [Text(one.text) for one in found if one.severity == "note"]
        yield from notes[:NOTES]
        if len(notes) > NOTES:
            more = len(notes) - NOTES
            yield Folded(f"{more} more note{'s' * (more > 1)}", notes[NOTES:])


def gravest(results: Results) -> list[str]:
    """Return the first of what makes numbers not to be trusted, which is to be read before them."""
    return [one.text for one in findings(results.dataset) if one.severity == "error"][:FIRST]


class Model(Section):
    """The model in words, and its random parameters."""

    needs = ("nominal",)

    def content(self, results: Results) -> Iterator[Block]:
        """The model block by block, and a table of distributions."""
        yield Heading("What was computed")
        yield Pairs(list(model_in_words(results.study)))
        yield parameters(results)


def parameters(results: Results) -> Table:
    """The random parameters and their distributions."""
    rows = []
    for name, distribution in results.study.given.items():
        block = distribution.model_dump()
        of_parameter = results.dataset.sel(parameter=name)
        mean, std = (number(float(of_parameter[f"parameter_{which}"])) for which in ("mean", "std"))
        rows.append((name, f"{block['kind']}: {settings(block, 'kind')}", mean, std, results.parameter_unit(name)))
    for field, count in Counter(path.split(".")[1] for path in results.study.model.coefficients).items():
        kept = float(results.dataset["variance_kept"].sel(random_field=field))
        law = f"independent standard normal; {100 * kept:.3g} % of the variance of the field"
        rows.append((f"fields.{field}.0 to {count - 1}", law, "0", "1", "1"))
    rows += [
        (" and ".join(c.between), f"joined by a Gaussian copula with correlation {c.value:g}", "", "", "")
        for c in results.study.correlations
    ]
    head = ("random parameter", "distribution", "mean", "standard deviation", "unit")
    return Table(head, rows, text=frozenset({0, 1, 4}))


class Priors(Section):
    """The priors of the unknowns."""

    needs = ("alone_eigenvalue",)

    def content(self, results: Results) -> Iterator[Block]:
        """One table."""
        yield Heading("Priors")
        yield priors(results)


def priors(results: Results) -> Table:
    """The priors of the unknowns."""
    config = tomllib.loads(results.dataset.attrs["config"])
    rows = [
        (path, f"{block['kind']}: {settings(block, 'kind')}", results.parameter_unit(path))
        for path, block in config.get("parameters", {}).items()
    ]
    rows += [
        (f"fields.{block.get('name') or block['of']}", f"log-normal field: {settings(block, 'of', 'name')}", "1")
        for block in config["model"].get("fields", ())
    ]
    noise = config["method"].get("noise")
    if noise is not None:
        rows.append(("factor on all sigma", f"{noise['kind']}: {settings(noise, 'kind')}", "1"))
    rows = [(unknown, prior, NONE if unit == "1" else unit) for unknown, prior, unit in rows]
    return Table(("unknown", "prior", "unit"), rows, text=frozenset(range(3)))


class Failures(Section):
    """Which solves failed, and why."""

    def content(self, results: Results) -> Iterator[Block]:
        """How many failed, at which parameters, and why."""
        failed, listed = results.summary["failed"], len(results.summary["failures"])
        yield Heading("Failed solves")
        if "stability" in results.summary:
            yield Text(f"{stability(results.summary['stability']).capitalize()}.")
        if "joined" in results.summary:
            said = joined(results.summary["joined"], results.summary["work"])
            yield Text(f"{said[0].upper()}{said[1:]}.")
        if not listed:
            yield Text("None failed.")
            return
        line = f"{failed:,} of {counted(results.solves)} failed."
        yield Text(line if listed == failed else f"{line} These are the first {listed}; evaluations.h5 holds all.")
        yield failures(results)


def failures(results: Results) -> Table:
    """The solves that failed: the model if there are several, parameters and reason.

    The coefficients of random fields are omitted.
    """
    found = results.summary["failures"]
    every = dict.fromkeys(name for failure in found for name in failure["parameters"])
    names = [name for name in every if not name.startswith("fields.")]
    models = any("model" in failure for failure in found)

    def row(failure: Mapping[str, Any]) -> tuple[str, ...]:
        model, at = str(failure.get("model", "/")), failure["parameters"]
        shown = (NONE if name not in at else size(at[name], results.parameter_unit(name, model), 6) for name in names)
        return (*([model] if models else []), *shown, failure["reason"])

    head = (*(["model"] if models else []), *names, "reason")
    last = len(head) - 1
    return Table(
        head,
        [row(failure) for failure in found],
        text=frozenset({last, *([0] if models else [])}),
        long=frozenset({last}),
    )


class RunTime(Section):
    """What the study took."""

    def content(self, results: Results) -> Iterator[Block]:
        """Times and work."""
        yield Heading("Run time")
        yield Pairs([(word, [text]) for word, text in times(results)])


def times(results: Results) -> Iterator[tuple[str, str]]:
    """What the study took."""
    summary, count = results.summary, max(results.solves, 1)
    yield "wall time", f"{duration(summary['wall_seconds'])} (of the run that finished the study)"
    cpu = summary["cpu_seconds"]
    yield "processor time of the solves", f"{duration(cpu)}; {duration(cpu / count)} a solve"
    if "own_seconds" in summary:
        yield "processor time of the method itself", duration(summary["own_seconds"])
    if any(summary["work"].values()):  # unknown for inversions in parallel
        for name, amount in summary["work"].items():
            yield name.replace("_", " "), f"{amount:,}; {amount / count:.1f} a solve"


class Provenance(Section):
    """When, from which study and on which machine the results were made."""

    def content(self, results: Results) -> Iterator[Block]:
        """Pairs, and the whole study."""
        yield Heading("Provenance")
        yield Pairs([(word, [text]) for word, text in provenance(results)])
        yield Folded("The study, complete with defaults", [Code(results.dataset.attrs["config"])], printed=False)


def provenance(results: Results) -> Iterator[tuple[str, str]]:
    """When, from which study and on which machine the results were made."""
    found = results.summary["provenance"]
    date = datetime.fromisoformat(found["date"]).astimezone(UTC)
    yield "date", f"{date:%Y-%m-%d %H:%M:%S} UTC"
    yield "commit", found["commit"] or "not from a git checkout"
    yield "seed", NONE if found["seed"] is None else str(found["seed"])
    ranks, groups = found["ranks"], found["groups"]
    yield "ranks", f"{ranks} in {groups} group{'s' if groups > 1 else ''}, {found['processor']}"
    yield "versions", ", ".join(f"{name} {version}" for name, version in found["versions"].items())
