"""Sequential Monte Carlo with tempering: particles that are moved from one posterior to another by small steps.

After each step that leaves half of their weight effective the particles are drawn anew in proportion to their weights,
and moved by Metropolis' rule (Del Moral, Doucet and Jasra, J. R. Stat. Soc. B 68, 2006).
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

Real = npt.NDArray[np.float64]

# Moves at each temperature.
MOVES = 6


class Likelihood(Protocol):
    """Log likelihoods of particles."""

    width: int

    def log_likelihoods(self, z: Real) -> Real:
        """Return the log likelihoods [..., part] of particles z [..., width]."""
        ...


def anneal(model: Likelihood, z: Real, before: Real, after: Real, rng: np.random.Generator) -> tuple[Real, float]:
    """Move particles of one posterior to another.

    Parameters
    ----------
    model
        Likelihood of particles whose prior is standard normal.
    z
        float64 [particle, width]: particles of the first posterior.
    before, after
        float64 [part]: weights of the log likelihoods in the first posterior and in the last.
    rng
        Random numbers.

    Returns
    -------
    particles
        float64 [particle, width] of the last posterior.
    log_ratio
        Logarithm of the ratio of both evidences.
    """
    parts = model.log_likelihoods(z)
    change = after - before
    done = 0.0
    log_evidence = 0.0
    while done < 1:
        gain = parts @ change
        step = _choose_step(gain, 1 - done)
        done = 1.0 if step >= 1 - done else done + step
        weight = before + done * change
        log_evidence += step * float(gain.max()) + float(np.log(np.mean(np.exp(step * (gain - gain.max())))))
        chosen = resample(np.exp(step * (gain - gain.max())), rng)
        z = z[chosen]
        parts = parts[chosen]
        # Random walk of the usual size in so many dimensions, shaped as the particles lie.
        spread = np.linalg.cholesky(np.cov(z.T) + 1e-9 * np.eye(model.width)) * 2.0 / np.sqrt(model.width)
        for _ in range(MOVES):
            proposed = z + rng.standard_normal(z.shape) @ spread.T
            parts_proposed = model.log_likelihoods(proposed)
            log_odds = (parts_proposed - parts) @ weight - 0.5 * np.sum(proposed**2 - z**2, axis=1)
            accepted = (np.log(rng.random(len(z))) < log_odds)[:, None]
            z = np.where(accepted, proposed, z)
            parts = np.where(accepted, parts_proposed, parts)
    return z, log_evidence


def _choose_step(gain: Real, most: float) -> float:
    """Return the largest step of the temperature that leaves half of the particles' weight effective."""

    def effective_share(step: float) -> float:
        weight = np.exp(step * (gain - gain.max()))
        return float(weight.sum() ** 2 / np.sum(weight**2)) / gain.size

    if effective_share(most) >= 0.5:
        return most
    low = 0.0
    high = most
    for _ in range(30):
        middle = (low + high) / 2
        if effective_share(middle) >= 0.5:
            low = middle
        else:
            high = middle
    return max(low, 1e-6)


def resample(weight: Real, rng: np.random.Generator) -> npt.NDArray[np.intp]:
    """Return indices of particles in proportion to their weights (systematic resampling)."""
    places = (rng.random() + np.arange(weight.size)) / weight.size
    return np.minimum(np.searchsorted(np.cumsum(weight) / weight.sum(), places), weight.size - 1)
