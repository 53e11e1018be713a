"""The evidence by nested sampling, which shares only the likelihood with the other routes.

J. Skilling, Bayesian Anal. 1 (2006) 833–860; by dynesty: J. S. Speagle, Mon. Not. R. Astron. Soc. 493 (2020)
3132–3158. It takes ten thousand solves or more, so it is for very cheap models.
"""

from __future__ import annotations

import numpy as np

from forward.model import FloatArray
from inverse.low_dimensional.posterior import Posterior

LIVE = 400
NOTHING = -1e300  # ln p(y | x) where the model has no answer


def nested(posterior: Posterior, *, seed: int = 0, live: int = LIVE) -> tuple[float, float]:
    """Return ln Z and its standard error by nested sampling with `live` live points.

    Raises
    ------
    ImportError
        If dynesty is not installed.
    """
    try:
        import dynesty
    except ImportError:
        message = "method.check = 'dynesty' needs dynesty, which is not installed: pip install dynesty"
        raise ImportError(message) from None
    from scipy.special import ndtri

    def log_likelihood(x: FloatArray) -> float:
        return max(float(posterior.at(x[None, :]).log_likelihood[0]), NOTHING)

    sampler = dynesty.NestedSampler(
        log_likelihood,
        lambda u: ndtri(np.clip(u, 1e-15, 1 - 1e-15)),
        len(posterior.names),
        nlive=live,
        rstate=np.random.default_rng(seed),
    )
    sampler.run_nested(print_progress=False, dlogz=0.01)
    return float(sampler.results.logz[-1]), float(sampler.results.logzerr[-1])
