"""Studies in words, for reports."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from forward.readable import settings


def stability(counts: dict[str, int]) -> str:
    """Say how the stability of the states of a study was tested, from `stability` in summary.json."""
    refused = counts["refused"] + counts["missed"]
    parts = [
        f"{counts['counted']:,} by counting negative eigenvalues",
        f"{counts['screened']:,} by the screen only",
        *([f"{counts['not_tested']:,} not at all"] if counts["not_tested"] else []),
        *([f"{refused:,} refused as unstable"] if refused else []),
    ]
    return f"stability of the states: {', '.join(parts)}"


def joined(counts: Mapping[str, int], work: Mapping[str, int]) -> str:
    """Say how states were seen to be joined to rest, and what that took, from `joined` and `work` in summary.json."""
    audited = sum(counts.values()) - counts["not looked at"] - counts["screened"]
    words = {"beyond a jump": "beyond a jump", "another equilibrium found too": "with another equilibrium"}
    found = "".join(f", {counts[one]:,} {said}" for one, said in words.items() if counts[one])
    cost = [
        f"{100 * work[f'audit_{name}'] / work[name]:.2g} % of the {name.replace('_', '-')}"
        for name in ("residuals", "factorisations", "back_substitutions")
        if work[name]
    ]
    return (
        f"joined to rest: {audited:,} by following the path, {counts['screened']:,} by the screens only"
        f"{found}; audits took {', '.join(cost)}"
    )


def law(block: dict[str, Any]) -> str:
    """Write the block of a distribution: uniform: lower = 1, upper = 2."""
    return f"{block['kind']}: {settings(block, 'kind')}"


def solves(summary: Mapping[str, Any]) -> int:
    """Return the number of solves, also if several data sets were inverted in parallel."""
    return int(max(summary["evaluations"], summary.get("solves", 0)))


def counted(solves: int) -> str:
    """Write a number of solves."""
    return "1 solve" if solves == 1 else f"{solves:,} solves"
