"""How many independent draws the draws of chains are worth."""

from __future__ import annotations

import numpy as np

from forward.model import FloatArray


def effective(values: FloatArray, chains: FloatArray | None = None) -> float:
    """Return the number of independent draws that draws (N,) of chains (N,) are worth for their mean.

    N/(1 + 2 Σ ρ_t), summed over pairs of autocorrelations as long as these are positive and no larger than before
    (C. J. Geyer, Stat. Sci. 7 (1992) 473–483). Without chains the draws are those of one, in their order.
    """
    parts = [values] if chains is None else [values[chains == one] for one in np.unique(chains)]
    worth = 0.0
    for part in parts:
        n = len(part)
        deviations = part - values.mean()
        power = np.abs(np.fft.rfft(deviations, 2 * n)) ** 2
        products = np.fft.irfft(power)[:n] / n
        if products[0] <= 0:
            worth += 1.0
            continue
        rho = products / products[0]
        if abs(rho[1]) < 2 / np.sqrt(n):  # as of independent draws
            worth += n
            continue
        pairs = rho[: n - n % 2].reshape(-1, 2).sum(axis=1)
        ends = np.flatnonzero(pairs <= 0)
        pairs = np.minimum.accumulate(pairs[: ends[0] if ends.size else None])
        worth += n / max(2 * pairs.sum() - 1, 1 / np.log10(max(n, 10)))
    return float(min(worth, len(values)))
