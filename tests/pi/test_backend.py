"""Hello tells by which lines the Pi drives the radars, and everybody draws the same conclusion from it."""

from __future__ import annotations

import threading

import msgspec
import pytest

from polysight.pi_controller import lines as pi_lines
from polysight.pi_controller import system
from polysight.pi_controller.lines import GpiodLines, SpiLines
from polysight.pi_controller.service import Service
from polysight.pi_controller.sim_lines import WireLines
from polysight.shared import messages as m
from polysight.shared.messages import is_simulated
from tests.support.pi.host_side import HostSide
from tests.support.rigs import at_stage_port


def test_lines_of_pins_are_hardware_and_all_others_are_simulated():
    assert [is_simulated(kind.name) for kind in (GpiodLines, SpiLines, WireLines)] == [False, False, True]
    for unknown in ("", "fake", "gpio", "GPIOD", "lgpio"):
        assert is_simulated(unknown), "nothing is called measured that may not be"


@pytest.mark.parametrize(
    ("wiring", "simulated", "backend"),
    [("fanout", True, "wires"), ("spi", True, "wires"), ("fanout", False, "gpiod"), ("spi", False, "spi")],
)
def test_hello_tells_the_lines_that_are_driven(instrument, stage, hub, monkeypatch, wiring, simulated, backend):
    """Simulated lines stand in for those of a Pi, under their names."""

    def standing_in(kind):
        def open_it(pi, _):
            lines = WireLines(hub, pi)
            lines.name = kind.name
            return lines

        return open_it

    rig = msgspec.structs.replace(instrument, pi=msgspec.structs.replace(instrument.pi, wiring=wiring))
    monkeypatch.setattr(pi_lines, "GpiodLines", standing_in(GpiodLines))
    monkeypatch.setattr(pi_lines, "SpiLines", standing_in(SpiLines))
    monkeypatch.setattr(pi_lines, "load_gpiod", lambda: None)
    monkeypatch.setattr(system, "prepare_thread", list)
    running = Service(at_stage_port(rig, stage.port), hub if simulated else None)
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
