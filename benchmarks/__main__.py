"""Run benchmarks: python -m benchmarks [NAME ...] (default: all). Ratios are measured side by side in one run.

What begins with dashes is for benchmarks that take options: python -m benchmarks tails --repeats 40.
"""

from __future__ import annotations

import sys

from benchmarks import (
    adaptive,
    blocks,
    bookkeeping,
    buckling,
    calibration,
    chaos,
    coverage,
    designs,
    estimates,
    fields,
    gains,
    held_out,
    indentation,
    intervals,
    inversion,
    kernels,
    levels,
    live,
    locking,
    mesh_error,
    meshes,
    meshes_of_fields,
    multifidelity,
    oddities,
    others,
    pgd,
    phases,
    population,
    precision,
    predictions,
    realisation,
    reduced,
    reduced_bodies,
    saddle,
    scaling,
    selection,
    size,
    sizes,
    skewed,
    stability,
    startup,
    streaming,
    tails,
    throughput,
    tolerance,
    turning,
    variance,
)

ALL = {
    "realisation": realisation.main,
    "reduced": reduced.main,
    "reduced_bodies": reduced_bodies.main,
    "live": live.main,
    "turning": turning.main,
    "bookkeeping": bookkeeping.main,
    "kernels": kernels.main,
    "throughput": throughput.main,
    "tolerance": tolerance.main,
    "variance": variance.main,
    "levels": levels.main,
    "fields": fields.main,
    "inversion": inversion.main,
    "calibration": calibration.main,
    "selection": selection.main,
    "population": population.main,
    "designs": designs.main,
    "intervals": intervals.main,
    "streaming": streaming.main,
    "tails": tails.main,
    "stability": stability.main,
    "locking": locking.main,
    "mesh_error": mesh_error.main,
    "estimates": estimates.main,
    "predictions": predictions.main,
    "buckling": buckling.main,
    "chaos": chaos.main,
    "size": size.main,
    "precision": precision.main,
    "saddle": saddle.main,
    "sizes": sizes.main,
    "skewed": skewed.main,
    "coverage": coverage.main,
    "meshes": meshes.main,
    "pgd": pgd.main,
    "multifidelity": multifidelity.main,
    "gains": gains.main,
    "blocks": blocks.main,
    "meshes_of_fields": meshes_of_fields.main,
    "oddities": oddities.main,
    "held_out": held_out.main,
    "others": others.main,
    "scaling": scaling.main,
    "startup": startup.main,
    "phases": phases.main,
    "adaptive": adaptive.main,
    "indentation": indentation.main,
}
WITH_OPTIONS = {
    "throughput": throughput.main,
    "reduced": reduced.main,
    "reduced_bodies": reduced_bodies.main,
    "designs": designs.main,
    "intervals": intervals.main,
    "size": size.main,
    "startup": startup.main,
    "scaling": scaling.main,
    "precision": precision.main,
    "saddle": saddle.main,
    "calibration": calibration.main,
    "indentation": indentation.main,
    "chaos": chaos.main,
    "tails": tails.main,
    "coverage": coverage.main,
    "meshes": meshes.main,
    "live": live.main,
    "pgd": pgd.main,
    "multifidelity": multifidelity.main,
    "gains": gains.main,
    "blocks": blocks.main,
    "meshes_of_fields": meshes_of_fields.main,
    "oddities": oddities.main,
    "tolerance": tolerance.main,
    "estimates": estimates.main,
    "phases": phases.main,
}


def main() -> int:
    """Run the benchmarks that are named, or all of them."""
    given = sys.argv[1:]
    first = next((i for i, word in enumerate(given) if word.startswith("--")), len(given))
    names, options = given[:first] or list(ALL), given[first:]
    unknown = [name for name in names if name not in ALL]
    if unknown:
        sys.stderr.write(f"unknown benchmark {unknown[0]}, expected one of: {', '.join(ALL)}\n")
        return 2
    if options and not all(name in WITH_OPTIONS for name in names):
        sys.stderr.write(f"{options[0]}, expected no options but for: {', '.join(WITH_OPTIONS)}\n")
        return 2
    for name in names:
        print(f"\n## {name}\n", flush=True)
        if name in WITH_OPTIONS:
            WITH_OPTIONS[name](options)
        else:
            ALL[name]()
    return 0


sys.exit(main())
