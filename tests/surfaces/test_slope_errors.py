"""Errors of slopes: windows that overlap share data, so a fit to neighbours takes part of their common errors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from polysight.surfaces import Echoes
from polysight.surfaces.measure import smooth_bends
from polysight.surfaces.paths import STRIDE_M
from polysight.surfaces.window import WINDOW_M, no_echoes

SLOPE_STD = (0.004, 0.002)
SIDE = 60
PLANE = np.zeros((2, 2))
BENT = np.array([[1.2, 0.2], [0.2, 0.4]])


def draw_ripple(rng: np.random.Generator) -> np.ndarray:
    """Normal errors [SIDE, SIDE] that windows share as far as they overlap, with a variance of 1."""
    steps = np.arange(SIDE)
    apart = np.abs(steps[:, None] - steps) * STRIDE_M / WINDOW_M
    factor = np.linalg.cholesky(np.maximum(0, 1 - apart) + 1e-9 * np.eye(SIDE))
    return factor @ rng.standard_normal((SIDE, SIDE)) @ factor.T


def draw_noise(rng: np.random.Generator, axis: int) -> np.ndarray:
    """Errors [SIDE, SIDE] of the slope along an axis by noise of positions 2 mm apart, with a variance of 1."""
    samples = round(WINDOW_M / 0.002)
    every = round(STRIDE_M / 0.002)
    white = rng.standard_normal((SIDE * every + samples,) * 2)
    patches = np.lib.stride_tricks.sliding_window_view(white, (samples, samples))[::every, ::every][:SIDE, :SIDE]
    ramp = np.arange(samples) - (samples - 1) / 2
    sums = np.tensordot(patches.sum(axis=3 - axis), ramp, 1)
    return sums / np.sqrt(samples * np.sum(ramp**2))


def make_echoes(bend: np.ndarray, errors: np.ndarray, slope_std: tuple[float, float]) -> Echoes:
    """Echoes of a path with a curvature and errors [2, SIDE, SIDE] of its slopes, of which windows know `slope_std`."""
    x, y = np.meshgrid(np.arange(SIDE) * STRIDE_M, np.arange(SIDE) * STRIDE_M)
    at_m = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    count = len(at_m)
    return replace(
        no_echoes(),
        at_m=at_m,
        path_m=np.zeros(count),
        slope=at_m[:, :2] @ bend + np.array(SLOPE_STD) * errors.reshape(2, -1).T,
        bend=np.tile(bend, (count, 1, 1)),
        slope_std=np.tile(slope_std, (count, 1)),
    )


def estimate_slope_std(echoes: Echoes) -> np.ndarray:
    smooth = smooth_bends(echoes, np.zeros(len(echoes), int))
    return np.sqrt(np.mean(smooth.slope_std**2, axis=0))


@pytest.mark.parametrize("bend", [PLANE, BENT], ids=["plane", "bent"])
def test_ripple_is_estimated_though_overlapping_windows_share_it(bend):
    rng = np.random.default_rng(7)
    ripple = np.stack([draw_ripple(rng), draw_ripple(rng)])
    estimated = estimate_slope_std(make_echoes(bend, ripple, (1e-9, 1e-9)))
    assert estimated == pytest.approx(SLOPE_STD, rel=0.07)


@pytest.mark.parametrize("bend", [PLANE, BENT], ids=["plane", "bent"])
def test_noise_that_windows_know_of_is_no_ripple(bend):
    rng = np.random.default_rng(7)
    noise = np.stack([draw_noise(rng, 0), draw_noise(rng, 1)])
    wider = estimate_slope_std(make_echoes(bend, noise, SLOPE_STD)) / SLOPE_STD
    # Its variance scatters about zero, and only what lies above counts.
    assert np.all((wider >= 1) & (wider < 1.35))
