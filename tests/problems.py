"""Problems of which several tests know the answer: posteriors of fields and of few parameters."""

from types import SimpleNamespace

import numpy as np

from forward.model import SolveError
from forward.pointwise import FunctionModel
from inverse.criticism.assessment import quantiles
from inverse.criticism.verdict import examine, spectrum_of
from inverse.data.noise import Noise
from inverse.fields.field_posterior import FieldPosterior
from inverse.fields.low_rank import LowRankPosterior
from inverse.fields.newton_cg import find_mode
from inverse.low_dimensional.posterior import Posterior
from uq.evaluation.evaluate import SerialEvaluate
from uq.inputs.distributions import Normal, Uniform
from uq.inputs.random_parameters import Inputs

N, DATA = 90, 60
G = np.random.default_rng(5).standard_normal((30, 3))
PLACES = np.random.default_rng(6).uniform(size=(30, 3))
FOUR = ("a", "b", "c", "d")
TRUTH = np.array([1.4, 0.8, 1.1, 1.3])


class DensePrior:
    """N(0, LLᵀ) of a matrix L."""

    def __init__(self, root):
        self.matrix = root
        self.variance = (root**2).sum(axis=1)

    def root(self, noise):
        return noise @ self.matrix.T

    def root_transposed(self, g):
        return g @ self.matrix


class Linear:
    """y = Gm + e with all that is known of it; the λ fall from 10⁴ to 10⁻⁴."""

    def __init__(self, seed=0, data=DATA, holes=0):
        rng = np.random.default_rng(seed)
        x = np.linspace(0, 1, N)
        self.prior_covariance = 0.49 * np.exp(-np.abs(x[:, None] - x) / 0.3)
        root = np.linalg.cholesky(self.prior_covariance)
        self.sigma = rng.uniform(0.5, 2, data)
        left, _ = np.linalg.qr(rng.standard_normal((data, data)))
        right, _ = np.linalg.qr(rng.standard_normal((N, data)))
        A = (left * np.logspace(2, -2, data)) @ right.T
        self.G = self.sigma[:, None] * A @ np.linalg.inv(root)
        self.m_0 = rng.standard_normal(N)
        truth = self.m_0 + root @ rng.standard_normal(N)
        self.data = self.G @ truth + self.sigma * rng.standard_normal(data)
        self.data[:holes] = np.nan
        names, outputs = tuple(f"m{i}" for i in range(N)), tuple(f"y{i}" for i in range(data))
        model = FunctionModel(lambda m: self.G @ m, names, outputs, lambda m: self.G)
        self.posterior = FieldPosterior(model, self.data, Noise(self.sigma), DensePrior(root), self.m_0)
        seen = np.isfinite(self.data)
        self.seen = seen
        K = self.G[seen]
        self.scatter = K @ self.prior_covariance @ K.T + np.diag(self.sigma[seen] ** 2)  # of the data
        gain = self.prior_covariance @ K.T @ np.linalg.inv(self.scatter)
        self.mean = self.m_0 + gain @ (self.data[seen] - K @ self.m_0)
        self.covariance = self.prior_covariance - gain @ K @ self.prior_covariance
        self.values = np.linalg.eigvalsh((K @ root / self.sigma[seen, None]).T @ (K @ root / self.sigma[seen, None]))[
            ::-1
        ]


def solved(problem, **settings):
    mode = find_mode(problem.posterior, tolerance=1e-9)
    return mode, LowRankPosterior.at(mode.point, **settings)


def curved(limit=np.inf):
    rng = np.random.default_rng(3)
    B = rng.standard_normal((25, 12)) / 3

    def function(m):
        if np.abs(m).max() > limit:
            raise SolveError("too far")
        return np.exp(B @ m)

    model = FunctionModel(
        function, tuple(map(str, range(12))), tuple(map(str, range(25))), lambda m: np.exp(B @ m)[:, None] * B
    )
    truth = rng.standard_normal(12)
    root = np.tril(rng.uniform(0, 0.4, (12, 12))) + np.eye(12)
    sigma = np.full(25, 0.05)
    data = np.exp(B @ truth) + sigma * rng.standard_normal(25)
    return FieldPosterior(model, data, Noise(sigma), DensePrior(root))


