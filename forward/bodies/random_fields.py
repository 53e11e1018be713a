"""Log-normal random fields over a body: their specification, and the Gaussian Matérn field behind them.

The Gaussian field m solves (κ² − Δ)^{α/2} m = white noise on the vertices of the mesh, which makes it a Matérn field of
smoothness ν = α − 3/2 in unbounded space: F. Lindgren, H. Rue, J. Lindström, J. R. Stat. Soc. B 73 (2011) 423–498. On a
body its variance depends on position (near faces, and above all in thin bodies), so the field is divided by its
computed pointwise standard deviation. The boundary then only affects the correlation.

Vertices are in canonical order (`forward.fem.layout`). Nothing here depends on the number of ranks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np
from annotated_types import Gt
from pydantic import Field, model_validator

from forward.bodies.geometry import Body, Count, Length
from forward.bodies.selected_inverse import Dissection
from forward.findings import Finding
from forward.model import FloatArray
from forward.readable import told
from forward.settings import Settings

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

PositiveFloat = Annotated[float, Gt(0)]
Smoothness = Literal[2, 4]
ROBIN = 1 / 1.42  # coefficient over κ: Y. Daon, G. Stadler, Inverse Probl. Imaging 12 (2018) 1083–1102
EQUAL = 1e-6  # relative distance of eigenvalues below which rounding determines their eigenvectors


class RandomField(Settings):
    """A log-normal random factor over the body, on its stiffness or on its density.

    The factor is exp(ln mean − v/2 + m) with a Gaussian Matérn field m of variance v at the vertices, and the
    exponential of what is linear between them: at the vertices its expected value is `mean` (also with few modes,
    where v is that of the modes). Its coefficients are d independent standard normal parameters, ``fields.NAME.0`` and
    so on, which every study of this model has implicitly.

    Parameters
    ----------
    of
        What is multiplied: the energy density, or the density of the body under gravity.
    name
        Used in parameter paths; by default the quantity that it multiplies.
    length
        Correlation length (m): the distance at which the correlation has fallen to about 0.14.
    std
        Point standard deviation of the factor.
    mean
        Expected value of the factor.
    smoothness
        α of the operator: 2 (correlation exp(−2r/length), continuous realisations) or 4 (smooth ones, ν = 5/2).
    basis
        "modes": the leading Karhunen–Loève modes. "noise": white noise at every vertex, without truncation.
        "nodes": the values of m at the vertices are the parameters, for inversion; they are correlated, so other
        studies cannot use them.
    modes
        Number of modes; only for "modes".
    """

    of: Literal["stiffness", "density"]
    name: str = Field(default="", pattern=r"^[^.\s]*$")
    length: Length
    std: PositiveFloat
    mean: PositiveFloat = 1.0
    smoothness: Smoothness = 2
    basis: Literal["modes", "noise", "nodes"] = "modes"
    modes: Count | None = None

    @property
    def label(self) -> str:
        """The name in parameter paths."""
        return self.name or self.of

    @property
    def log_std(self) -> float:
        """Point standard deviation of the logarithm."""
        return float(np.sqrt(np.log1p((self.std / self.mean) ** 2)))

    def paths(self, body: Body) -> tuple[str, ...]:
        """Paths of the coefficients on a body."""
        count = self.modes if self.basis == "modes" else body.vertex_count
        return tuple(f"fields.{self.label}.{i}" for i in range(count or 0))

    @model_validator(mode="after")
    def _check_modes(self) -> RandomField:
        if (self.basis == "modes") != (self.modes is not None):
            wanted = "a number of modes" if self.basis == "modes" else "no modes"
            raise ValueError(f"basis = '{self.basis}', expected {wanted}")
        return self

    def findings(self, body: Body) -> Iterator[Finding]:
        """Say where the mesh is too coarse for it."""
        if self.length < body.longest_edge:
            length, cell = told(self.length, "m"), told(body.longest_edge, "m", 3)
            yield Finding("field-short", "warning", {"label": self.label, "length": length, "cell": cell})

    def prior(self, body: Body) -> NodalPrior:
        """Return the distribution of the values at the vertices of a body: the parameters of `basis` "nodes"."""
        return NodalPrior(Matern.on(body, self.length, self.smoothness), self.log_std)

    def on(self, body: Body) -> Expansion:
        """Expand the field on the vertices of a body, in this process."""
        offset = np.full(body.vertex_count, np.log(self.mean) - self.log_std**2 / 2)
        if self.basis == "nodes":
            return Expansion(offset, lambda values: values, lambda slopes: slopes)
        prior = self.prior(body)
        if self.basis == "noise":
            return Expansion(offset, prior.root, prior.root_transposed)
        mass, modes = prior.matern.mass, self.log_std * prior.matern.modes(self.modes or 0)
        kept = (mass @ modes**2).sum() / (self.log_std**2 * mass.sum())
        offset = np.log(self.mean) - (modes**2).sum(axis=1) / 2
        return Expansion(offset, lambda c: modes @ c, lambda slopes: slopes @ modes, float(kept), modes)


class Expansion(NamedTuple):
    """The logarithm of a factor at the N vertices, as an affine function of k coefficients.

    Attributes
    ----------
    offset
        Its values (N,) where all coefficients are zero.
    values
        Returns the linear part (N,) at coefficients (k,).
    vjp
        Returns derivatives (k,) by the coefficients from those (N,) by vertex values.
    kept
        Fraction of the variance of the field, averaged over the body, that the coefficients represent.
    modes
        Scaled Karhunen–Loève modes (N, k) of which it consists; None if it is none of these.
    """

    offset: FloatArray
    values: Callable[[FloatArray], FloatArray]
    vjp: Callable[[FloatArray], FloatArray]
    kept: float = 1.0
    modes: FloatArray | None = None


@dataclass(frozen=True)
class NodalPrior:
    """The normal distribution N(0, std² C) of values at the N vertices, with C a Matérn covariance.

    Rows are vectors. The root is that of `Matern`, so that no covariance is ever formed.
    """

    matern: Matern
    std: float

    @property
    def variance(self) -> FloatArray:
        """Variance (N,) at the vertices."""
        return np.full(len(self.matern.mass), self.std**2)

    def root(self, whitened: FloatArray) -> FloatArray:
        """Return the field (N,) of independent standard normal numbers (N,), or (k, N) for k of them."""
        return self.std * self.matern.root(whitened.T).T

    def root_transposed(self, g: FloatArray) -> FloatArray:
        """Apply the transpose of `root` to (N,) or (k, N)."""
        return self.std * self.matern.root_transposed(g.T).T


class Matern:
    """A Gaussian field on the vertices of a mesh, of variance one at every vertex.

    With A = κ²M + K + βB, the covariance of the solution of the SPDE is A⁻¹MA⁻¹ for α = 2, and A⁻¹MA⁻¹MA⁻¹MA⁻¹ for
    α = 4; B acts on the boundary, where ∂m/∂n + βm = 0. (With a lumped M, checkerboard modes of trilinear elements,
    which K hardly sees, would have far too much variance.)

    Parameters
    ----------
    mass, laplacian, surface
        M, K and B (N, N), of trilinear elements.
    places
        The vertices (N, 3).
    length
        Correlation length √(8ν)/κ (m).
    smoothness
        α.
    robin
        β/κ; zero is the Neumann condition.

    Attributes
    ----------
    mass
        Volume (m³) of each vertex (N,): the sums of the rows of M.
    """

    def __init__(
        self,
        mass: csr_matrix,
        laplacian: csr_matrix,
        surface: csr_matrix,
        places: FloatArray,
        length: float,
        smoothness: Smoothness = 2,
        robin: float = ROBIN,
    ) -> None:
        self._smoothness = smoothness
        kappa = inverse_length(length, smoothness)
        self._matrix, self._places = mass, places
        self.mass = np.asarray(mass.sum(axis=1)).ravel()
        self._operator = (kappa**2 * mass + laplacian + robin * kappa * surface).tocsr()
        self._factor = _factorise(self._operator)

    @classmethod
    def on(cls, body: Body, length: float, smoothness: Smoothness = 2, robin: float = ROBIN) -> Matern:
        """Return the field on the mesh of a body, computed in this process alone."""
        from forward.fem.layout import vertex_matrices

        return cls(*vertex_matrices(body), length, smoothness, robin)

    @cached_property
    def _white(self) -> csr_matrix:
        """G (N, N) with GGᵀ = M, which turns independent numbers into white noise."""
        from scipy.sparse import diags

        # M = PᵀLUP with U = DLᵀ, since pivots stay on the diagonal.
        factor = _factorise(self._matrix)
        return (factor.L @ diags(np.sqrt(factor.U.diagonal()))).tocsr()[factor.perm_r]

    def _smooth(self, x: FloatArray) -> FloatArray:
        """Apply the symmetric operator A⁻¹, or A⁻¹MA⁻¹ for α = 4."""
        x = self._factor.solve(x)
        return np.asarray(self._factor.solve(self._matrix @ x) if self._smoothness == 4 else x)

    @cached_property
    def raw_std(self) -> FloatArray:
        """Point standard deviation (N,) of the solution of the SPDE, exact to rounding.

        (A + tM)⁻¹ = A⁻¹ − t A⁻¹MA⁻¹ + …, so that the variances are coefficients of its diagonal, with the other sign.
        """
        order = self._smoothness - 1
        variance = -Dissection(self._matrix, self._places).diagonal_of_inverse(self._operator, self._matrix, order)
        return np.sqrt(variance)

    def root(self, whitened: FloatArray) -> FloatArray:
        """Return the field (N,) of independent standard normal numbers (N,), or (N, k) for k of them."""
        return np.asarray((self._smooth(self._white @ whitened).T / self.raw_std).T)

    def root_transposed(self, g: FloatArray) -> FloatArray:
        """Apply the transpose of `root` to (N,) or (N, k)."""
        return np.asarray(self._white.T @ self._smooth((g.T / self.raw_std).T))

    def covariance(self, g: FloatArray) -> FloatArray:
        """Multiply the covariance (N, N) with (N,) or (N, k)."""
        return np.asarray((self._smooth(self._matrix @ self._smooth((g.T / self.raw_std).T)).T / self.raw_std).T)

    def modes(self, count: int) -> FloatArray:
        """Return the leading Karhunen–Loève modes (N, count), each times the square root of its eigenvalue.

        Eigenfunctions are orthogonal over the body (with the lumped mass); their signs, and the choice within the space
        of one eigenvalue, follow conventions that rounding does not affect. The sum of the eigenvalues is the volume.
        """
        n, root = len(self.mass), np.sqrt(self.mass)
        more = min(count + 8, n)  # eigenvalues that truncation would separate from equal ones
        if more > n // 2:
            values, vectors = np.linalg.eigh(self._symmetric(np.eye(n)))
        else:
            from scipy.sparse.linalg import LinearOperator, eigsh

            multiply: Any = LinearOperator((n, n), matvec=self._symmetric, dtype=float)
            values, vectors = eigsh(multiply, more, which="LA", v0=np.random.default_rng(0).standard_normal(n))
        order = np.argsort(-values)[:more]
        values, vectors = np.maximum(values[order], 0), vectors[:, order]
        functions = _settled(values, (vectors.T / root).T, self.mass)
        return np.asarray(functions[:, :count] * np.sqrt(values[:count]))

    def _symmetric(self, x: FloatArray) -> FloatArray:
        """Multiply with L^{1/2} C L^{1/2}."""
        root = np.sqrt(self.mass)
        return np.asarray((root * self.covariance((root * x.T).T).T).T)


def _settled(values: FloatArray, functions: FloatArray, mass: FloatArray) -> FloatArray:
    """Settle signs of eigenfunctions (N, k), and turn those of equal eigenvalues so that a fixed weight is diagonal."""
    n = len(mass)
    weight = mass * np.cos(np.arange(n) ** 2 / n)  # resembles no symmetry of a body
    settled = np.empty_like(functions)
    first = 0
    for last in range(1, len(values) + 1):
        if last < len(values) and values[last - 1] - values[last] <= EQUAL * values[0]:
            continue
        cluster = functions[:, first:last]
        if last - first > 1:
            _, turn = np.linalg.eigh(cluster.T @ (weight[:, None] * cluster))
            cluster = cluster @ turn
        settled[:, first:last] = cluster
        first = last
    large = np.abs(settled) >= 0.5 * np.abs(settled).max(axis=0)
    signs = np.sign(settled[large.argmax(axis=0), np.arange(len(values))])
    return np.asarray(settled * signs)


def _factorise(matrix: csr_matrix) -> Any:
    """Factorise a symmetric positive definite matrix, with its pivots on the diagonal."""
    from scipy.sparse.linalg import splu

    return splu(matrix.tocsc(), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def inverse_length(length: float, smoothness: Smoothness) -> float:
    """κ = √(8ν)/length (1/m), with ν = α − 3/2."""
    return float(np.sqrt(8 * (smoothness - 1.5)) / length)
