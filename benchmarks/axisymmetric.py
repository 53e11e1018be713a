"""Another code for one problem: a rigid sphere pressed without friction into a neo-Hookean cylinder, by NumPy alone.

Axisymmetric quadratic quadrilaterals, stiffness by complex steps, contact by stiff springs at the nodes of the top.
Nothing is shared with the program.
"""

from __future__ import annotations

from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.linalg import spsolve

STEP = 1e-30


class Indented(NamedTuple):
    """Force (N) on a sphere, and the area (m²) of the deformed top that it touches."""

    force: float
    area: float


def thin(cells: int, end: float, growth: float = 1.25) -> np.ndarray[Any, Any]:
    """Return ends of cells from 0 to 1: so many of equal length up to `end`, and longer ones from there."""
    lengths = [end / cells]
    while sum(lengths) < 1 - end:
        lengths.append(lengths[-1] * growth)
    beyond = np.cumsum(lengths[1:])
    return np.append(np.linspace(0, end, cells + 1), end + beyond * (1 - end) / beyond[-1])


def indented(  # noqa: PLR0915 - one problem, solved from end to end
    b: float, height: float, radius: float, depth: float, c1: float, d1: float, ends: np.ndarray[Any, Any] | None = None
) -> Indented:
    """Press a sphere into a cylinder of radius b (m), bonded below, by a depth (m).

    The energy is c1 (Ī1 − 3) + d1 (J − 1)². `ends` are those of cells from the axis and from the top, over the size.
    """
    if ends is None:
        ends = np.append(0, np.cumsum(1.15 ** np.arange(20)) / (1.15 ** np.arange(20)).sum())
    cells = len(ends) - 1
    ticks = np.sort(np.concatenate([ends, (ends[1:] + ends[:-1]) / 2]))
    n = len(ticks)
    R, Z = np.meshgrid(b * ticks, height * (1 - ticks), indexing="ij")  # fine at the axis and at the top
    X = np.stack([R.ravel(), Z.ravel()], axis=1)
    first = np.array([2 * i * n + 2 * j for i, j in product(range(cells), repeat=2)])
    nodes = first[:, None] + np.array([i * n + j for i in range(3) for j in range(3)])
    gauss, weight = np.polynomial.legendre.leggauss(3)
    N, dN, w = [], [], []
    for (s, ws), (t, wt) in product(zip(gauss, weight, strict=True), repeat=2):
        (a, da), (c, dc) = _quadratic(s), _quadratic(t)
        N.append(np.outer(a, c).ravel())
        dN.append(np.stack([np.outer(da, c).ravel(), np.outer(a, dc).ravel()]))
        w.append(ws * wt)
    shapes, slopes, weights = np.array(N), np.array(dN), np.array(w)
    J = np.einsum("qak,ekx->eqax", slopes, X[nodes])
    G = np.einsum("eqxa,qak->eqkx", np.linalg.inv(J), slopes)
    r = np.einsum("qk,ek->eq", shapes, X[nodes][..., 0])
    dV = 2 * np.pi * r * np.abs(np.linalg.det(J)) * weights
    # The five components of F that are not always 0 or 1, as a linear function of the values at the nodes.
    B = np.zeros((*dV.shape, 5, 9, 2))
    B[..., 0, :, 0], B[..., 1, :, 0] = G[..., 0], G[..., 1]
    B[..., 2, :, 1], B[..., 3, :, 1] = G[..., 0], G[..., 1]
    B[..., 4, :, 0] = shapes / r[..., None]
    B = B.reshape(*dV.shape, 5, 18)
    dofs = (2 * nodes[:, :, None] + np.arange(2)).reshape(len(nodes), 18)
    top = np.arange(0, n * n, n)
    area = np.zeros(n * n)
    for cell in range(cells):  # Simpson's rule of 2πr along the top
        (i, j, k), h = top[2 * cell : 2 * cell + 3], X[top[2 * cell + 2], 0] - X[top[2 * cell], 0]
        area[[i, j, k]] += 2 * np.pi * X[[i, j, k], 0] * h * np.array([1, 4, 1]) / 6
    area[0] = area[top[1]] * 1e-3
    held = np.concatenate([2 * np.arange(n), 2 * np.arange(n - 1, n * n, n), 2 * np.arange(n - 1, n * n, n) + 1])
    free = np.setdiff1d(np.arange(2 * n * n), held)
    stiff = 3e4 * (c1 + d1) / radius
    both = 2 * top[:, None] + [0, 1]

    def forces(u: Any, step: float) -> tuple[Any, ...]:
        F = np.einsum("eqid,ed->eqi", B, u[dofs]) + np.array([1, 0, 0, 1, 1])
        residual = np.zeros(2 * n * n)
        np.add.at(residual, dofs, np.einsum("eqid,eqi,eq->ed", B, _stress(F, c1, d1), dV))
        x = X[top] + u.reshape(-1, 2)[top] - np.array([0, height - step + radius])
        length = np.linalg.norm(x, axis=1)
        normal = x / length[:, None]
        push = np.where(length < radius, stiff * area[top] * (radius - length), 0.0)
        np.add.at(residual, both, -push[:, None] * normal)
        residual[held] = 0
        return residual, F, push, normal

    u, force = np.zeros(2 * n * n), 0.0
    for step in np.linspace(0, depth, 11)[1:]:
        for _ in range(80):
            residual, F, push, normal = forces(u, step)
            force = float(-(push * normal[:, 1]).sum())
            if np.linalg.norm(residual) < 1e-7 * max(abs(force), 1e-12):
                break
            A = np.stack([_stress(F + 1j * STEP * unit, c1, d1).imag / STEP for unit in np.eye(5)], axis=-1)
            K = np.einsum("eqid,eqij,eqjf,eq->edf", B, A, B, dV, optimize=True)
            rows, columns = np.repeat(dofs, 18, axis=1), np.tile(dofs, (1, 18))
            matrix: Any = coo_matrix((K.ravel(), (rows.ravel(), columns.ravel()))).tocsr()
            k = np.where(push > 0, stiff * area[top], 0.0)
            extra = k[:, None, None] * normal[:, :, None] * normal[:, None, :]
            where = (np.repeat(both, 2, axis=1).ravel(), np.tile(both, (1, 2)).ravel())
            matrix = matrix + csr_matrix((extra.ravel(), where), shape=matrix.shape)
            change = np.zeros_like(u)
            change[free] = spsolve(matrix[free][:, free].tocsc(), -residual[free])
            low, high, part = 0.0, 1.0, 1.0
            for _ in range(25):  # bisection for the end of the fall of the energy along the step
                slope = forces(u + part * change, step)[0] @ change
                if part == 1 and slope <= 0:
                    break
                low, high = (part, high) if slope < 0 else (low, part)
                part = (low + high) / 2
            u = u + part * change
        else:
            message = "the other code does not converge"
            raise RuntimeError(message)
    x = X[top] + u.reshape(-1, 2)[top]
    rings = np.pi * (x[1:, 0] + x[:-1, 0]) * np.linalg.norm(np.diff(x, axis=0), axis=1)
    within, last = np.append(0, np.cumsum(rings)), int(np.flatnonzero(push)[-1])
    before, there = (push[last - 1 : last + 1] / area[top][last - 1 : last + 1]) ** 2  # falls to 0 like a line
    beyond = (within[last] - within[last - 1]) * there / (before - there) if before > there else 0.0
    return Indented(abs(force), float(within[last] + min(beyond, rings[last])))


def _quadratic(s: float) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    return np.array([s * (s - 1) / 2, 1 - s * s, s * (s + 1) / 2]), np.array([s - 0.5, -2 * s, s + 0.5])


def _stress(F: Any, c1: float, d1: float) -> Any:
    """Nominal stress of F = [[F0, F1, 0], [F2, F3, 0], [0, 0, F4]]."""
    a, b, c, d, e = np.moveaxis(F, -1, 0)
    plane = a * d - b * c
    J = plane * e
    cofactor = np.stack([d * e, -c * e, -b * e, a * e, plane], axis=-1)
    scale = 2 * c1 * J ** (-2 / 3)
    inner = (F**2).sum(axis=-1)
    return scale[..., None] * F + (2 * d1 * (J - 1) - scale * inner / (3 * J))[..., None] * cofactor
