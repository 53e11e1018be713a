"""Block preconditioners of the mixed form against its factor: a prototype, on assembled matrices.

With A = K_uu, B = K_pu and C = K_pp, pressures are found first, p = −S⁻¹ r_p, then displacements, u = A⁻¹ (r_u − Bᵀ p),
within GMRES. A⁻¹ is a cycle of two levels (as `forward.solvers.multigrid`, with a Chebyshev polynomial of degree 2), S
the mass matrix of the pressures over the shear modulus, with C; or, as for estimates of the error of the mesh, A⁻¹ are
the blocks of the nodes and S a diagonal. Source: H. Elman, D. Silvester, A. Wathen, Finite Elements and Fast Iterative
Solvers, 2nd ed. (2014), chapter 4.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.sparse as sp
from mpi4py import MPI
from scipy.sparse.linalg import LinearOperator, gmres, splu

from forward.fem.dolfinx.spaces import Transfer, Unknowns
from forward.hyperelastic import Hyperelastic
from forward.model import FloatArray

BODIES: dict[str, tuple[tuple[float, float, float], tuple[int, int, int], float]] = {  # edges, cells, traction (Pa)
    "cube of 5³": ((0.1, 0.1, 0.1), (5, 5, 5), 600.0),
    "cube of 7³": ((0.1, 0.1, 0.1), (7, 7, 7), 600.0),
    "cube of 10³": ((0.1, 0.1, 0.1), (10, 10, 10), 600.0),
    "beam": ((0.28, 0.0215, 0.087), (16, 2, 6), 20.0),
}
SHEAR = 1e4  # modulus (Pa)
MOST = 300  # iterations
TIGHT, ROUGH = 1e-10, 1e-2
Apply = Callable[[FloatArray], FloatArray]


def main(words: Sequence[str] = ()) -> None:
    """Print iterations to 1e-2 and 1e-10, and processor times (s), beside those of LDLᵀ."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks saddle")
    parser.add_argument("--bodies", nargs="+", choices=sorted(BODIES), default=list(BODIES))
    parser.add_argument("--ratios", type=float, nargs="+", default=[1e2, 1e4], help="κ/μ")
    given = parser.parse_args(words)
    print("| body | κ/μ | unknowns | two levels: steps | (s) | blocks: steps | (s) | factor (s) | its solve (s) |")
    print("|---|---:|---:|---:|---:|---:|---:|---:|---:|")
    for name in given.bodies:
        for ratio in given.ratios:
            print(f"| {name} | {ratio:g} | {_row(name, ratio)} |", flush=True)


def _row(name: str, ratio: float) -> str:
    edges, cells, traction = BODIES[name]
    bulk = ratio * SHEAR
    spec = Hyperelastic.model_validate(
        {
            "formulation": "mixed",
            "body": {"size": edges, "cells": cells, "cell": "tetrahedron", "degree": 2},
            "material": {"kind": "neo-hookean", "C1": SHEAR / 2, "D1": bulk / 2},
            "clamp": ("x-min",),
            "loads": ({"kind": "traction", "on": "x-max", "direction": (0.0, -1.0, 0.0), "size": traction},),
            "outputs": ({"kind": "mean-displacement", "name": "tip", "on": "x-max", "component": "y"},),
        }
    )
    model = spec.build(MPI.COMM_SELF, ())
    equations: Any = model.equations
    equations.set_state(np.array(model.solve(np.empty(0)).state))
    factor = equations.new_factor()
    b = np.random.default_rng(0).standard_normal(equations.size)
    b[equations.fixed] = 0
    factorisation, substitution = _seconds(factor.factorise), _seconds(lambda: factor.solve(b))
    rows, columns, values = factor._stiffness.matrix.getValuesCSR()
    order = equations.unknowns.take(np.arange(len(b))).astype(int)
    K = sp.csr_matrix((values, columns, rows))[order][:, order].tocsr()
    n = len(b) - equations.unknowns.pressures
    A, B, C = K[:n, :n].tocsr(), K[n:, :n].tocsr(), K[n:, n:].tocsr()
    smooth = _blocks(A)
    mass = splu((-C * (bulk / SHEAR) - C).tocsc())  # C is minus the mass matrix over the bulk modulus
    diagonal = -C.diagonal() + B.multiply(B) @ (1 / A.diagonal())
    ways = (_triangular(B, _cycle(A, smooth, equations), mass.solve), _triangular(B, smooth, lambda r: r / diagonal))
    told = [_iterations(K, b, way) for way in ways]
    return f"{len(b):,} | {told[0]} | {told[1]} | {factorisation:.2f} | {substitution:.3f}"


