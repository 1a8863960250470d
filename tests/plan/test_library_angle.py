"""A plan and the doctor say before a scan when the library was seen under another angle of incidence."""

from pathlib import Path

import msgspec
import pytest

from polysight.host.doctor.bench import Bench, Wanted
from polysight.host.doctor.check_host import check_library
from polysight.host.plan import forecast
from polysight.shared.geometry import incidence_deg


def at(rig, distance_mm):
    geometry = msgspec.structs.replace(rig.geometry, object_distance_mm=distance_mm)
    return msgspec.structs.replace(rig, geometry=geometry)


@pytest.mark.parametrize(("distance_mm", "known"), [(499.0, True), (505.0, True), (560.0, False), (450.0, False)])
def test_another_angle_than_the_librarys_is_told_before_the_scan(rig, distance_mm, known):
    moved = at(rig, distance_mm)
    told = [w for w in forecast(moved).warnings if w.topic == "library"]
    found = check_library(Bench(Wanted(Path("rig.toml")), given=moved))
    assert (not told, found.verdict) == (known, "ok" if known else "warning")
    assert found.facts["incidence_deg"] == pytest.approx(incidence_deg(moved, moved.receivers[0]))
    if not known:
        angle = f"{incidence_deg(moved, moved.receivers[0]):.1f} degrees"
        assert angle in told[0].text
        assert angle in found.found
        assert "--library" in told[0].text
        assert "--library" in found.remedy
        assert not told[0].refused
