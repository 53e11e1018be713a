"""Pairs of surfaces as a scanner would give them: STL files, and a file in TOML that says what belongs together."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import tomli_w
from numpy.typing import NDArray

from forward.bodies.surface import Surface

if TYPE_CHECKING:
    from forward.bodies.geometry import Body
    from forward.model import FloatArray

SAME = 12  # decimals (m) of places that are the same


def facets_among(body: Body, places: FloatArray) -> NDArray[np.int64]:
    """Return triangles (n, 3) of the surface of a body whose corners are all among places (k, 3), as rows of these."""
    rows = {tuple(place): i for i, place in enumerate((np.round(places, SAME) + 0.0).tolist())}
    corners = (np.round(Surface.of(body).triangles, SAME) + 0.0).tolist()
    found = [[rows.get(tuple(corner), -1) for corner in triangle] for triangle in corners]
    return np.array([triangle for triangle in found if min(triangle) >= 0], dtype=np.int64).reshape(-1, 3)


def surfaces(
    label: str,
    places: FloatArray,
    motions: Mapping[str, FloatArray],
    facets: NDArray[np.int64],
    more: Mapping[str, Any],
) -> dict[str, str]:
    """Return the texts of the files of a pair of surfaces for each load case, by their names.

    Parameters
    ----------
    label
        With which names begin.
    places, motions
        Undeformed places (k, 3), and displacements (k, 3) by load case, in the unit of the files.
    facets
        Triangles (n, 3), as rows of these.
    more
        What else the description says.
    """
    names = {case: f"{label}-{case}.stl" for case in motions}
    texts = {names[case]: _stl((places + motion)[facets]) for case, motion in motions.items()}
    texts[f"{label}.stl"] = _stl(places[facets])
    texts[f"{label}.toml"] = tomli_w.dumps({"reference": f"{label}.stl", "deformed": names, **more})
    return texts


def _stl(corners: FloatArray) -> str:
    """Return the text of an STL file of triangles (n, 3, 3)."""
    lines = ["solid surface"]
    for triangle in corners:
        a, b, c = triangle
        normal = np.cross(b - a, c - a)
        normal = normal / (np.linalg.norm(normal) or 1.0)
        lines += [f"facet normal {normal[0]:.6g} {normal[1]:.6g} {normal[2]:.6g}", " outer loop"]
        lines += [f"  vertex {x:.10g} {y:.10g} {z:.10g}" for x, y, z in triangle]
        lines += [" endloop", "endfacet"]
    return "\n".join([*lines, "endsolid surface", ""])
