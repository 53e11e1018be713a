"""Run benchmarks: python -m benchmarks [NAME ...] (default: all). Ratios are measured side by side in one run."""

from __future__ import annotations

import sys

from benchmarks import (
    bookkeeping,
    buckling,
    calibration,
    chaos,
    coverage,
    fields,
    inversion,
    levels,
    locking,
    predictions,
    realisation,
    scaling,
    selection,
    skewed,
    stability,
    startup,
    streaming,
    tails,
    throughput,
    variance,
)

ALL = {
    "realisation": realisation.main,
    "bookkeeping": bookkeeping.main,
    "throughput": throughput.main,
    "variance": variance.main,
    "levels": levels.main,
    "fields": fields.main,
    "inversion": inversion.main,
    "calibration": calibration.main,
    "selection": selection.main,
    "streaming": streaming.main,
    "tails": tails.main,
    "stability": stability.main,
    "locking": locking.main,
    "predictions": predictions.main,
    "buckling": buckling.main,
    "chaos": chaos.main,
    "skewed": skewed.main,
    "coverage": coverage.main,
    "scaling": scaling.main,
    "startup": startup.main,
}


def main() -> int:
    """Run the benchmarks that are named, or all of them."""
    names = sys.argv[1:] or list(ALL)
    unknown = [name for name in names if name not in ALL]
    if unknown:
        sys.stderr.write(f"unknown benchmark {unknown[0]}, expected one of: {', '.join(ALL)}\n")
        return 2
    for name in names:
        print(f"\n## {name}\n")
        ALL[name]()
    return 0


sys.exit(main())
