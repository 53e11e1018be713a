"""Maps of the places at which tools were pressed."""

import numpy as np
import xarray as xr
from matplotlib.collections import PathCollection

from forward.specimen import Specimen
from workflows.report.plots import places as plots
from workflows.report.sections.bodies import places_of

BALL = {"kind": "indenter", "shape": "sphere", "radius": 0.3, "on": "z-max", "direction": (0, 0, -1), "depth": 0.05}
AT = ((0.2, 0.3, 1.0), (0.8, 0.3, 1.0), (0.5, 0.7, 1.0))
SPEC = Specimen.model_validate(
    {
        "body": {"size": (1.0, 1.0, 1.0), "cells": (2, 2, 2), "degree": 1},
        "material": {"kind": "neo-hookean-coupled", "mu": 1e4, "lmbda": 2e4},
        "cases": tuple(
            {
                "name": f"p{k}",
                "clamp": ("z-min",),
                "loads": (BALL | {"at": at},),
                "outputs": ({"kind": "force", "name": "force"},),
            }
            for k, at in enumerate(AT)
        ),
    }
)


def test_a_map_shows_what_each_place_tells_and_where_the_lump_is():
    names = ["inclusions.lump.x", "inclusions.lump.y", "material.mu"]
    rng = np.random.default_rng(0)
    one = xr.Dataset(
        {
            "draw": (("sample", "parameter"), rng.uniform(size=(20, 3))),
            "true": ("parameter", [0.4, 0.6, np.nan]),
            "alone_eigenvalue": (("case", "direction"), [[np.e**2 - 1, 0.0], [0.0, np.nan], [np.e**4 - 1, -1e-12]]),
        },
        {"parameter": names, "case": ["p0", "p1", "p2"]},
    )
    tools = places_of(SPEC)
    np.testing.assert_allclose(plots.information(one, tools), [1, 0, 2])
    ax = plots.told(one, tools, SPEC.body.bounds, "lump")
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x (m)", "y (m)")
    drawn = [part for part in ax.collections if isinstance(part, PathCollection)]
    np.testing.assert_allclose(drawn[-1].get_offsets(), np.array(AT)[:, :2])
    np.testing.assert_allclose(drawn[-1].get_array(), [1, 0, 2])
    assert ax.lines[0].get_xydata().tolist() == [[0.4, 0.6]]


def test_load_cases_without_a_tool_have_no_place():
    pulled = {"name": "pull", "clamp": ("z-min",), "displacements": ({"on": "z-max", "x": 0, "y": 0, "z": 0.1},)}
    more = Specimen.model_validate(SPEC.model_dump() | {"cases": (*SPEC.model_dump()["cases"], pulled)})
    assert list(places_of(more)) == ["p0", "p1", "p2"]
