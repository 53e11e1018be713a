"""A cube of tissue by another code, for data that have nothing in common with the models that are inverted.

Tetrahedra of degree 4, six in each cell of a grid that is thinner towards the held face z = 0 and the faces beside it;
dead tractions on z = L; the coupled neo-Hookean material with a factor on its energy. Nothing of `forward` is used:
shape functions, quadrature, stresses and their derivatives are written out here. Newton's method with conjugate
gradients, preconditioned by the factor of the first tangent.

python -m benchmarks.other_code FILE.csv writes data for configs/inclusion.toml.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from itertools import permutations, product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

FloatArray = NDArray[np.float64]
DEGREE = 4
SETTLED = 1e-7  # forces that are left, over the loads
ORDERS = list(permutations(range(3)))
KUHN = np.array([[np.eye(3, dtype=int)[list(order[:k])].sum(axis=0) for k in range(4)] for order in ORDERS])
POWERS = np.array([p for p in product(range(DEGREE + 1), repeat=3) if sum(p) <= DEGREE])


def _monomials(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Monomials (n, 35) of points (n, 3), and their derivatives (n, 35, 3)."""
    values = (points[:, None, :] ** POWERS).prod(axis=2)
    slopes = np.zeros((*values.shape, 3))
    for axis in range(3):
        lower = POWERS.copy()
        lower[:, axis] = np.maximum(lower[:, axis] - 1, 0)
        slopes[:, :, axis] = POWERS[:, axis] * (points[:, None, :] ** lower).prod(axis=2)
    return values, slopes


def _quadrature(n: int) -> tuple[FloatArray, FloatArray]:
    """Points and weights of the reference tetrahedron, exact to degree 2n − 1: a cube that is collapsed."""
    from scipy.special import roots_jacobi

    (a, wa), (b, wb), (c, wc) = (roots_jacobi(n, k, 0) for k in (0, 1, 2))
    grid = np.stack(np.meshgrid((a + 1) / 2, (b + 1) / 2, (c + 1) / 2, indexing="ij"), axis=-1).reshape(-1, 3)
    w = np.einsum("i,j,k->ijk", wa / 2, wb / 4, wc / 8).ravel()
    z = grid[:, 2]
    y = grid[:, 1] * (1 - z)
    x = grid[:, 0] * (1 - y - z)
    return np.column_stack([x, y, z]), w


LATTICE = POWERS / DEGREE  # nodes of the reference tetrahedron
INVERSE = np.linalg.inv(_monomials(LATTICE)[0])  # of monomials at the nodes
POINTS, WEIGHTS = _quadrature(DEGREE)
SLOPES = np.einsum("qmr,ma->qar", _monomials(POINTS)[1], INVERSE)


