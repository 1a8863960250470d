"""A fake Pi with fake capture cards on a loopback subnet of their own."""

from __future__ import annotations

import pytest
import tomli_w
from tests.support.acquisition.fake_cards import make_payload
from tests.support.acquisition.fake_rig import FakeRig, small_instrument
from tests.support.page.fixtures import finished, samples

from polysight.acquisition import capture_rig
from polysight.capture import ReceiverProcess
from polysight_shared.tables import to_builtins

__all__ = ["finished", "samples"]


@pytest.fixture
def rig():
    fake = FakeRig(small_instrument())
    fake.start()
    yield fake
    fake.close()


@pytest.fixture
def receivers(monkeypatch):
    """Process ids of the receivers that this test's scans have started, by board; a later scan's replace them.

    As told by the scan itself: the list of processes changes while it is read, and process ids begin again.
    """
    pids = {}

    class KnownReceiver(ReceiverProcess):
        def __init__(self, board, *settings):
            super().__init__(board, *settings)
            pids[board.name] = self.pid

    monkeypatch.setattr(capture_rig, "ReceiverProcess", KnownReceiver)
    return pids


@pytest.fixture
def config(rig, tmp_path):
    """The rig file of `rig`."""
    path = tmp_path / "rig.toml"
    path.write_text(tomli_w.dumps(to_builtins(rig.instrument)))
    return path


@pytest.fixture
def payload():
    return make_payload


@pytest.fixture
def make_instrument():
    return small_instrument