def _seconds(call: Callable[[], object]) -> float:
    begin = time.process_time()
    call()
    return time.process_time() - begin


def _triangular(B: Any, inverse: Apply, schur: Apply) -> Apply:
    def apply(r: FloatArray) -> FloatArray:
        n = B.shape[1]
        p = -schur(r[n:])
        return np.concatenate([inverse(r[:n] - B.T @ p), p])

    return apply


def _blocks(A: Any) -> Apply:
    """The inverses of the 3×3 blocks on the diagonal."""
    nodes, blocks = A.shape[0] // 3, A.tobsr((3, 3))
    rows = np.repeat(np.arange(nodes), np.diff(blocks.indptr))
    inverses = np.linalg.inv(blocks.data[blocks.indices == rows])
    return lambda r: np.asarray(np.einsum("nij,nj->ni", inverses, r.reshape(-1, 3)).ravel())


def _cycle(A: Any, smooth: Apply, equations: Any) -> Apply:
    """A polynomial, the coarse level with its factor, and the polynomial again."""
    below = Unknowns(equations.mesh, 1, mixed=False)
    transfer = Transfer(below.displacement, equations.space)
    units = np.eye(below.size)
    P = sp.hstack(
        [sp.csc_matrix(np.array([transfer(unit) for unit in units[i : i + 300]]).T) for i in range(0, below.size, 300)]
    )
    free = np.ones(A.shape[0])
    free[equations.fixed] = 0
    P = (sp.diags(free) @ P).tocsr()
    coarse = (P.T @ A @ P).tocsc()
    coarse = splu((coarse + sp.diags((coarse.diagonal() == 0).astype(float))).tocsc())
    x, largest = np.random.default_rng(1).standard_normal(A.shape[0]), 0.0
    for _ in range(15):
        x = smooth(A @ x)
        largest = 1.05 * float(np.linalg.norm(x))
        x /= np.linalg.norm(x)
    middle, half = 0.625 * largest, 0.375 * largest  # of [largest/4, largest]

    def polynomial(z: FloatArray, r: FloatArray) -> FloatArray:
        sigma = middle / half
        rho, residual = 1 / sigma, r - A @ z
        d = smooth(residual) / middle
        for _ in range(2):
            z, residual = z + d, residual - A @ d
            after = 1 / (2 * sigma - rho)
            d = after * rho * d + 2 * after / half * smooth(residual)
            rho = after
        return z

    def cycle(r: FloatArray) -> FloatArray:
        z = polynomial(np.zeros_like(r), r)
        return polynomial(z + P @ coarse.solve(P.T @ (r - A @ z)), r)

    return cycle


def _iterations(K: Any, b: FloatArray, precondition: Apply) -> str:
    sizes: list[float] = []
    begin = time.process_time()
    preconditioner = LinearOperator(K.shape, precondition)
    gmres(K, b, M=preconditioner, tol=TIGHT, restart=MOST, maxiter=1, callback=sizes.append, callback_type="pr_norm")
    seconds = time.process_time() - begin
    relative = np.array(sizes) / sizes[0]
    tight = f"{len(sizes)}" if len(sizes) < MOST else f"more than {MOST}"
    return f"{int((relative > ROUGH).sum()) + 1}, {tight} | {seconds:.1f}"
