"""Plan and doctor warn before a scan if the library has another angle of incidence."""

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
    moved = msgspec.structs.replace(rig, geometry=geometry)
    angle = incidence_deg(moved, moved.receivers[0])
    warnings = [w for w in forecast(moved).warnings if w.where == "library"]
    finding = check_library(make_context(moved))
    assert (not warnings, finding.level) == (is_known_angle, "ok" if is_known_angle else "warning")
    assert finding.facts["incidence_deg"] == pytest.approx(angle)
    for text in [finding.what, *(w.what for w in warnings)]:
        assert f"{angle:.1f} degrees" in text
    assert not any(w.level == "error" for w in warnings)
