"""What README and docs name is there, parses and runs."""

import ast
import importlib.util
import re
import shlex
import sys
import tomllib
from contextlib import nullcontext
from pathlib import Path

import pytest

from benchmarks.__main__ import NAMES
from forward.materials.material import MATERIALS
from forward.observables.observable import OUTPUTS
from forward.spec import MODELS
from forward.terms.term import LOADS
from uq.methods.method import METHODS
from workflows.__main__ import _parser
from workflows.config.mistakes import StudyError
from workflows.config.study import load, parse
from workflows.run.run import run
from workflows.starter import starter
from workflows.studies.study import STUDIES, UNNAMED

ROOT = Path(__file__).parent.parent.parent
ON_SITE = sorted((ROOT / "docs").rglob("*.md"))
PAGES = [*(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CODE_OF_CONDUCT.md", "SECURITY.md")), *ON_SITE]
FENCE = re.compile(r"(?P<runs><!-- runs -->\n)?^```(?P<language>\w*)\n(?P<code>.*?)^```$", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"(?:^    .*\n)+", re.MULTILINE)
PLACE = re.compile(
    r"(?<![\w/])((?:benchmarks|configs|docs|notebooks|packaging|tests|forward|inverse|uq|workflows)/[\w./-]+\.\w+)"
)
COMMAND = re.compile(r"(?<![\w./-])(?:\.venv/bin/)?tissuq (?:check|run|report|serve|init|schema)\b[^\n`]*")


def each(find):
    """Every find(text) of every page, with the page."""
    return [(page, found) for page in PAGES for found in find(page.read_text(encoding="utf-8"))]


def fences(language, runs=None):
    return each(
        lambda text: [
            found["code"]
            for found in FENCE.finditer(text)
            if found["language"] == language and (runs is None or bool(found["runs"]) == runs)
        ]
    )


def commands(text):
    """Commands of tissuq in blocks of code and in the text, without what a shell takes away."""
    found = {re.sub(r"\\\n\s*", "", line) for line in COMMAND.findall(re.sub(r"\\\n\s*", "", text))}
    return sorted(line.strip().removeprefix(".venv/bin/") for line in found)


def words(command):
    """The arguments, as a shell hands them over; variables become a number."""
    command = re.sub(r"`.*|\)$|; done$|&$|> \S+$", "", command.strip())
    command = re.sub(r"\$\w+", "0.1", command).strip(" .,;")
    return shlex.split(command, comments=True)[1:]


def test_all_pages_are_looked_at():
    assert len(PAGES) > 20
    assert len(each(commands)) > 25
    assert len(fences("toml")) >= 4
    assert len(fences("python", runs=True)) >= 2


@pytest.mark.parametrize(
    ("page", "command"), each(commands), ids=lambda given: given.stem if isinstance(given, Path) else given[:60]
)
def test_commands_parse(page, command):
    arguments = words(command)
    if arguments in (["report"], ["run"], ["serve"], ["check"], ["init"]):  # the name of a command, in a sentence
        return
    options = _parser().parse_args(arguments)
    study = getattr(options, "study", None)
    if study is not None and study.parts[0] == "configs":
        taken = re.findall(r'"(results/[\w-]+)"', (ROOT / study).read_text())
        missing = any(not (ROOT / place).exists() for place in taken)
        with pytest.raises(StudyError, match=r"^\S+ \S*results/brain\S* is not there") if missing else nullcontext():
            load(ROOT / study, options.set)  # what the command before it leaves may not be there
    if getattr(options, "kind", "list") not in {"list"}:
        assert starter(options.kind)


@pytest.mark.parametrize(
    ("page", "place"),
    each(lambda text: sorted(set(PLACE.findall(text)))),
    ids=lambda given: given.stem if isinstance(given, Path) else given,
)
def test_files_are_there(page, place):
    if Path(place).stem in {"NAME", "THEME", "x"} or place.endswith(".ipynb"):  # any, and what is made
        return
    assert (ROOT / place).exists()


def test_the_design_names_modules_that_there_are():
    page = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
    table = page.partition("## Where things are")[2].partition("\n## ")[0]
    for folders, told in re.findall(r"^\| (`[^|]*`) \| (.*) \|$", table, re.MULTILINE):
        inside = [ROOT / folder for folder in re.findall(r"`([\w/]+/)`", folders)]
        inside += [folder / part for folder in inside for part in re.findall(r"`(\w+/)`", told)]
        for name in re.findall(r"`(\w+)`", told):
            assert any((folder / f"{name}.py").exists() for folder in inside), (folders, name)
    assert len(page.splitlines()) <= 250


def test_every_kind_and_every_study_of_the_net_stands_among_the_abilities():
    page = (ROOT / "docs" / "abilities.md").read_text(encoding="utf-8")
    studies = [path.relative_to(ROOT).as_posix() for path in (ROOT / "benchmarks" / "net").glob("*.toml")]
    kinds = [kind for family in (MATERIALS, LOADS, OUTPUTS, MODELS, METHODS, STUDIES) for kind in family.own]
    missing = [name for name in (*kinds, *studies) if f"`{name}`" not in page and name not in UNNAMED]
    assert missing == []
    without = re.findall(r"^\| (?!what|--)[^|]*\| (?!`)[^|]*\|$", page, re.MULTILINE)
    assert without == [], "each line names what runs it"


def test_targets_and_benchmarks_are_there():
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    known = set(NAMES)
    for page, name in each(lambda text: re.findall(r"(?:`|    )make ([a-z-]+)", text)):
        assert name in targets, (page, name)
    for page, name in each(lambda text: re.findall(r"python -m benchmarks (\w+)", text)):
        assert name in known, (page, name)


def whole(text, folder):
    """Return the blocks of a study that a page shows; candidates alone stand in for those of a shipped study."""
    blocks = tomllib.loads(text)
    (folder / "data").symlink_to(ROOT / "configs" / "data")
    if "method" in blocks or "accuracy" in blocks:
        return blocks
    return tomllib.loads((ROOT / "configs" / "inclusion-material.toml").read_text(encoding="utf-8")) | blocks


def run_page(page, folder, monkeypatch):
    """Run what a page says that it runs, in a folder, and leave functions there as it says."""
    monkeypatch.chdir(folder)
    for code in (code for at, code in fences("python", runs=True) if at == page):
        if "import gmsh" in code:
            pytest.importorskip("gmsh")
        exec(compile(code, str(page), "exec"), {})
        if "def beam" in code:
            (folder / "cantilever.py").write_text(code, encoding="utf-8")
    for name, code in (
        re.match(r"# (\w+\.py)\n(.*)", code, re.DOTALL).groups() for at, code in named_files() if at == page
    ):
        (folder / name).write_text(code, encoding="utf-8")


def named_files():
    """The Python files of pages that begin with their names."""
    return [(at, code) for at, code in fences("python", runs=False) if re.match(r"# \w+\.py\n", code)]


@pytest.mark.parametrize(("page", "text"), fences("toml"), ids=lambda given: getattr(given, "stem", ""))
def test_study_files_parse(page, text, tmp_path, monkeypatch):
    if 'kind = "mesh"' in text or page in {at for at, _ in named_files()}:
        run_page(page, tmp_path, monkeypatch)
    parse(whole(text, tmp_path), folder=tmp_path)


@pytest.mark.fem
@pytest.mark.slow
@pytest.mark.parametrize(("page", "text"), fences("toml"), ids=lambda given: getattr(given, "stem", ""))
def test_study_files_run(page, text, tmp_path, monkeypatch):
    run_page(page, tmp_path, monkeypatch)
    monkeypatch.setattr("sys.path", [str(tmp_path), *sys.path])
    monkeypatch.setattr("workflows.run.run._report", lambda directory: None)
    assert run(parse(whole(text, tmp_path), folder=tmp_path), "study", tmp_path / "results", quiet=True) == 0


READING = [
    *[(page, code) for page, code in fences("python", runs=False) if "localhost" not in code],  # which needs a server
    *each(
        lambda text: [
            re.sub(r"^    ", "", found, flags=re.MULTILINE)
            for found in INDENTED.findall(FENCE.sub("", text))
            if re.match(r"\s+(import|from) ", found) and "umbridge" not in found  # which needs a server, and has tests
        ]
    ),
]


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Directories by the names that pages give them: the coarse beam by the methods they have."""
    folder = tmp_path_factory.mktemp("pages")
    methods = {
        "tiny": "{kind='sensitivity-monte-carlo', samples=8}",
        "beam-chaos": "{kind='chaos', samples=8}",
        "beam-sobol": "{kind='sobol', design='chaos', samples=8}",
        "to-tolerance": "{kind='quasi-monte-carlo', samples=32}",
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("workflows.run.run._report", lambda directory: None)
        for name, method in methods.items():
            study = load(ROOT / "configs" / "tiny.toml", [f"method={method}"])
            assert run(study, name, folder / "results" / name, quiet=True) == 0
        changes = (
            "method={kind='chaos', samples=8}",
            "model.outputs=[{name='sink', kind='max-displacement', component='y'}]",
            "parameters={'material.C1'={kind='uniform', lower=9e3, upper=11e3}}",
        )
        study = load(ROOT / "configs" / "tiny.toml", changes)
        assert run(study, "sample", folder / "results" / "sample", quiet=True) == 0
    (folder / "configs").symlink_to(ROOT / "configs")
    for name in ("beam", "length-0.1"):
        (folder / "results" / name).symlink_to("tiny")
    return folder


@pytest.mark.fem
@pytest.mark.slow
@pytest.mark.parametrize(("page", "code"), READING, ids=lambda given: getattr(given, "stem", ""))
def test_python_that_reads_results_runs(page, code, results, monkeypatch):
    import pyvista

    monkeypatch.chdir(results)
    monkeypatch.setattr(pyvista, "OFF_SCREEN", True)
    exec(compile(code, str(page), "exec"), {"points": [[750.0, 3e5]]})


def test_python_compiles():
    fenced = [code for _, code in fences("python")]
    indented = [
        re.sub(r"^    ", "", found, flags=re.MULTILINE)
        for _, found in each(lambda text: INDENTED.findall(FENCE.sub("", text)))
        if re.match(r"\s+(import|from) ", found)
    ]
    assert len(indented) >= 3
    for code in [*fenced, *indented]:
        ast.parse(code)


@pytest.mark.parametrize(("page", "code"), fences("python", runs=True), ids=lambda given: getattr(given, "stem", ""))
def test_complete_python_runs(page, code, capsys, tmp_path, monkeypatch, undrawn):
    if "import gmsh" in code:
        pytest.importorskip("gmsh")
    monkeypatch.chdir(tmp_path)
    exec(compile(code, str(page), "exec"), {})


def test_names_that_python_snippets_import_are_there():
    for page, code in fences("python"):
        for node in ast.walk(ast.parse(code)):
            if not isinstance(node, ast.ImportFrom) or str(node.module).split(".")[0] not in {
                "forward", "inverse", "uq", "workflows",
            }:  # fmt: skip
                continue
            module = importlib.import_module(str(node.module))
            for name in node.names:
                there = hasattr(module, name.name) or importlib.util.find_spec(f"{node.module}.{name.name}")
                assert there, (page, name.name)


def test_pictures_that_the_docs_name_are_functions():
    for page, (module, name) in each(
        lambda text: re.findall(r"`(plots|plots\.inversion|plots\.selection|bodies)\.(\w+)`", text)
    ):
        assert callable(getattr(importlib.import_module(f"workflows.report.{module}"), name, None)), (page, name)


@pytest.fixture(scope="module")
def reference():
    spec = importlib.util.spec_from_file_location("reference", ROOT / "docs" / "reference.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def pages(reference):
    """Pages that are made of the code, by name."""
    return dict(reference.pages())


def test_generated_pages_tell_what_is_there(pages):
    assert "| `max_order` | whole number ≥ 1 ≤ 20 | none | Largest order" in pages["reference/settings.md"]
    assert "usage: tissuq run" in pages["reference/commands.md"]
    assert "## treloar" in pages["studies.md"]
    assert "studies.md#beam)" in pages["overview.md"]
    assert "](docs/" not in pages["overview.md"]
    moments = pages["reference/uq.estimators.moments.md"]
    assert "## combine" in moments
    assert "ω<sub>i</sub>" in moments


def test_quotations_are_found(reference):
    for page in ON_SITE:
        text = reference.quoted(page.read_text(encoding="utf-8"))
        assert not re.search(r"^\{\{", text, re.MULTILINE), page
    text = reference.written(
        "Do.\n\nParameters\n----------\nx, y\n    Some *number*\n    below 1.\n\nMore_than <one> z_i."
    )
    assert "- `x, y`: Some \\*number\\* below 1." in text


def test_pages_are_in_the_menu_or_linked(pages):
    named = set(re.findall(r"[\w/.-]+\.md", (ROOT / "mkdocs.yml").read_text()))
    written = {str(page.relative_to(ROOT / "docs")) for page in ON_SITE}
    linked = set(re.findall(r"\]\((?:\.\./)?([\w/.-]+\.md)", "".join([*pages.values(), *map(Path.read_text, PAGES)])))
    assert named <= set(pages) | written
    assert written <= named | linked
