"""Find modules that import each other in a circle, also inside functions: `python -m tests.circles`, in `make lint`.

Imports for types alone count too, and so does what `forward.registry.named` imports by a text "module:object". Tables
of kinds do not: texts that are values of a dictionary name what may be added from outside as well.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import grimp

ROOT = Path(__file__).parent.parent
PACKAGES = ("forward", "uq", "inverse", "workflows", "tissuq")

KNOWN = Path(__file__).with_suffix(".txt")  # circles that still stand, one in each line


def circles(imports: dict[str, set[str]]) -> list[list[str]]:
    """Return the groups of modules of which each reaches each other (R. Tarjan, SIAM J. Comput. 1 (1972) 146–160)."""
    number: dict[str, int] = {}
    lowest: dict[str, int] = {}
    waiting: list[str] = []
    found: list[list[str]] = []

    def visit(module: str) -> None:
        number[module] = lowest[module] = len(number)
        waiting.append(module)
        for other in sorted(imports[module]):
            if other not in number:
                visit(other)
                lowest[module] = min(lowest[module], lowest[other])
            elif other in waiting:
                lowest[module] = min(lowest[module], number[other])
        if lowest[module] == number[module]:
            at = waiting.index(module)
            group, waiting[at:] = sorted(waiting[at:]), []
            if len(group) > 1:
                found.append(group)

    for module in sorted(imports):
        if module not in number:
            visit(module)
    return found


def by_text(tree: ast.Module) -> Iterator[str]:
    """Yield the modules that a module imports by texts "module:object", apart from values of dictionaries."""
    constants = {
        target.id: node.value.value
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    kinds = {id(value) for node in ast.walk(tree) if isinstance(node, ast.Dict) for value in node.values}
    for node in ast.walk(tree):
        if id(node) in kinds:
            continue
        if isinstance(node, ast.JoinedStr):
            first = node.values[0]
            if isinstance(first, ast.FormattedValue) and isinstance(first.value, ast.Name):
                yield from _module(f"{constants.get(first.value.id)}:")
            elif isinstance(first, ast.Constant):  # f"forward.fem.{model}", of which `model` is one of several texts
                for other in ast.walk(tree):
                    if isinstance(other, ast.Constant) and re.fullmatch(r"\w+:\w+", str(other.value)):
                        yield from _module(f"{first.value}{other.value}")
        elif isinstance(node, ast.Constant):
            yield from _module(node.value)


def _module(text: object) -> Iterator[str]:
    found = re.fullmatch(rf"((?:{'|'.join(PACKAGES)})(?:\.\w+)+):\w*", text) if isinstance(text, str) else None
    if found:
        yield found[1]


def imports(root: Path = ROOT) -> dict[str, set[str]]:
    """Return the modules that each module of the packages imports, by statements and by texts."""
    graph = grimp.build_graph(*PACKAGES)
    found = {module: set(graph.find_modules_directly_imported_by(module)) for module in graph.modules}
    for module, others in found.items():
        path = root.joinpath(*module.split("."))
        path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        others.update(set(by_text(ast.parse(path.read_text(encoding="utf-8")))) & found.keys())
    return found


def main() -> int:
    """Print circles that are not part of known ones, and keep the list of these as short as it can be; 1 if any is new.

    A list that has become shorter is written, and says so.
    """
    known = [set(line.split()) for line in KNOWN.read_text(encoding="utf-8").splitlines()]
    found = circles(imports())
    new = [group for group in found if not any(set(group) <= one for one in known)]
    for group in new:
        sys.stdout.write(f"a circle of imports: {', '.join(group)}\n")
    text = "".join(f"{' '.join(group)}\n" for group in sorted(found))
    if not new and text != KNOWN.read_text(encoding="utf-8"):
        KNOWN.write_text(text, encoding="utf-8")
        sys.stdout.write(f"circles are fewer or smaller than {KNOWN.name} said, which is written anew: commit it\n")
    return int(bool(new))


if __name__ == "__main__":
    sys.exit(main())
