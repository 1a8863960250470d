"""`polysight plan` and `polysight doctor` warn before a scan if the library has another angle of incidence.

The library has the reflections of known materials, which depend on the angle.
"""

import msgspec
import pytest
from tests.support.doctor.case import make_context

from polysight.doctor.rig_checks import check_library
from polysight.planning import forecast
from polysight_shared.geometry import incidence_deg


# 499 mm is the published distance; 6 mm more change the angle by less than half a degree.
@pytest.mark.parametrize(
    ("distance_mm", "is_known_angle"), [(499.0, True), (505.0, True), (560.0, False), (450.0, False)]
)
def test_a_library_with_another_angle_is_a_warning(rig, distance_mm, is_known_angle):
    geometry = msgspec.structs.replace(rig.geometry, object_distance_mm=distance_mm)
    moved_rig = msgspec.structs.replace(rig, geometry=geometry)
    angle_deg = incidence_deg(moved_rig, moved_rig.receivers[0])
    warnings = [warning for warning in forecast(moved_rig).warnings if warning.where == "library"]
    finding = check_library(make_context(moved_rig))
    assert (warnings == []) == is_known_angle
    assert finding.level == ("ok" if is_known_angle else "warning")
    assert finding.facts["incidence_deg"] == pytest.approx(angle_deg)
    assert f"{angle_deg:.1f} degrees" in finding.what
    for warning in warnings:
        assert f"{angle_deg:.1f} degrees" in warning.what
        assert warning.level != "error"
