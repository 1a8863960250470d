"""The text that `polysight focus` prints about the plane through the flat plates and about the sharpest plane."""

from dataclasses import replace

import numpy as np
import pytest

from polysight.imaging import Focus
from polysight.imaging.plane import PlaneEstimate
from polysight.jobs.process import _format_focus

# Object distance of the rig file
DISTANCE_MM = 700.0

PLATES = PlaneEstimate(
    offset_m=1.2e-3, offset_std_m=0.35e-3, tilt_rad=(0.01, -0.02), tilt_std_rad=(0.001, 0.002),
    heights_m=np.zeros(4), by_phase=False, plates=4,
)  # fmt: skip
SHARPEST = Focus(
    depths_mm=np.linspace(-6, 6, 5), sharpness=np.array([0.1, 0.4, 1.0, 0.4, 0.1]), depth_mm=-0.5, tilt_deg=(0.3, -0.4),
    gain=1.25,
)  # fmt: skip


def test_the_plane_through_the_plates_and_the_sharpest_one_are_printed_in_mm_and_degrees():
    text = "\n".join(_format_focus("s7", DISTANCE_MM, SHARPEST, PLATES))
    assert "4 flat plates lie +1.20 +- 0.35 mm" in text
    assert "by the range of their echoes: object_distance_mm = 701.20" in text
    assert "tilt: +0.57 +- 0.06 degrees along x, -1.15 +- 0.11 along y" in text
    assert "sharpest -0.50 mm from the rig file's: object_distance_mm = 699.50" in text
    assert "tilt: +0.30 degrees along x, -0.40 along y; sharpness 1.250 times" in text


@pytest.mark.parametrize("by_phase", [False, True])
def test_the_text_says_whether_the_plane_through_the_plates_is_by_phase_or_by_range(by_phase):
    plates = replace(PLATES, by_phase=by_phase)
    text = "\n".join(_format_focus("s7", DISTANCE_MM, SHARPEST, plates))
    assert ("by the phase of their echoes" in text) == by_phase
    assert ("by the range of their echoes" in text) != by_phase