def examine_few(posterior, gaussian, neighbours=None):
    """Test the residuals of few parameters at the mode: a solve with derivatives."""
    at = posterior.at(gaussian.mode[None], derivatives=True)
    residual = posterior.noise.normal_scores(posterior.residuals(at.outputs, at.x)[0])
    return examine(residual, spectrum_of(posterior, at), neighbours)


def few(seed=0, wave=0.0, noise=None):
    """A linear model of three parameters, with data that a wave through all places may have been added to."""
    rng = np.random.default_rng(seed)
    names = ("a", "b", "c")
    model = FunctionModel(lambda p: G @ p, names, tuple(f"y{i}" for i in range(30)), lambda p: G)
    data = G @ rng.standard_normal(3) + 0.5 * rng.standard_normal(30) + wave * np.sin(8 * PLACES[:, 0])
    inputs = Inputs({name: Normal(mean=0.0, std=1.0) for name in names})
    return Posterior(inputs, SerialEvaluate(model), data, Noise(np.full(30, 0.5), factor=noise))


def two_of_four(points):
    a, b, c, d = np.moveaxis(np.asarray(points), -1, 0)
    return np.stack([a * b + 0.3 * c, a * c**2 + 0.5 * d * b], axis=-1)


def slopes_of_four(point):
    a, b, c, d = point
    return [[b, a, 0.3, 0.0], [c**2, 0.5 * d, 2 * a * c, 0.5 * b]]


def ridge(noise):
    """Four parameters and two observations, which leave a two_of_four ridge."""
    inputs = Inputs({name: Uniform(lower=0.5, upper=2.0) for name in FOUR})
    y = two_of_four(TRUTH)
    model = FunctionModel(two_of_four, FOUR, ("u", "v"), slopes_of_four)
    return Posterior(inputs, SerialEvaluate(model), y, Noise(noise * y))


def bananas(pairs, bend=0.7, seed=0, wide=100.0):
    """2 `pairs` unknowns whose posterior is curved and known: a model, its posterior, mean (d,), std (d,) and ln Z.

    With data zero of z = (a, b + bend (a² − 1), ...), all errors 1, priors that are `wide`, and a, b rotated unknowns:
    the map to z has the Jacobian one, so that z is normal, b has mean 0 and the variance 1 + 2 bend², and Z is the
    density of the prior.
    """
    rng = np.random.default_rng(seed)
    d = 2 * pairs
    Q, centre = np.linalg.qr(rng.normal(size=(d, d)))[0], rng.normal(size=d)

    def values(w):
        u = Q.T @ (w - centre)
        z = u.copy()
        z[1::2] += bend * (u[::2] ** 2 - 1)
        return z

    def slopes(w):
        J = np.eye(d)
        J[np.arange(1, d, 2), np.arange(0, d, 2)] = 2 * bend * (Q.T @ (w - centre))[::2]
        return J @ Q.T

    names = tuple(f"x{k}" for k in range(d))
    model = FunctionModel(values, names, tuple(f"z{k}" for k in range(d)), slopes)
    covariance = Q @ np.diag(np.tile([1.0, 1 + 2 * bend**2], pairs)) @ Q.T
    log_evidence = -d / 2 * np.log(2 * np.pi * wide**2) - ((centre**2).sum() + np.trace(covariance)) / 2 / wide**2
    inputs = Inputs({name: Normal(mean=0.0, std=wide) for name in names})
    posterior = Posterior(inputs, SerialEvaluate(model), np.zeros(d), Noise(np.ones(d)))
    return model, posterior, centre, np.sqrt(np.diag(covariance)), log_evidence


def summary(values, weights=None):
    """Mean, standard deviation and quantiles of values (n, k) at points with weights (n,), by default equal ones."""
    w = np.full(len(values), 1 / len(values)) if weights is None else weights
    values, w = values[w > 0], w[w > 0]
    mean = w @ values
    bands = np.array([quantiles(column, w, (0.025, 0.5, 0.975)) for column in values.T]).T
    return SimpleNamespace(mean=mean, std=np.sqrt(w @ (values - mean) ** 2), quantiles=bands)
