"""Find modules that import each other in a circle, also inside functions: `python -m tests.circles`, in `make lint`.

Imports for types alone count too. A specification names what builds it by a text (`forward.registry`), which is no
import: what is below is not tied to what is above.
"""

from __future__ import annotations

import sys

import grimp

PACKAGES = ("forward", "uq", "inverse", "workflows", "tissuq")


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


def main() -> int:
    """Print the circles; 1 if there are any."""
    graph = grimp.build_graph(*PACKAGES)
    found = circles({module: graph.find_modules_directly_imported_by(module) for module in graph.modules})
    for group in found:
        sys.stdout.write(f"a circle of imports: {', '.join(group)}\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
