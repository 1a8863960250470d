"""A fake Pi with fake capture cards on a loopback subnet of their own."""

import pytest
import tomli_w
import zmq
from tests.support.acquisition.fake_cards import make_payload
from tests.support.acquisition.fake_rig import FakeRig, make_small_instrument
from tests.support.page.fixtures import finished_scan, samples

from polysight.acquisition import capture_rig, scan
from polysight.acquisition.pi_client import PiClient
from polysight.capture import CardClient, ReceiverProcess
from polysight_shared.tables import to_builtins

__all__ = ["finished_scan", "samples"]


@pytest.fixture
def rig(monkeypatch):
    """A started `FakeRig`. A command times out only if its Pi loses the reply or a card is silent."""
    fake = FakeRig(make_small_instrument())

    class Pi(PiClient):
        """A client that waits for a reply as long as it takes, unless the Pi has lost one more."""

        def __init__(self, *settings):
            super().__init__(*settings)
            replies_lost = fake.pi.replies_lost
            poll = self._commands.poll

            def poll_until_lost(_):
                nonlocal replies_lost
                while not poll(5):
                    if fake.pi.replies_lost > replies_lost:
                        replies_lost += 1
                        return 0
                return zmq.POLLIN

            self._commands.poll = poll_until_lost

    class Card(CardClient):
        """A client that does not wait for a card that is silent."""

        def _try(self, code, data, limit_s):
            if fake.cards[self.board.name].mute:
                limit_s = 0.01
            return super()._try(code, data, limit_s)

    monkeypatch.setattr(scan, "PiClient", Pi)
    monkeypatch.setattr(capture_rig, "CardClient", Card)
    fake.start()
    yield fake
    fake.close()


@pytest.fixture
def receivers(monkeypatch):
    """Process ids of the receivers that this test's scans have started, by board; a later scan's replace them.

    As reported by the scan itself: the list of processes changes while it is read, and process ids are used again.
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
    """Function of board, row and size that returns the bytes that a fake card sends in a row."""
    return make_payload


@pytest.fixture
def make_instrument():
    return make_small_instrument
