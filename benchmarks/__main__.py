"""Run benchmarks: python -m benchmarks [NAME ...] (default: all). Ratios are measured side by side in one run.

What begins with a dash is for benchmarks that take options: python -m benchmarks tails --repeats 40; with --help they
say which.
"""

from __future__ import annotations

import inspect
import sys
from importlib import import_module

NAMES = (
    "realisation",
    "reduced",
    "reduced_bodies",
    "live",
    "turning",
    "bookkeeping",
    "kernels",
    "throughput",
    "tolerance",
    "promises",
    "claims",
    "variance",
    "levels",
    "fields",
    "inversion",
    "calibration",
    "selection",
    "specimens",
    "population",
    "designs",
    "intervals",
    "posteriors",
    "streaming",
    "tails",
    "stability",
    "states",
    "locking",
    "mesh_error",
    "estimates",
    "predictions",
    "buckling",
    "chaos",
    "size",
    "precision",
    "saddle",
    "sizes",
    "skewed",
    "skewed_posteriors",
    "assumptions",
    "questions",
    "coverage",
    "quantiles",
    "small_indices",
    "meshes",
    "pgd",
    "multifidelity",
    "linear",
    "learnt_errors",
    "controls",
    "gains",
    "blocks",
    "meshes_of_fields",
    "facets",
    "oddities",
    "edges",
    "held_out",
    "others",
    "collections_of_others",
    "scaling",
    "startup",
    "phases",
    "adaptive",
    "indentation",
)


def main(given: list[str]) -> int:
    """Run the benchmarks that are named, or all of them."""
    first = next((i for i, word in enumerate(given) if word.startswith("-")), len(given))
    names, words = given[:first] or list(NAMES), given[first:]
    if given in (["-h"], ["--help"]):
        print(f"{__doc__}\n{chr(10).join(NAMES)}")
        return 0
    unknown = [name for name in names if name not in NAMES]
    if unknown or (words and not given[:first]):
        said = f"unknown benchmark {unknown[0]}" if unknown else f"{words[0]}, expected a benchmark before it"
        sys.stderr.write(f"{said}, one of: {', '.join(NAMES)}\n")
        return 2
    modules = {name: import_module(f"benchmarks.{name}") for name in names}
    for name, module in modules.items():
        if words and "words" not in inspect.signature(module.main).parameters:
            sys.stderr.write(f"{words[0]}: {name} takes no options. {module.__doc__}\n")
            return 0 if words[0] in {"-h", "--help"} else 2
    for name, module in modules.items():
        print(f"\n## {name}\n", flush=True)
        module.main(words) if words else module.main()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
