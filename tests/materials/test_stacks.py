"""Plates that are not half spaces do not change the estimated errors of the rig, for example liquids behind glass."""

import numpy as np
from tests.support.rigs import load_published_rig

from polysight.materials.inversion import RigPrior, invert
from polysight.materials.kinds import Kinds, PatchMeasurement, list_literature_kinds
from polysight.materials.layers import Layer, Spectrum, predict

THETA_RAD = np.radians(55.0)
LEAKAGE = (0.045 + 0.001j, 0.047 - 0.005j)
GLASS = Layer("glass", 5.5 - 0.05j, 3e-3)
SCATTER = ((0.013, 0.02), (0.016, 0.044), (0.019, 0.038))
# V / H and |H| of cups of 45 mm in a simulated scan of few steps, where edges and sidelobes add some per cent
MEASURED = ((-0.213 + 0.39j, 0.308), (-0.429 + 0.464j, 0.253), (-0.314 + 0.416j, 0.278))


def test_cups_behind_glass_keep_their_ratio_and_the_measured_leakage():
    spectrum = Spectrum.from_chirp(load_published_rig().chirp)
    true = []
    for share in (0.2, 0.0, 0.1):
        liquid = Layer("liquid", 9.37 - 5 * share - 1j * (18 - 20 * share))
        ratios, _ = predict([GLASS, liquid], spectrum, THETA_RAD)
        true.append(complex(ratios[0]))
    measurements = [
        PatchMeasurement(ratio, 0.0015, THETA_RAD, brightness, relative_std=scatter)
        for (ratio, brightness), scatter in zip(MEASURED, SCATTER, strict=True)
    ]
    prior = RigPrior(0.003, leakage=LEAKAGE, leakage_std=0.003, leakage_measured=True, channels_known=True, moved=0.1)
    inversion = invert(measurements, prior, Kinds(list_literature_kinds(), THETA_RAD, with_sheets=True))
    assert np.abs(np.array(inversion.leakage) - LEAKAGE).max() < 0.02
    for t, patch in zip(true, inversion.patches, strict=True):
        assert abs(patch.inverse_ratio - t) < 0.12 * abs(t)
