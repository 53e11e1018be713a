"""Compiled kernels that take several cells at once, in the lanes of the processor's vector unit.

FFCx writes a kernel for one cell, whose long chains of scalar operations at a quadrature point no compiler can
vectorise. Here every number in it becomes a vector of those of several cells, as many as fit into a register of the
processor that is compiled for: the same operations in the same order, in the vector types of GCC and Clang. What FFCx
writes is regular enough for a few replacements; where they do not apply, or do not compile, there is no such kernel,
and DOLFINx's own loop over cells does the same, more slowly. That is said once.
"""

from __future__ import annotations

import ctypes
import hashlib
import logging
import re
import shlex
import subprocess
import sysconfig
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from forward.fem.dolfinx.compile import compiled, folder_of
from forward.model import FloatArray
from forward.native import FLAGS

UNROLLED = "-fpeel-loops"  # loops over the nodes of a cell: forces on tetrahedra take a quarter less
LONGEST = 8000  # lines of a kernel; one of 5 400 compiles in 8 s, one of 51 000 in six minutes
_KERNEL = re.compile(r"^void tabulate_tensor_(?:integral|expression)_\w+\(double\* restrict A,[^{}]*{", re.MULTILINE)
_TABLE = re.compile(r"^ *static const double .*?;$", re.DOTALL | re.M)
_KNOWN = {"fabs", "fmax", "fmin", "sqrt", "pow", "exp", "log", "sin", "cos", "sinh", "cosh", "tanh", "atan2"}
_SOURCE = Path(__file__).with_name("lanes.c")


def translated(source: str) -> str | None:
    """Return the one kernel in what FFCx has written for vectors V; None where there is none, or it is unusual."""
    kernels = list(_KERNEL.finditer(source))
    if len(kernels) != 1:
        return None
    begin = kernels[0].end()
    body = source[begin : _closing(source, "{}", begin)]
    if body.count("\n") > LONGEST:
        return None
    tables = "\n".join(_TABLE.findall(body))
    body = _TABLE.sub("", body)
    if "entity_local_index" in body or "quadrature_permutation" in body or "&&" in body or "||" in body:
        return None
    if not set(re.findall(r"\b([a-z]\w*)\(", body)) <= _KNOWN | {"for", "restrict"}:
        return None
    body = re.sub(r"\b(\w+)\(", lambda m: f"v_{m[1]}(" if m[1] in _KNOWN else m[0], body)
    body = re.sub(r"^( *)(?:const )?double (\w+(?:\[\w+\])?)", r"\1V \2", body, flags=re.M)
    body = re.sub(r"^( *)(?:const )?bool (\w+) = (.*);$", r"\1M \2 = MASK(\3);", body, flags=re.M)
    body = re.sub(r"^(?! *(?:for\b|M ))( *)((?:V )?[\w\[\] *+]+) = (.*);$", r"\1\2 = ALL(\3);", body, flags=re.M)
    body = "\n".join(_without_conditions(line) for line in body.split("\n"))
    if re.search(r"\bdouble\b|\?", body):
        return None
    return f"KERNEL\n{{\n{tables}\n{body}}}"


def _closing(text: str, brackets: str, start: int, stop: str = "") -> int:
    """Where the bracket closes that is open at `start`, or where another character comes outside inner brackets."""
    depth, opening, closing = 0, *brackets
    for i in range(start, len(text)):
        if depth == 0 and text[i] in (closing, stop):
            return i
        depth += (text[i] == opening) - (text[i] == closing)
    raise ValueError(text)


def _without_conditions(line: str) -> str:
    """Write `(a < b ? x : y)` as a function of vectors."""
    while "?" in line:
        mark = line.rindex("?")  # the last has none inside
        start = mark - 1 - _closing(line[:mark][::-1], ")(", 0)
        colon, end = _closing(line, "()", mark, ":"), _closing(line, "()", mark)
        condition, yes, no = line[start + 1 : mark], line[mark + 1 : colon], line[colon + 1 : end]
        line = f"{line[: start + 1]}CHOOSE({condition}, {yes}, {no}){line[end:]}"
    return line


_LOOP = """
void assemble(int64_t cells, const double* places, const int32_t* const* nodes, const double* const* values,
              const double* constants, double* out)
{{
  V A[{entries}], w[{width} + 1], x[{places}], c[{constants} + 1];
  for (int i = 0; i < {constants}; ++i) c[i] = ALL(constants[i]);
  for (int64_t first = 0; first < cells; first += LANES) {{
    const int left = cells - first < LANES ? cells - first : LANES;
    gather_places(x, places + {places} * first, {places});
{gathers}
    for (int i = 0; i < {entries}; ++i) A[i] = ALL(0.0);
    kernel(A, w, c, x);
    {output}
  }}
}}
"""
_VERSION = hashlib.sha256(_SOURCE.read_bytes() + Path(__file__).read_bytes()).hexdigest()[:12]


class Numbers(NamedTuple):
    """Numbers at the nodes of cells: a coefficient of a form, or what it is integrated to.

    Attributes
    ----------
    nodes
        Nodes (n_cells, count) of the cells.
    size
        Numbers at each.
    values
        Those of all nodes, which may change; empty for what is integrated to.
    """

    nodes: NDArray[np.int32]
    size: int
    values: FloatArray


