"""The page that explains findings has an entry for every function that makes one, with words that the function says."""

import ast
import re
from functools import cache

from tests.launch import ROOT

PAGE = (ROOT / "docs" / "trust.md").read_text()
PASSED_ON = {"uq.findings:_kept"}  # reads what others have found
SAID_BY = re.compile(r"^\*Said by\* (.*?)$\n(?:\n|\Z)", re.M | re.S)


def text_of(node):
    """A string of the source as words, with an ellipsis for what is put in; None for anything else."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else "…" for part in node.values)
    return None


@cache
def finders():
    """Every function that makes a finding or a doubt, by its place: what it says, in words."""
    found = {}
    for package in ("forward", "uq", "inverse", "workflows"):
        for path in (ROOT / package).rglob("*.py"):
            module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            source = path.read_text()
            for node in ast.walk(ast.parse(source)) if re.search(r"\b(Finding|Doubt)\(", source) else ():
                if isinstance(node, ast.FunctionDef):
                    calls = (one.func for one in ast.walk(node) if isinstance(one, ast.Call))
                    if any(isinstance(name, ast.Name) and name.id in {"Finding", "Doubt"} for name in calls):
                        said = (text_of(part) for part in ast.walk(ast.parse(source)))
                        found[f"{module}:{node.name}"] = " ".join(" ".join(text.split()) for text in said if text)
    return found


def entries():
    """The entries of the page: heading, words that are quoted, and functions."""
    for section in re.split(r"^##+ ", PAGE, flags=re.M)[1:]:
        said = SAID_BY.search(section + "\n\n")
        quoted = re.findall(r"^> (.+)$", section, re.M)
        yield section.partition("\n")[0], quoted, re.findall(r"`([\w.]+:\w+)`", said[1]) if said else []


def test_every_finding_has_its_entry():
    explained = [place for _, _, places in entries() for place in places]
    assert len(explained) == len(set(explained))
    assert set(explained) == set(finders()) - PASSED_ON


def test_entries_quote_what_is_said():
    of = finders()
    for heading, quoted, places in entries():
        assert not quoted or places, heading
        words = " ".join(of[place] for place in places)
        for line in quoted:
            for part in line.split("…"):
                wanted = part.strip(" .,:'()%")
                assert wanted in words, f"{heading}: {wanted}"


def test_every_entry_says_what_it_means():
    for heading, quoted, places in entries():
        section = PAGE.partition(f" {heading}\n")[2].partition("\n##")[0]
        prose = [line for line in section.splitlines() if line and not line.startswith((">", "*Said by*", "`"))]
        assert not places or prose, heading
        assert not quoted or len(" ".join(prose)) > 60, heading
