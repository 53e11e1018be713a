"""The report of a study, and several studies side by side: one HTML file each, with its pictures inside."""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from pydantic import ValidationError

from forward.external.own_modules import OwnCodeError, installed_only, refused
from forward.machine import write_text
from forward.readable import NONE, duration, size
from forward.settings import one_line
from workflows.config.blocks import Report, located
from workflows.config.mistakes import StudyError, lines
from workflows.config.study import parse
from workflows.report import plots
from workflows.report.blocks import Block, Heading, Pictures, Table, Text
from workflows.report.section import SECTIONS, Results, Section, sections
from workflows.results.directory import NoResultsError, read_dataset, read_summary
from workflows.results.summary import summarise
from workflows.run import own_code

if TYPE_CHECKING:
    import jinja2
    import xarray as xr

HERE = Path(__file__).parent
TOP = ("answer", "findings", "body", "curves")  # sections of the first screen
Parts = list[tuple[str, list[Block]]]  # sections by their names


def write_report(directory: Path, *, code: bool = False) -> Path:
    """Write report.html beside the results of a study.

    `code` runs the code that the study names besides what is installed. Without it, what needs such code is left out,
    and the report and a line on the standard error say so.

    Raises
    ------
    FileNotFoundError
        If the directory holds no results.
    StudyError
        If a section that the study asks for does not exist.
    """
    path = directory / "report.html"
    with _running(code) as refusals:
        results, asked = _read(directory, refusals), _asked(directory)
        parts, left_out = parts_of(results, sections(asked))
        left_out += [] if asked is None else [name for name in asked.sections if refused(name.rpartition(".")[0])]
    if left_out:
        asked_for = f" ({', '.join(dict.fromkeys(refusals))})" if refusals else ""
        said = f"left out, since they need code that is not installed{asked_for}: {', '.join(left_out)}; --code runs it"
        parts.append(("left-out", [Heading("Sections that were left out"), Text(said, "warning")]))
        sys.stderr.write(f"{one_line(f'{directory}: {said}')}\n")
    write_text(path, render(f"Study {results.summary['study']}", parts))
    return path


def parts_of(results: Results, asked: Iterable[tuple[str, Section]]) -> tuple[Parts, list[str]]:
    """Return the sections that apply to results, and the names of those that need code that may not run."""
    parts: Parts = []
    left_out: list[str] = []
    for name, section in asked:
        try:
            found = list(section.content(results)) if section.applies(results) else None
        except OwnCodeError:
            left_out.append(name)
            continue
        except Exception as error:  # the rest of the report survives a failing one from outside
            if name in SECTIONS.own:
                raise
            said = f"This section could not be made: {type(error).__name__}: {error}"
            found = [Heading(name), Text(said, "error")]
        parts += [] if found is None else [(name, found)]
    return parts, left_out


def _running(code: bool) -> AbstractContextManager[list[str]]:
    """Let code of studies run, or not; what is returned lists modules that were refused."""
    return nullcontext([]) if code else installed_only()


class _Withheld:
    """Stands for a study that cannot be read without running its own code."""

    def __getattr__(self, name: str) -> NoReturn:
        raise OwnCodeError(f"'{name}' of the study is not known without its own code")


def compare(directories: Sequence[Path], out: Path, *, code: bool = False) -> Path:
    """Write the estimates of several studies side by side to the file `out`; `code` as for `write_report`.

    Raises
    ------
    FileNotFoundError
        If one of the directories holds no results.
    StudyError
        If one has no estimates of outputs, or the file cannot be written.
    """
    studies = {}
    for name, directory in zip(_names(directories), directories, strict=True):
        with _running(code) as refusals:
            studies[name] = _read(directory, refusals)
        if "nominal" not in studies[name].dataset:
            raise StudyError(f"{directory}: holds no estimates of outputs, expected studies that do, for a comparison")
    title = f"Comparison of {len(studies)} studies"
    page = render(title, [("comparison", [Heading(title, 1), *side_by_side(studies)])])
    try:
        write_text(out, page)
    except OSError as error:
        raise StudyError(f"--out {out}: cannot be written: {error.strerror}") from None
    return out


def _asked(directory: Path) -> Report | None:
    """Return the block of the report in study.toml."""
    try:
        blocks = tomllib.loads((directory / "study.toml").read_text(encoding="utf-8"))
        block = located(blocks.get("report"), directory)
        return None if block is None else Report.model_validate(block)
    except FileNotFoundError:
        return None
    except tomllib.TOMLDecodeError as error:
        raise StudyError(f"{directory / 'study.toml'}: not valid TOML: {error}") from None
    except ValidationError as error:
        raise StudyError(*lines(error, "report")) from None


