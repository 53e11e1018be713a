"""The page that explains findings has an entry for every code of the catalogue, and quotes the words that it has."""

import ast
import re
from string import Formatter

import forward
import inverse
import uq
import workflows
from forward.findings import CATALOGUE
from tests.launch import ROOT

PACKAGES = (forward, uq, inverse, workflows)  # each fills the catalogue when it is imported
OWN = {code: words for package in PACKAGES for code, words in CATALOGUE.items() if code in package.catalogue.TABLE}
PAGE = (ROOT / "docs" / "trust.md").read_text()
CODES = re.compile(r"^\*Codes\* (.*?)$\n(?:\n|\Z)", re.M | re.S)


def entries():
    """The entries of the page: heading, words that are quoted, and codes."""
    for section in re.split(r"^##+ ", PAGE, flags=re.M)[1:]:
        codes = CODES.search(section + "\n\n")
        quoted = re.findall(r"^> (.+)$", section, re.M)
        yield section.partition("\n")[0], quoted, re.findall(r"`([\w-]+)`", codes[1]) if codes else []


def places(text):
    """The places for values in a template."""
    return {name for _, name, _, _ in Formatter().parse(text) if name is not None}


def test_every_code_has_one_entry():
    explained = [code for _, _, codes in entries() for code in codes]
    assert len(explained) == len(set(explained))
    assert set(explained) == set(OWN)


def test_entries_quote_what_is_said():
    for heading, quoted, codes in entries():
        assert not quoted or codes, heading
        said = " ".join(re.sub(r"\{\w+(:[^}]*)?\}", "…", OWN[code].text).lower() for code in codes)
        for line in quoted:
            for part in line.split("…"):
                wanted = part.strip(" .,:'()%").lower()
                assert wanted in said, f"{heading}: {wanted}"


def test_every_entry_says_what_it_means():
    for heading, quoted, codes in entries():
        section = PAGE.partition(f" {heading}\n")[2].partition("\n##")[0]
        prose = [line for line in section.splitlines() if line and not line.startswith((">", "*Codes*", "`"))]
        assert not codes or prose, heading
        assert not quoted or len(" ".join(prose)) > 60, heading


def strings(node):
    """The texts that stand in a node of the source."""
    return {one.value for one in ast.walk(node) if isinstance(one, ast.Constant) and isinstance(one.value, str)}


MADE = re.compile(r"\b(?:Finding|_of_output)\(")


def made(function):
    """The findings that a function makes: codes of each, and what is given by keywords, as outputs may be."""
    assigned = {}
    for node in ast.walk(function):
        for name in node.targets if isinstance(node, ast.Assign) else ():
            for one in ast.walk(name):
                assigned.setdefault(getattr(one, "id", None), set()).update(strings(node.value))
    for node in ast.walk(function):
        if isinstance(node, ast.Call) and getattr(node.func, "id", None) in {"Finding", "_of_output"}:
            code = node.args[0]
            codes = assigned.get(code.id, set()) if isinstance(code, ast.Name) else strings(code)
            given = {word.arg for word in node.keywords}
            yield codes & set(OWN), given if node.func.id == "Finding" else given | {"about"}


def test_findings_bring_what_their_words_have_places_for():
    used = set()
    for path in (path for package in PACKAGES for path in (ROOT / package.__name__).rglob("*.py")):
        source = path.read_text()
        rows = source.splitlines()
        for function in ast.walk(ast.parse(source)) if "Finding(" in source else ():
            makes = isinstance(function, ast.FunctionDef) and MADE.search(
                "\n".join(rows[function.lineno - 1 : function.end_lineno])
            )
            for codes, given in made(function) if makes else ():
                known = strings(function) | given
                for code in codes:
                    assert places(OWN[code].text + (OWN[code].short or "")) <= known, (path, code)
                used |= codes
    assert used == set(OWN)
