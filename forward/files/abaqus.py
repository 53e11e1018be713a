"""Meshes of Abaqus's input files (.inp): nodes, elements, sets and surfaces, flat or as parts, instances and assembly.

Keywords, sides and their order are those of the Abaqus Keywords Reference (``*NODE``, ``*ELEMENT``, ``*NSET``,
``*ELSET``, ``*SURFACE``, ``*PART``, ``*INSTANCE``, ``*SOLID SECTION``, ``*INCLUDE``); all others say nothing about a
mesh. Not read are meshes that Abaqus itself would make (``*NGEN``, ``*ELGEN`` …), and nodes in other coordinates.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

SOLIDS = {4: "tetra", 5: "pyramid", 6: "wedge", 8: "hexahedron", 10: "tetra10", 15: "wedge15", 20: "hexahedron20"}
SHELLS = {3: "triangle", 4: "quad", 6: "triangle6", 8: "quad8", 9: "quad9"}
GENERATED = {"NGEN", "NFILL", "NCOPY", "NMAP", "ELGEN", "ELCOPY", "SYSTEM"}
Kind = TypeVar("Kind")
MOST_INCLUDED = 20
INCLUDED = re.compile(r"^\*(?:INCLUDE|NODE|ELEMENT)\b.*?\bINPUT\s*=\s*([^,\s]+)", re.IGNORECASE | re.MULTILINE)


@dataclass
class Part:
    """What a part, an instance of one, or a flat file holds; nodes and elements by their labels.

    Attributes
    ----------
    nodes
        Their places.
    elements
        Kind and nodes of each.
    node_sets, element_sets
        Labels by name, in capitals.
    told
        Element sets that the user named, not the program.
    sections
        Element sets that a solid section gives a material.
    surfaces
        Labels of elements with their side (0: all free ones), or of nodes (None), by name.
    """

    nodes: dict[int, list[float]] = field(default_factory=dict)
    elements: dict[int, tuple[str, list[int]]] = field(default_factory=dict)
    node_sets: dict[str, list[int]] = field(default_factory=dict)
    element_sets: dict[str, list[int]] = field(default_factory=dict)
    told: set[str] = field(default_factory=set)
    sections: list[str] = field(default_factory=list)
    surfaces: dict[str, list[tuple[list[int], int | None]]] = field(default_factory=dict)

    def placed(self, rows: list[list[str]]) -> Part:
        """Return an instance: shifted by the first row, then turned about an axis by the second."""
        places = np.array(list(self.nodes.values()), dtype=float).reshape(-1, 3)
        for row in (list(map(float, row)) for row in rows):
            if len(row) == 3:
                places = places + row
            elif len(row) == 7:
                start, end = np.array(row[:3]), np.array(row[3:6])
                axis, angle = (end - start) / np.linalg.norm(end - start), np.radians(row[6])
                arm = places - start
                along = np.outer(arm @ axis, axis)
                places = start + along + np.cos(angle) * (arm - along) + np.sin(angle) * np.cross(axis, arm)
            else:
                raise ValueError(f"an instance with a row of {len(row)} numbers, expected a shift or a rotation")
        return replace(deepcopy(self), nodes=dict(zip(self.nodes, places.tolist(), strict=True)))

    def join(self, other: Part) -> None:
        """Add another part, whose labels are shifted."""
        n, e = (max(labels, default=0) for labels in (self.nodes, self.elements))
        self.nodes |= {n + label: place for label, place in other.nodes.items()}
        self.elements |= {e + label: (kind, [n + k for k in nodes]) for label, (kind, nodes) in other.elements.items()}
        for mine, theirs, shift in ((self.node_sets, other.node_sets, n), (self.element_sets, other.element_sets, e)):
            for name, labels in theirs.items():
                _add(mine, name, [shift + k for k in labels])
        for name, rows in other.surfaces.items():
            shifted = [([(n if side is None else e) + k for k in labels], side) for labels, side in rows]
            self.surfaces[name] = self.surfaces.get(name, []) + shifted
        self.told |= other.told
        self.sections += other.sections


class Block(NamedTuple):
    """A keyword with its parameters in capitals, its line, and the rows of data below it."""

    keyword: str
    given: dict[str, str]
    line: int
    rows: list[list[str]]

    def of(self, name: str) -> str:
        """Return a parameter as it is written.

        Raises
        ------
        ValueError
            If it is missing.
        """
        if name not in self.given:
            raise ValueError(f"line {self.line}: *{self.keyword} without {name}=")
        return self.given[name]


def included(path: Path) -> list[Path]:
    """Return the files that a file includes."""
    return [path.parent / name for name in INCLUDED.findall(path.read_text(encoding="utf-8", errors="replace"))]


def _blocks(path: Path, depth: int = 0) -> Iterator[Block]:
    """Read keywords one after another, in files that are included too."""
    if depth > MOST_INCLUDED:
        raise ValueError(f"{path.name}: files that include each other")
    block: Block | None = None
    open_line = ""
    for number, raw in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        line = raw.strip()
        if line.startswith("**") or not line:
            continue
        if open_line:
            line, open_line = open_line + line, ""
        if not line.startswith("*"):
            if block is not None:
                block.rows.append([cell.strip() for cell in line.rstrip(",").split(",")])
            continue
        if line.endswith(","):
            open_line = line
            continue
        if block is not None:
            yield block
        keyword, *words = (word.strip() for word in line[1:].split(","))
        pairs = (word.partition("=") for word in words)
        given = {name.strip().upper(): value.strip().strip('"') for name, _, value in pairs}
        block = Block(" ".join(keyword.upper().split()), given, number, [])
        if "INPUT" in given and block.keyword in {"INCLUDE", "NODE", "ELEMENT"}:
            other = path.parent / given["INPUT"]
            if block.keyword == "INCLUDE":
                yield from _blocks(other, depth + 1)
            else:
                text = other.read_text(encoding="utf-8", errors="replace").splitlines()
                block.rows[:] = [[cell.strip() for cell in row.strip(" ,").split(",")] for row in text if row.strip()]
    if block is not None:
        yield block


def read(path: Path) -> Part:
    """Read a file: its instances that have elements, joined; the parts, or the flat file, where there are none.

    The nodes of a file that has no elements.

    Raises
    ------
    ValueError
        With what is wrong, and the line where that is known.
    OSError
        If it cannot be read.
    """
    flat, outside, parts, instances = Part(), Part(), dict[str, Part](), dict[str, Part]()
    scope = flat
    for block in _blocks(path):
        try:
            match block.keyword:
                case "PART":
                    scope = parts.setdefault(block.of("NAME").upper(), Part())
                case "ASSEMBLY":
                    scope = outside
                case "INSTANCE":
                    part = _named(parts, block.of("PART"), "part")
                    scope = instances[block.of("NAME").upper()] = part.placed(block.rows)
                case "END PART" | "END ASSEMBLY":
                    scope = flat
                case "END INSTANCE":
                    scope = outside
                case "NSET" | "ELSET" | "SURFACE" if scope is outside:
                    _of_instances(instances, block)
                case _:
                    _into(scope, block)
        except ValueError as error:
            where = "" if str(error).startswith("line ") else f"line {block.line}: *{block.keyword}: "
            raise ValueError(f"{where}{error}") from None
    found = _chosen(instances.values()) or _chosen(parts.values()) or _chosen([flat])
    if found is None and not flat.nodes:
        raise ValueError("no *NODE with rows")
    return found or flat


def _chosen(those: Iterable[Part]) -> Part | None:
    """Return those that have solid elements, or else any, as one part; None if there are none."""
    found = [part for part in those if part.elements]
    solid = [part for part in found if any(kind in SOLIDS.values() for kind, _ in part.elements.values())]
    if not found:
        return None
    first, *others = solid or found
    for other in others:
        first.join(other)
    return first


def _of_instances(instances: dict[str, Part], block: Block) -> None:
    """Add a set or surface of the assembly to the instances that it is of; others say nothing about a body."""
    of = block.given.get("INSTANCE", "").upper()
    for name, one in instances.items():
        if of == name:
            _into(one, block)
        elif not of:
            prefix, sets = f"{name}.", {key.upper() for key in (*one.element_sets, *one.node_sets)}
            mine = [[cell.upper().removeprefix(prefix) for cell in row] for row in block.rows if row[0]]
            whole = zip(mine, block.rows, strict=True)
            kept = [row for row, said in whole if row[0] in sets or said[0].upper().startswith(prefix)]
            if kept:
                _into(one, block._replace(rows=kept))


def _into(part: Part, block: Block) -> None:
    """Add what a keyword says to a part."""
    match block.keyword:
        case "NODE":
            if block.given.get("SYSTEM", "R").upper() != "R":
                raise ValueError("nodes in cylindrical or spherical coordinates, expected x, y, z")
            for row in block.rows:
                part.nodes[int(row[0])] = [float(cell or 0) for cell in row[1:4]] + [0.0] * (4 - len(row[:4]))
            _add(part.node_sets, block.given.get("NSET"), [int(row[0]) for row in block.rows])
        case "ELEMENT":
            known = _kind(block.of("TYPE"))
            if known is None:
                return
            kind, size = known
            numbers = [int(cell) for row in block.rows for cell in row if cell]
            if len(numbers) % (size + 1):
                raise ValueError(
                    f"{len(numbers)} numbers, expected {size + 1} for each element of type {block.of('TYPE')}"
                )
            rows = np.array(numbers, dtype=np.int64).reshape(-1, size + 1).tolist()
            part.elements |= {row[0]: (kind, row[1:]) for row in rows}
            _add(part.element_sets, block.given.get("ELSET"), [row[0] for row in rows])
        case "NSET" | "ELSET":
            sets = part.node_sets if block.keyword == "NSET" else part.element_sets
            name = block.of(block.keyword)
            _add(sets, name, _members(block, sets))
            if block.keyword == "ELSET" and "INTERNAL" not in block.given and not name.startswith("_"):
                part.told.add(name)
        case "SURFACE":
            of_nodes = block.given.get("TYPE", "ELEMENT").upper() == "NODE"
            if of_nodes or block.given.get("TYPE", "ELEMENT").upper() == "ELEMENT":
                sets = part.node_sets if of_nodes else part.element_sets
                rows = [
                    ([int(name)] if name.isdecimal() else _named(sets, name), None if of_nodes else _side(*side[:1]))
                    for name, *side in block.rows
                    if name
                ]
                part.surfaces[block.of("NAME")] = part.surfaces.get(block.of("NAME"), []) + rows
        case "SOLID SECTION":
            part.sections.append(block.of("ELSET"))
        case keyword if keyword in GENERATED and (block.rows or keyword != "SYSTEM"):
            raise ValueError("a mesh that Abaqus would make, expected all nodes and elements")


def _kind(word: str) -> tuple[str, int] | None:
    """Return meshio's name of a type of element, and its number of nodes; None of points and lines."""
    solid = re.match(r"D?C3D(\d+)", word.upper())
    shell = re.match(r"(?:STRI|CPS|CPE|CAX|SFM3D|M3D|R3D|S)(65|\d)", word.upper())
    if solid is not None and int(solid[1]) in SOLIDS:
        return SOLIDS[int(solid[1])], int(solid[1])
    count = 0 if shell is None else int(shell[1].replace("65", "6"))
    if count in SHELLS:
        return SHELLS[count], count
    if re.match(r"[TB][23]|RB|R2D|CONN|DASHPOT|SPRING|MASS|ROTARYI|DCOUP|HEATCAP", word.upper()):
        return None
    raise ValueError(f"unknown type of element '{word}'")


def _side(word: str = "") -> int:
    """Return the number of a side; 0 for all that are free."""
    found = re.fullmatch(r"(?:S(\d)|SPOS|SNEG|)", word.upper())
    if found is None:
        raise ValueError(f"the side '{word}', expected S1, S2, …")
    return int(found[1] or 0)


def _add(sets: dict[str, list[int]], name: str | None, labels: list[int]) -> None:
    if name is not None:
        sets[name] = sets.get(name, []) + labels


def _members(block: Block, sets: dict[str, list[int]]) -> list[int]:
    """Return the labels of a set: numbers, ranges, or other sets."""
    found: list[int] = []
    for row in block.rows:
        if "GENERATE" in block.given:
            first, last, step = [*map(int, row[:3]), 1][:3]
            found += range(first, last + 1, step)
            continue
        for cell in filter(None, row):
            labels: list[int] = [int(cell)] if cell.isdecimal() else _named(sets, cell)
            found += labels
    return found


def _named(those: dict[str, Kind], name: str, what: str = "set") -> Kind:
    """Return a set or part by its name, in whatever case."""
    found = next((one for key, one in those.items() if key.upper() == name.strip('"').upper()), None)
    if found is None:
        raise ValueError(f"no {what} '{name}'")
    return found