def _read(directory: Path, refusals: list[str]) -> Results:
    """Read results with their study, unless code that is refused is needed for that."""
    dataset = read_dataset(directory)
    summary = read_summary(directory)
    if summary is None:
        raise NoResultsError(f"{directory}: holds no summary.json, expected the directory of a finished study")
    own_code.make_visible(directory)
    return Results(dataset, summary, _study_of(dataset, directory, refusals), directory)


def results_in(dataset: xr.Dataset) -> Results:
    """Return what a report is of: results that were read, or made in this process, whose code alone runs.

    Raises
    ------
    StudyError
        If they are not whole, or not of this version.
    """
    if "config" not in dataset.attrs:
        raise StudyError("these are no whole results, expected what tissuq.read or study.run has returned")
    file, ran = dataset.encoding.get("source"), dataset.encoding.get("ran", False)
    directory = Path(file).parent if file else Path()
    summary = (read_summary(directory) if file else None) or {**dataset.attrs, **summarise(dataset)}
    with _running(ran) as refusals:
        return Results(dataset, summary, _study_of(dataset, directory, refusals), directory)


def _study_of(dataset: xr.Dataset, directory: Path, refusals: list[str]) -> Any:
    try:
        return parse(tomllib.loads(dataset.attrs["config"]), folder=directory)
    except StudyError as error:
        if refusals:
            return _Withheld()
        made = dataset.attrs.get("tissuq", "unknown")
        message = f"{directory}: not a study of this version of tissuq, it was made by version {made} ({error.args[0]})"
        raise StudyError(message) from None


def render(title: str, parts: Parts) -> str:
    """Write sections as one page of HTML."""
    import markupsafe

    blocks = [block for _, found in parts for outer in found for block in outer.whole()]
    return _template().render(
        title=title,
        groups=_grouped(parts),
        asset=lambda name: markupsafe.Markup((HERE / "assets" / name).read_text(encoding="utf-8")),
        turning=any(block.macro == "viewer" for block in blocks),
        styles=dict.fromkeys(block.style for block in blocks if block.style),
        scripts=dict.fromkeys(block.script for block in blocks if block.script),
    )


@cache
def _template() -> jinja2.Template:
    """Compile the page, once for all reports."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(HERE),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html.jinja")


def _grouped(parts: Parts) -> list[dict[str, Any]]:
    """Put the sections of the first screen into a group of their own, a body or curves at the side if there are."""
    numbers = [i for i, (name, _) in enumerate(parts) if name in TOP]
    first, last = (numbers[0], numbers[-1] + 1) if numbers else (0, 0)
    two = any(name == "curves" or (name == "body" and block.macro == "viewer") for name, of in parts for block in of)
    groups = ((parts[:first], False), (parts[first:last], True), (parts[last:], False))
    return [{"sections": some, "top": top, "two": two} for some, top in groups if some]


def _names(directories: Sequence[Path]) -> list[str]:
    """Name directories by their last part, or in full if that is not unique."""
    last = [directory.resolve().name for directory in directories]
    names = [name if last.count(name) == 1 else str(d) for name, d in zip(last, directories, strict=True)]
    return names if len(set(names)) == len(names) else [f"{i}: {name}" for i, name in enumerate(names, start=1)]


def side_by_side(studies: Mapping[str, Results]) -> Iterator[Block]:
    """Costs, and then the estimates of each output."""
    rows: list[tuple[str, ...]] = []
    for name, results in studies.items():
        told = results.summary
        counts, times = (f"{told[key]:,}" for key in ("evaluations", "failed")), ("cpu_seconds", "wall_seconds")
        rows.append((name, str(told["method"]), *counts, *(duration(told[key]) for key in times)))
    yield Table(("study", "method", "solves", "failed", "CPU time", "wall time"), rows, text={0, 1})
    yield Text("± is one standard error.")
    for output in dict.fromkeys(output for results in studies.values() for output in results.outputs):
        yield Heading(output)
        rows = []
        for name, results in studies.items():
            shown = [NONE] * 3
            if output in results.outputs:
                shown = [results.estimate(output, n) if n in results.dataset else NONE for n in ("mean", "std")]
                shown.append(size(float(results.of(output)["nominal"]), results.unit(output), 6))
            rows.append((name, *shown))
        yield Table(("study", "mean", "standard deviation", "at the mean parameters"), rows)
        datasets = {n: r.dataset for n, r in studies.items() if output in r.outputs and "mean" in r.dataset}
        if datasets:
            mean = plots.comparison(datasets, output, "mean"), f"Mean of {output}, with 95 % confidence intervals."
            spread = plots.comparison(datasets, output, "std"), f"Standard deviation of {output}, likewise."
            yield Pictures.of(mean, spread)