class Kernel:
    """A kernel with the cells of a rank; collective over `comm`.

    Parameters
    ----------
    name
        Under which FFCx's code is kept (`compile.signature`).
    places
        Corners (n_cells, k, 3).
    coefficients
        Of the form, in its order.
    constants
        How many it has.
    to, stored
        Nodes to which the values of the cells are added, in a list; an empty one, and the number of values of each
        cell, where they are stored.
    comm
        Communicator of the ranks that have compiled it.

    Attributes
    ----------
    available
        Whether there is such a kernel, on this machine.
    lanes
        How many cells it takes at once; 1 without one.
    """

    def __init__(
        self,
        name: str,
        places: FloatArray,
        coefficients: Sequence[Numbers],
        constants: int,
        to: Sequence[Numbers],
        stored: int,
        comm: Any,
    ) -> None:
        loop = _loop(places.shape[1] * places.shape[2], coefficients, constants, to, stored)
        text = hashlib.sha256(loop.encode()).hexdigest()[:4]  # an expression is stored, or added up
        beside = f"-lanes-{_VERSION}-{text}"
        self._assemble, self.lanes = compiled(name, lambda folder: self._load(folder, name, loop, comm), comm, beside)
        self.available = self._assemble is not None
        self._cells = len(places)
        self._places = self._grouped(places.reshape(-1, places.shape[1] * places.shape[2]))
        self._at = self._places.ctypes.data
        self._kept = [self._grouped(one.nodes) for one in [*coefficients, *to]], [one.values for one in coefficients]
        nodes, values = self._kept
        self._nodes, self._values = _addresses(nodes), _addresses(values)

    def _load(self, folder: Path, name: str, loop: str, comm: Any) -> tuple[Any, int]:
        """Return the function and its number of lanes, or None and 1 without one."""
        library, source = folder / "lanes.so", folder / "lanes.c"
        if comm.rank == 0 and not source.exists():
            _compile(folder_of(name), loop, source, library)
        exists = comm.bcast(library.exists() if comm.rank == 0 else None)
        if not exists:
            if comm.rank == 0:
                _say_that_it_is_slow(source.read_text(encoding="utf-8"))
            return None, 1
        loaded = ctypes.CDLL(str(library))
        loaded.assemble.argtypes, loaded.assemble.restype = [ctypes.c_int64, *[ctypes.c_void_p] * 5], None
        return loaded.assemble, ctypes.c_int.in_dll(loaded, "lanes").value

    def _grouped(self, of_cells: NDArray[Any]) -> NDArray[Any]:
        """Put rows (n_cells, k) into groups (n_groups, k, lanes); the last cell fills the last group."""
        missing = -len(of_cells) % self.lanes
        filled = np.concatenate([of_cells, np.repeat(of_cells[-1:], missing, axis=0)])
        return np.ascontiguousarray(filled.reshape(-1, self.lanes, of_cells.shape[1]).swapaxes(1, 2))

    def __call__(self, constants: FloatArray, out: FloatArray) -> None:
        """Add the values of all cells to those of the nodes in `out`, or put those of each cell there."""
        self._assemble(self._cells, self._at, self._nodes, self._values, constants.ctypes.data, out.ctypes.data)


def _addresses(arrays: Sequence[NDArray[Any]]) -> ctypes.Array[ctypes.c_void_p]:
    return (ctypes.c_void_p * len(arrays))(*(array.ctypes.data for array in arrays))


@cache
def _say_that_it_is_slow(why: str) -> None:
    """Say once for each reason, given as a comment in C, that forces are assembled one cell after the other."""
    reason = why.removeprefix("/* ").removesuffix(" */")
    logging.getLogger("tissuq").warning("forces take longer, one cell after the other: %s", reason)


def _compile(folder: Path, loop: str, source: Path, library: Path) -> None:
    """Write what is to be compiled; where it is not possible, the reason stands there and there is no library."""
    found = list(folder.glob("*.c"))
    kernel = translated(found[0].read_text(encoding="utf-8")) if len(found) == 1 else None
    if kernel is None:
        source.write_text("/* the compiled form is too long, or unusual, for vectors of cells */", encoding="utf-8")
        return
    source.write_text(f"{_SOURCE.read_text(encoding='utf-8')}\n{kernel}\n{loop}", encoding="utf-8")
    compiler = shlex.split(sysconfig.get_config_var("CC") or "cc")
    command = [*compiler, UNROLLED, *FLAGS, "-w", "-fPIC", "-shared", str(source), "-o", str(library), "-lm"]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode:
        library.unlink(missing_ok=True)
        source.write_text(f"/* {compiler[0]} does not compile vectors of cells */", encoding="utf-8")


def _loop(places: int, coefficients: Sequence[Numbers], constants: int, to: Sequence[Numbers], stored: int) -> str:
    gathers, width = [], 0
    for i, one in enumerate(coefficients):
        count = one.nodes.shape[1]
        gathers.append(f"    gather(w + {width}, nodes[{i}] + {count} * first, values[{i}], {count}, {one.size});")
        width += count * one.size
    entries, output = stored, f"store(A, out + {stored} * first, {stored}, left);"
    for one in to:
        count = one.nodes.shape[1]
        entries, rows = count * one.size, f"nodes[{len(coefficients)}] + {count} * first"
        output = f"scatter(A, {rows}, out, {count}, {one.size}, left);"
    return _LOOP.format(
        entries=entries, width=width, places=places, constants=constants, gathers="\n".join(gathers), output=output
    )
