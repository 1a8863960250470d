"""Plates that are not half spaces do not change the estimated errors of the rig, for example liquids behind glass."""

import numpy as np
from tests.support.rigs import load_published_rig

from polysight.materials.inversion import RigPrior, invert
from polysight.materials.kinds import Kinds, PatchMeasurement, list_literature_kinds
from polysight.materials.layers import Layer, Spectrum, predict

THETA_RAD = np.radians(55.0)
# Leakage of p into H and of s into V, measured well; scatter of ln |V / H| and of its phase over each cup.
LEAKAGE = (0.045 + 0.001j, 0.047 - 0.005j)
GLASS = Layer("glass", 5.5 - 0.05j, 3e-3)
SCATTER = ((0.013, 0.02), (0.016, 0.044), (0.019, 0.038))
# V / H and |H| of cups of 45 mm in a simulated scan of few steps, where edges and sidelobes add some per cent.
MEASURED = ((-0.213 + 0.39j, 0.308), (-0.429 + 0.464j, 0.253), (-0.314 + 0.416j, 0.278))


def test_liquids_behind_glass_change_neither_the_measured_leakage_nor_their_own_ratios():
    spectrum = Spectrum.from_chirp(load_published_rig().chirp)
    true_ratios = []
    # Water with a fifth, nothing and a tenth of another liquid
    for share in (0.2, 0.0, 0.1):
        liquid = Layer("liquid", 9.37 - 5 * share - 1j * (18 - 20 * share))
        ratios, _ = predict([GLASS, liquid], spectrum, THETA_RAD)
        true_ratios.append(complex(ratios[0]))
    measurements = [
        PatchMeasurement(ratio, std=0.0015, theta_rad=THETA_RAD, brightness=brightness, relative_std=scatter)
        for (ratio, brightness), scatter in zip(MEASURED, SCATTER, strict=True)
    ]
    prior = RigPrior(
        theta_std_rad=0.003,
        leakage=LEAKAGE,
        leakage_std=0.003,
        leakage_measured=True,
        channels_known=True,
        moved=0.1,
    )
    inversion = invert(measurements, prior, Kinds(list_literature_kinds(), THETA_RAD, with_sheets=True))
    # The leakage is found to 0.0008 and the ratios to 6 %. If turned boards explained the liquids, the leakage would
    # change by its own size, 0.045.
    assert np.abs(np.array(inversion.leakage) - LEAKAGE).max() < 0.02
    for true_ratio, patch in zip(true_ratios, inversion.patches, strict=True):
        assert abs(patch.inverse_ratio - true_ratio) < 0.12 * abs(true_ratio)
