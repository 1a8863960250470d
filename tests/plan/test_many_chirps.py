"""Plans for bursts with several chirps in a frame: a plan keeps the burst and chooses the speed of the stage alone."""

import msgspec

from polysight.planning import propose, scan_time


def test_a_kept_burst_is_scanned_at_the_slowest_whole_speed_that_keeps_the_time(rig):
    """There would be time for more pulses than the burst has; but a slower stage travels less during a burst."""
    minutes = 60.0
    burst = msgspec.structs.replace(rig.burst, pulses=1, chirps=16, chirp_us=143.0, period_us=2800.0)
    rig = msgspec.structs.replace(rig, burst=burst)
    plans = propose(rig, minutes)
    assert plans
    for plan in plans:
        stage = plan.rig.stage
        slower = msgspec.structs.replace(stage, speed_mm_s=stage.speed_mm_s - 1)
        assert plan.rig.burst == burst
        slower_rig = msgspec.structs.replace(plan.rig, stage=slower)
        assert scan_time(plan.rig).minutes <= minutes
        assert scan_time(slower_rig).minutes > minutes
