"""Hello tells by which lines the Pi drives the radars, and everybody draws the same conclusion from it."""

from __future__ import annotations

import threading

import msgspec
import pytest

from polysight.pi_controller import service
from polysight.pi_controller.lines_gpiod import GpiodLines
from polysight.pi_controller.lines_gpiomem import GpiomemLines
from polysight.pi_controller.lines_wires import WireLines
from polysight.pi_controller.service import Options, Service
from polysight.shared import messages as m
from polysight.shared.messages import is_simulated
from tests.support.pi.host_side import HostSide


def test_lines_of_pins_are_hardware_and_all_others_are_simulated():
    assert [is_simulated(kind.name) for kind in (GpiodLines, GpiomemLines, WireLines)] == [False, False, True]
    for unknown in ("", "fake", "gpio", "GPIOD", "lgpio"):
        assert is_simulated(unknown), "nothing is called measured that may not be"


@pytest.mark.parametrize(
    ("wiring", "simulated", "backend"),
    [("fanout", True, "wires"), ("gpiomem", True, "wires"), ("fanout", False, "gpiod"), ("gpiomem", False, "gpiomem")],
)
def test_hello_tells_the_lines_that_are_driven(instrument, stage, hub, monkeypatch, wiring, simulated, backend):
    """On a real Pi the lines are opened by name; here simulated ones stand in for them, whatever they are called."""
    rig = msgspec.structs.replace(instrument, pi=msgspec.structs.replace(instrument.pi, wiring=wiring))
    monkeypatch.setattr(service, "open_lines", lambda rig, _: WireLines(hub, rig.pi))
    monkeypatch.setattr(service, "_prepare_trigger_thread", lambda: None)
    running = Service(rig, Options(wires=hub if simulated else None, stage_port=stage.port))
    thread = threading.Thread(target=running.serve)
    thread.start()
    host = HostSide(running.server.command_address, running.server.event_address, rig)
    try:
        hello = host.ask(m.Hello())
    finally:
        host.close()
        running.stop()
        thread.join(60)
        running.close()
    assert hello.backend == backend
    assert is_simulated(hello.backend) == simulated
