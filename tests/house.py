"""Count what says how large and how clear the code is: `make house`.

Every count says how it is made. Python files are those under git in the four packages; lines of code are those that
hold a token other than a comment or a docstring.
"""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

ROOT = Path(__file__).parent.parent
PACKAGES = ("forward", "uq", "inverse", "workflows")
LONG = 450  # lines of a file that can be read as a whole
# What stood between a table of data and a posterior: a name that is gone counts no more, and whoever adds one adds it
# here.
CONTAINERS = ("Table", "Readings", "Scan", "Observations", "Placed", "Measurement", "Measurements", "Components")


@dataclass(frozen=True)
class File:
    """A module: its path from the root, and its text."""

    path: str
    text: str

    @cached_property
    def tree(self) -> ast.Module:
        """Its syntax tree."""
        return ast.parse(self.text)

    @cached_property
    def lines(self) -> int:
        """Number of lines."""
        return self.text.count("\n")

    @cached_property
    def code(self) -> int:
        """Number of lines with a token that is neither a comment nor part of a docstring."""
        silent = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
        found: set[int] = set()
        for token in tokenize.generate_tokens(io.StringIO(self.text).readline):
            if token.type not in silent:
                found.update(range(token.start[0], token.end[0] + 1))
        for node in ast.walk(self.tree):
            if (
                isinstance(node, ast.Expr)
                and isinstance(node.value, ast.Constant)
                and isinstance(node.value.value, str)
            ):
                found -= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
        return len(found)

    def classes(self) -> Iterator[ast.ClassDef]:
        """Iterate over its classes: they stand among statements, of which there are few beside what is in these."""
        waiting: list[ast.AST] = [self.tree] if "class " in self.text else []
        while waiting:
            node = waiting.pop()
            if isinstance(node, ast.ClassDef):
                yield node
            inside = (
                one for name in ("body", "orelse", "finalbody", "handlers", "cases") for one in getattr(node, name, ())
            )
            waiting += inside

    def texts(self) -> Iterator[str]:
        """Iterate over its texts, and the constant parts of those with fields; not over docstrings."""
        said = {id(node.value) for node in ast.walk(self.tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in said:
                yield node.value

    def calls(self, name: str) -> int:
        """Number of calls of a function by this name."""
        return sum(
            isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == name
            for node in ast.walk(self.tree)
        )


def main() -> int:
    """Print the table."""
    rows = list(table(files()))
    width = max(len(name) for name, *_ in rows)
    sys.stdout.write(f"{'count':{width}}  {'today':>17}  {'goal':>17}  how it is made\n")
    for name, today, goal, how in rows:
        sys.stdout.write(f"{name:{width}}  {today:>17}  {goal:>17}  {how}\n")
    return 0


def table(files: list[File]) -> Iterator[tuple[str, str, str, str]]:
    """Yield what is counted, the count, its goal, and how it is made."""
    from tests.circles import circles, imports  # by what only the first lane has: files are counted in the second too

    lines, code = sum(file.lines for file in files), sum(file.code for file in files)
    yield "lines / of code", f"{lines:,} / {code:,}", "64,000 / 41,000", "Python files under git in the four packages"
    long = [file for file in files if file.lines > LONG]
    yield f"files over {LONG} lines", f"{len(long)}", "0", ", ".join(Path(file.path).stem for file in long)
    flows = [file for file in files if file.path.startswith("workflows/")]
    studies = [file for file in flows if file.path.startswith("workflows/studies/")]
    of_both = (sum(file.lines for file in some) for some in (flows, studies))
    yield "workflows / studies", " / ".join(f"{n:,}" for n in of_both), "15,500 / 5,500", "lines"
    yield "measures_outputs", f"{_places(files, 'measures_outputs')}", "0", "lines with this name"
    said = [file for file in files if file.path == "uq/findings.py"]
    patterns = sum(len(re.findall(r"\bre\.\w+\(", file.text)) for file in said)
    yield "regular expressions over findings", f"{patterns}", "0", "calls of re in uq/findings.py"
    yield "object.__setattr__", f"{_places(files, 'object.__setattr__')}", "0", "lines with it"
    chains = [file.path for file in files for _ in range(file.calls("assess"))]
    yield "chains to a posterior", f"{len(chains)}", "1", "calls of `assess`, after mode and mesh: " + ", ".join(chains)
    boxes = sorted({node.name for file in files for node in file.classes()} & set(CONTAINERS))
    yield "containers from a file to a posterior", f"{len(boxes)}", "3", "classes that still stand: " + ", ".join(boxes)
    kinds = _subclasses(files, "StudyKind")
    yield "classes of study", f"{len(kinds)}", "9", "StudyKind and what descends from it: " + ", ".join(sorted(kinds))
    solutions = sorted({node.name for file in files for node in file.classes() if _solution(node)})
    yield "classes of solutions", f"{len(solutions)}", "4", ", ".join(solutions)
    wrapping = {name for root in ("OfOne", "Joined") for name in _subclasses(files, root)}
    wrappers = [file.path for file in files if wrapping & {node.name for node in file.classes()}]
    how = "with OfOne, Joined, or what descends from them: " + ", ".join(wrappers)
    yield "files of models that wrap models", f"{len(wrappers)}", "3", how
    groups = circles(imports(ROOT))
    sizes = f"{len(groups)} of {sum(map(len, groups))}"
    yield "circles, of modules", sizes, "0", "groups that import each other, by texts too (tests/circles.py)"
    for name, goal in (("cast", 8), ("isinstance", 130), ("getattr", 60)):
        yield f"{name}(", f"{sum(file.calls(name) for file in files)}", f"{goal}", "calls"
    yield "# type: ignore", f"{_places(files, '# type: ignore')}", "20", "lines with it"
    above = [file for file in files if not file.path.startswith("forward/")]
    places = [sum("_mesh_error" in text for text in file.texts()) for file in above]
    found = f"{sum(places)} / {sum(map(bool, places))}"
    yield "texts with _mesh_error / files", found, "1 file", "texts (no docstrings) in uq, inverse and workflows"
    rest = f"{(lines - code) / code:.2f}"
    yield "other lines for each of code", rest, "≥ 0.54", "docstrings, comments and blank lines"


def files() -> list[File]:
    """Read the modules of the four packages."""
    command = ["git", "-C", ROOT, "ls-files", *(f"{package}/**.py" for package in PACKAGES)]
    paths = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    return [File(path, (ROOT / path).read_text(encoding="utf-8")) for path in paths]


def _places(files: list[File], text: str) -> int:
    return sum(text in line for file in files for line in file.text.splitlines())


def _solution(node: ast.ClassDef) -> bool:
    """Whether a class is named as a solution and has the two products with derivatives."""
    methods = {item.name for item in node.body if isinstance(item, ast.FunctionDef)}
    return node.name.endswith("Solution") and {"tangent", "adjoint"} <= methods and node.name != "Solution"


def _subclasses(files: list[File], name: str) -> set[str]:
    """Names of a class and of all that descend from it."""
    bases = {
        node.name: {base.id for base in node.bases if isinstance(base, ast.Name)}
        for file in files
        for node in file.classes()
    }
    found = {name}
    while True:
        more = {one for one, of in bases.items() if of & found} - found
        if not more:
            return found
        found |= more


if __name__ == "__main__":
    sys.exit(main())