class Cube:
    """A cube [0, L]³ of Lamé constants μ and λ, held at z = 0.

    Parameters
    ----------
    cells
        Of the grid, along an edge.
    size
        L (m).
    thinner
        How much thinner cells are at z = 0 than at z = L, and at the sides than in the middle.
    """

    def __init__(self, cells: int, size: float, thinner: tuple[float, float] = (24.0, 6.0)) -> None:
        self.cells, self.size = cells, size
        self._mesh(self._graded(cells, thinner))

    @classmethod
    def around(cls, cells: int, size: float) -> Cube:
        """Make one whose cells lie in those of a regular grid, so that stiffnesses with kinks there are smooth in each.

        The first cells of that grid are divided: at z = 0 into three, at the sides into two.
        """
        cube = cls.__new__(cls)
        cube.cells, cube.size = cells + 2, size
        planes = np.arange(cells + 1) / cells
        side = np.unique([*planes, 0.3 / cells, 1 - 0.3 / cells])
        cube._mesh([size * side, size * side, size * np.unique([*planes, 0.12 / cells, 0.4 / cells])])
        return cube

    def _graded(self, cells: int, thinner: tuple[float, float]) -> list[FloatArray]:
        """Planes between the cells along each axis."""
        t = np.linspace(0, 1, cells + 1)
        up = np.expm1(t * np.log(thinner[0])) / (thinner[0] - 1)
        ends = np.expm1(np.minimum(t, 1 - t) * 2 * np.log(thinner[1])) / (thinner[1] - 1) / 2
        side = np.where(t <= 0.5, ends, 1 - ends)
        return [self.size * side, self.size * side, self.size * up]

    def _mesh(self, lines: list[FloatArray]) -> None:
        """Divide the cells between planes into tetrahedra."""
        cells, self.lines = self.cells, lines
        corner = np.array(list(product(range(cells), repeat=3)))
        self.tets = (corner[:, None, None] + KUHN).reshape(-1, 4, 3)  # corners in the grid
        bary = np.column_stack([DEGREE - POWERS.sum(axis=1), POWERS])
        lattice = np.einsum("av,evi->eai", bary, self.tets)
        side_nodes = DEGREE * cells + 1
        self.nodes = (lattice[..., 0] * side_nodes + lattice[..., 1]) * side_nodes + lattice[..., 2]
        self.count = side_nodes**3
        corners = np.stack([self.lines[i][self.tets[..., i]] for i in range(3)], axis=-1)
        edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
        self.volumes = np.abs(np.linalg.det(edges))
        self.inverse = np.linalg.inv(edges)
        self.at = corners[:, None, 0] + np.einsum("qr,eir->eqi", POINTS, edges)
        level = np.arange(self.count) % side_nodes
        self.free = np.flatnonzero(np.repeat(level > 0, 3))
        self.dofs = 3 * self.nodes[:, :, None] + np.arange(3)
        self.load = self._pressed(corners)
        self._pattern: tuple[NDArray[np.int64], ...] | None = None
        self._solver: Callable[[FloatArray], FloatArray] | None = None

    def _pressed(self, corners: FloatArray) -> FloatArray:
        """Integrals (nodes,) of the shape functions over z = L."""
        from scipy.special import roots_jacobi

        (a, wa), (b, wb) = (roots_jacobi(4, k, 0) for k in (0, 1))
        grid = np.stack(np.meshgrid((a + 1) / 2, (b + 1) / 2, indexing="ij"), axis=-1).reshape(-1, 2)
        w = np.einsum("i,j->ij", wa / 2, wb / 4).ravel()
        flat = np.column_stack([grid[:, 0] * (1 - grid[:, 1]), grid[:, 1]])
        found = np.zeros(self.count)
        reference = np.vstack([np.zeros(3), np.eye(3)])
        for face in ([0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]):
            on = np.flatnonzero((self.tets[:, face, 2] == self.cells).all(axis=1))
            p, q, r = reference[face]
            values = _monomials(p + flat[:, :1] * (q - p) + flat[:, 1:] * (r - p))[0] @ INVERSE
            one, two = (corners[on][:, face[k]] - corners[on][:, face[0]] for k in (1, 2))
            areas = np.linalg.norm(np.cross(one, two), axis=1)
            np.add.at(found, self.nodes[on], areas[:, None] * (w @ values))
        return found

    def _assembled(self, u: FloatArray, mu: float, lmbda: float, factor: FloatArray) -> tuple[FloatArray, csr_matrix]:
        """Forces (3 nodes,), and their derivatives by what is not held."""
        forces, blocks = np.zeros(3 * self.count), []
        eye = np.eye(3)
        for part in np.array_split(np.arange(len(self.tets)), -(-len(self.tets) // 150)):
            G = SLOPES @ self.inverse[part][:, None]  # (e, q, a, J)
            w = WEIGHTS * self.volumes[part][:, None] * factor[part]
            F = eye + np.einsum("eqaJ,eai->eqiJ", G, u[self.dofs[part]])
            J = np.linalg.det(F)
            if J.min() <= 0:
                raise ArithmeticError
            inverse = np.linalg.inv(F)
            turned = np.swapaxes(inverse, 2, 3)
            log = np.log(J)[..., None, None]
            P = w[..., None, None] * (mu * (F - turned) + lmbda * log * turned)
            np.add.at(forces, self.dofs[part], np.einsum("eqiJ,eqaJ->eai", P, G))
            A = mu * np.einsum("ik,JL->iJkL", eye, eye) + lmbda * np.einsum("eqiJ,eqkL->eqiJkL", turned, turned)
            A += (mu - lmbda * log)[..., None, None] * np.einsum("eqiL,eqkJ->eqiJkL", turned, turned)
            e, q, a, _ = G.shape
            left = G @ (w[..., None, None] * A.transpose(0, 1, 3, 2, 4, 5).reshape(e, q, 3, 27))  # a, (i k L)
            rows = left.reshape(e, q, a, 3, 3, 3).transpose(0, 2, 3, 4, 1, 5).reshape(e, a * 9, q * 3)
            K = (rows @ G.transpose(0, 1, 3, 2).reshape(e, q * 3, a)).reshape(e, a, 3, 3, a).transpose(0, 1, 2, 4, 3)
            blocks.append(K.reshape(e, 3 * a, 3 * a))
        return forces, self._matrix(np.concatenate(blocks).ravel())

    def _matrix(self, values: FloatArray) -> csr_matrix:
        """The sum of the matrices of all tetrahedra, without what is held."""
        from scipy.sparse import csr_matrix

        if self._pattern is None:
            number = np.full(3 * self.count, -1)
            number[self.free] = np.arange(len(self.free))
            each = number[self.dofs.reshape(len(self.tets), -1)]
            k = each.shape[1]
            rows, columns = np.repeat(each, k, axis=1).ravel(), np.tile(each, (1, k)).ravel()
            inside = np.flatnonzero((rows >= 0) & (columns >= 0))
            places, where = np.unique(rows[inside] * len(self.free) + columns[inside], return_inverse=True)
            starts = np.searchsorted(places, np.arange(len(self.free) + 1) * len(self.free))
            self._pattern = inside, where, places % len(self.free), starts
        inside, where, columns, starts = self._pattern
        found = np.bincount(where, values[inside], len(columns))
        return csr_matrix((found, columns, starts), shape=(len(self.free),) * 2)

    def solve(
        self,
        mu: float,
        lmbda: float,
        factor: Callable[[FloatArray], FloatArray],
        traction: FloatArray,
        guess: FloatArray | None = None,
        parts: int = 1,
    ) -> FloatArray:
        """Displacements (3 nodes,) under a traction (3,), in equal parts where that is needed.

        Parameters
        ----------
        mu, lmbda
            Lamé constants (Pa).
        factor
            On the energy, as a function of places (n, 3) → (n,).
        traction
            On z = L (Pa).
        guess
            Displacements to begin with.
        parts
            In which the traction is applied.
        """
        f = factor(self.at.reshape(-1, 3)).reshape(self.at.shape[:2])
        whole = (self.load[:, None] * traction).ravel()
        u = np.zeros(3 * self.count) if guess is None else guess.copy()
        try:
            for part in range(1, parts + 1):
                self._newton(u, mu, lmbda, f, whole * part / parts)
        except ArithmeticError:
            if parts > 16:
                raise
            return self.solve(mu, lmbda, factor, traction, None, 2 * parts)
        return u

    def _newton(self, u: FloatArray, mu: float, lmbda: float, f: FloatArray, load: FloatArray) -> None:
        size = float(np.linalg.norm(load[self.free]))
        for _ in range(25):
            forces, matrix = self._assembled(u, mu, lmbda, f)
            rest = (load - forces)[self.free]
            left = float(np.linalg.norm(rest)) / size
            if left < SETTLED:
                return
            if self._solver is None:
                self._solver = _factorised(matrix)
            u[self.free] += _gradients(matrix, rest, self._solver, min(0.1, max(left, 1e-4)) if left > 1e-5 else 1e-5)
        raise ArithmeticError

    def observed(self, u: FloatArray, points: FloatArray) -> FloatArray:
        """Displacements (n, 3) at points (n, 3)."""
        cell = np.empty(points.shape, dtype=int)
        inside = np.empty(points.shape)
        for i, lines in enumerate(self.lines):
            cell[:, i] = np.clip(np.searchsorted(lines, points[:, i], side="right") - 1, 0, self.cells - 1)
            inside[:, i] = (points[:, i] - lines[cell[:, i]]) / np.diff(lines)[cell[:, i]]
        which = np.array([ORDERS.index(tuple(order)) for order in np.argsort(-inside, axis=1, kind="stable")])
        ordered = -np.sort(-inside, axis=1)
        reference = ordered - np.column_stack([ordered[:, 1:], np.zeros(len(points))])
        tets = 6 * ((cell[:, 0] * self.cells + cell[:, 1]) * self.cells + cell[:, 2]) + which
        values = _monomials(reference)[0] @ INVERSE
        return np.asarray(np.einsum("na,nai->ni", values, u[self.dofs[tets]]))


def _factorised(matrix: csr_matrix) -> Callable[[FloatArray], FloatArray]:
    """Solve with a symmetric matrix."""
    from petsc4py import PETSc

    rows = (matrix.indptr.astype("int32"), matrix.indices.astype("int32"), matrix.data)
    A = PETSc.Mat().createAIJ(matrix.shape, csr=rows)
    ksp = PETSc.KSP().create(A.comm)
    ksp.setOperators(A)
    ksp.setType("preonly")
    ksp.getPC().setType("lu")
    ksp.getPC().setFactorSolverType("mumps")
    x, b = A.createVecs()

    def solve(rest: FloatArray) -> FloatArray:
        b.array[:] = rest
        ksp.solve(b, x)
        found: FloatArray = np.array(x.array, dtype=float)
        return found

    return solve


def _gradients(matrix: csr_matrix, b: FloatArray, solve: Callable[[FloatArray], FloatArray], left: float) -> FloatArray:
    """Conjugate gradients with a preconditioner, until a share of the right-hand side is left."""
    x, r = np.zeros_like(b), b.copy()
    z = solve(r)
    p, rz = z.copy(), float(r @ z)
    first = rz
    for _ in range(200):
        q = matrix @ p
        step = rz / float(p @ q)
        if step <= 0:
            raise ArithmeticError
        x += step * p
        r -= step * q
        z = solve(r)
        rz, last = float(r @ z), rz
        if rz < left**2 * first:
            break
        p = z + rz / last * p
    return x


def main() -> None:
    """Write displacements for configs/inclusion.toml: 120 random points of four faces, three load cases."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.other_code", description=main.__doc__)
    parser.add_argument("file", type=Path)
    parser.add_argument("--noise", type=float, default=0.03, help="of the root mean square of each load case")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cells", type=int, default=6)
    given = parser.parse_args()
    size, rng = 0.05, np.random.default_rng(given.seed)
    truth = {"x": 0.0273, "y": 0.0221, "z": 0.0311, "radius": 0.0115, "contrast": 4.0}
    centre = np.array([truth["x"], truth["y"], truth["z"]])

    def factor(places: FloatArray) -> FloatArray:
        inside = (1 - np.tanh((np.linalg.norm(places - centre, axis=1) - truth["radius"]) / 6e-3)) / 2
        return np.asarray(truth["contrast"] ** inside)

    points = rng.uniform(0.02, 0.98, (120, 3)) * size
    for number, (axis, end) in enumerate(((0, 0.0), (0, size), (1, size), (2, size))):
        points[number::4, axis] = end
    cube = Cube(given.cells, size)
    lines = [f"# truth.inclusions.lump.{name} = {value}" for name, value in truth.items()]
    lines.append("x,y,z,ux,uy,uz,sigma,case")
    acting = {"shear": (150.0, 0.0, 0.0), "compression": (0.0, 0.0, -200.0), "extension": (0.0, 0.0, 200.0)}
    for case, traction in acting.items():
        moved = cube.observed(cube.solve(1e3, 4e3, factor, np.array(traction)), points)
        sigma = given.noise * float(np.sqrt((moved**2).mean()))
        moved += sigma * rng.standard_normal(moved.shape)
        for point, u in zip(points, moved, strict=True):
            lines.append(",".join([*(f"{value:.9g}" for value in (*point, *u, sigma)), case]))
    given.file.parent.mkdir(parents=True, exist_ok=True)
    given.file.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
