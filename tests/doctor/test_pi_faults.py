"""A Pi of another release, or with another sketch: a small one that answers so, over the real socket."""

import pytest

from polysight.shared import __version__
from polysight.shared.messages import HelloReply


def reply(**changes):
    said = {"pi_release": __version__, "firmware": __version__, "backend": "gpiod", "state": "homed"}
    return HelloReply(**{**said, "scan_id": "", "last_seq": 0, "t_unix_ns": 0, **changes})


def test_a_pi_of_this_release_is_ok(lonely, fake_pi):
    with fake_pi(lonely.instrument, reply()):
        found = lonely.doctor()
    assert found["pi"].verdict == found["stage"].verdict == found["rig is free"].verdict == "ok"
    assert found["pi clock"].verdict == "not checked"  # it did not tell
    assert [n for n, f in found.items() if f.verdict == "error"] == ["card RH", "card RV"]  # nobody is there


def test_a_pi_of_another_release(lonely, fake_pi):
    with fake_pi(lonely.instrument, reply(pi_release="0.0.9")):
        found = lonely.doctor()
    assert found["pi"].verdict == "error"
    assert "0.0.9" in found["pi"].found
    assert found["stage"].found == "pi failed"


def test_a_pi_of_another_wire_version(lonely, fake_pi):
    with fake_pi(lonely.instrument, reply(), version="2.0"):
        found = lonely.doctor()
    assert found["pi"].verdict == "error"
    assert "2.0" in found["pi"].found
    assert "same release" in found["pi"].remedy


@pytest.mark.parametrize("firmware", ["0.0.7", ""])
def test_a_sketch_of_another_release(lonely, fake_pi, firmware):
    with fake_pi(lonely.instrument, reply(firmware=firmware)):
        found = lonely.doctor()
    assert found["stage"].verdict == "error"
    assert "make flash" in found["stage"].remedy
    assert found["trigger line"].found == "stage failed"


def test_keys_that_are_not_there(lonely, tmp_path):
    def change(table):
        table["pi"] |= {"command_address": "tcp://192.0.2.1:5601", "event_address": "tcp://192.0.2.1:5602"}
        table["pi"]["key_dir"] = str(tmp_path / "nothing")

    lonely.folder.joinpath("rig").mkdir()
    found = lonely.doctor(lonely.variant(change))
    assert found["keys"].verdict == "error"
    assert "host.key_secret" in found["keys"].found
    assert found["pi"].found == "keys failed"
