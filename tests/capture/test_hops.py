"""Errors of a silent card name the hop: no route, no link, no device, a silent card, a radar that does not stream."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import msgspec
import pytest
from tests.support.paths import REPO

from polysight.capture.dca1000 import Status
from polysight.capture.network import (
    Hop,
    explain_silent_card,
    explain_silent_radar,
    find_silent_hop,
    neighbour_mac,
    route_interface,
)
from polysight.capture.placement import Losses, PacketCounts
from polysight.capture.receiver import RowCapture
from polysight_shared.config import Board

CARD = "192.168.33.180"
BOARD = Board(
    name="RH",
    role="receive_h",
    card_address=CARD,
    host_address="192.168.33.30",
    command_port=4096,
    data_port=4098,
    mount=(),
)
# Files of the kernel as in proc(5), route: addresses are hexadecimal with their last byte first. A local network, and a
# gateway to everything else.
ROUTES = "Iface Destination Gateway Flags RefCnt Use Metric Mask MTU Window IRTT\n"
LOCAL = "eth1 0021A8C0 00000000 0001 0 0 0 00FFFFFF 0 0 0\n"
GATEWAY = "eth0 00000000 0102A8C0 0003 0 0 100 00000000 0 0 0\n"


def write_kernel_files(root: Path, routes: str = LOCAL, carrier: str | None = "1", arp: str | None = "0x2") -> Path:
    """Write a machine's files of /proc and /sys; `carrier`: the link's state, `arp`: the flags of the card's entry."""
    (root / "proc/net").mkdir(parents=True)
    (root / "proc/net/route").write_text(ROUTES + routes)
    neighbours = f"{CARD} 0x1 {arp} 12:34:56:78:90:12 * eth1\n" if arp else ""
    (root / "proc/net/arp").write_text("IP address HW type Flags HW address Mask Device\n" + neighbours)
    link = root / "sys/class/net/eth1"
    link.mkdir(parents=True)
    (link / "operstate").write_text("down\n" if carrier is None else "up\n")
    if carrier is not None:
        (link / "carrier").write_text(carrier + "\n")
    return root


def test_an_interface_without_a_link_status_is_skipped(tmp_path):
    root = write_kernel_files(tmp_path, carrier=None)
    assert find_silent_hop(CARD, root) is Hop.LINK
    for state in ("unknown", "dormant"):
        (root / "sys/class/net/eth1/operstate").write_text(f"{state}\n")
        assert find_silent_hop(CARD, root) is Hop.CARD


@pytest.mark.parametrize(
    ("kernel_files", "hop", "cause"),
    [
        ({"routes": ""}, Hop.ROUTE, "no route"),
        ({"routes": GATEWAY}, Hop.ROUTE, "no route"),
        ({"routes": GATEWAY + LOCAL}, Hop.CARD, "mute"),
        ({"carrier": "0", "arp": "0x0"}, Hop.LINK, "no link"),
        ({"carrier": None}, Hop.LINK, "no link"),
        ({"arp": "0x0"}, Hop.NEIGHBOUR, f"no device has the address {CARD}"),
        ({}, Hop.CARD, "mute"),
        ({"arp": None}, Hop.UNKNOWN, "the card is off"),
    ],
)
def test_each_hop_that_fails_has_a_message_of_its_own(tmp_path, kernel_files, hop, cause):
    root = write_kernel_files(tmp_path, **kernel_files)
    assert find_silent_hop(CARD, root) is hop
    error = explain_silent_card(BOARD, "it did not answer", root)
    assert error.what == "it did not answer"
    assert cause in error.why
    assert error.remedy


@pytest.mark.parametrize(
    ("routes", "interface"),
    [
        # The longest mask wins, in either order, and of two equal ones the first.
        (
            "eth1 0021A8C0 00000000 0001 0 0 0 00FFFFFF 0 0 0\neth2 0000A8C0 00000000 0001 0 0 0 0000FFFF 0 0 0\n",
            "eth1",
        ),
        (
            "eth2 0000A8C0 00000000 0001 0 0 0 0000FFFF 0 0 0\neth1 0021A8C0 00000000 0001 0 0 0 00FFFFFF 0 0 0\n",
            "eth1",
        ),
        (LOCAL + LOCAL.replace("eth1", "eth2"), "eth1"),
        # A route of an interface that is down, and two to other subnets.
        (LOCAL.replace(" 0001 ", " 0000 "), ""),
        (LOCAL.replace("0021A8C0", "0022A8C0"), ""),
        (LOCAL.replace("0021A8C0", "0020A8C0"), ""),
        # A cable from machine to machine may be the only route.
        ("eth1 00000000 00000000 0001 0 0 0 00000000 0 0 0\n", "eth1"),
        # A longer route over a gateway hides a shorter one without.
        ("eth2 0000A8C0 00000000 0001 0 0 0 0000FFFF 0 0 0\neth0 0021A8C0 0102A8C0 0003 0 0 0 00FFFFFF 0 0 0\n", ""),
        # A line that was cut, and one that ends with its mask.
        ("eth1 0021A8C0 00000000 0001 0 0 0\n", ""),
        ("eth1 0021A8C0 00000000 0001 0 0 0 00FFFFFF\n", "eth1"),
    ],
)
def test_the_interface_of_a_card_is_that_of_the_longest_route_without_a_gateway(tmp_path, routes, interface):
    assert route_interface(CARD, write_kernel_files(tmp_path, routes=routes)) == interface


def test_a_neighbour_is_the_line_of_its_address(tmp_path):
    (tmp_path / "proc/net").mkdir(parents=True)
    lines = [
        "IP address HW type Flags HW address Mask Device",
        f"{CARD} 0x1",
        "192.168.33.181 0x1 0x2 00:00:00:00:00:01 * eth1",
        "192.168.33.179 0x1 0x2 00:00:00:00:00:02 * eth1",
        f"{CARD} 0x1 0x6 00:00:00:00:00:03",
    ]
    (tmp_path / "proc/net/arp").write_text("\n".join(lines))
    assert neighbour_mac(CARD, tmp_path) == "00:00:00:00:00:03"


def test_unknown_hops_are_not_guessed(tmp_path):
    assert find_silent_hop(CARD, tmp_path) is Hop.UNKNOWN
    assert route_interface(CARD, tmp_path) is None
    assert neighbour_mac(CARD, tmp_path) is None
    assert find_silent_hop("127.0.0.5", write_kernel_files(tmp_path, routes="")) is Hop.UNKNOWN


def make_row(**fields_given) -> RowCapture:
    """Return a row for which no packet came, with these fields."""
    fields = dict.fromkeys((f.name for f in msgspec.structs.fields(RowCapture)), 0)
    fields |= {"counts": PacketCounts(), "losses": Losses()}
    return RowCapture(**(fields | {"missing": [(0, 9)], "located": False, "reason": "no packet came"} | fields_given))


@pytest.mark.parametrize(
    ("received", "cause"),
    [
        (None, "the radar is not streaming"),
        (make_row(), "the radar is not streaming"),
        (make_row(strangers=7), "7 packets"),
        (make_row(card_status=int(Status.NO_LVDS_DATA)), "the radar sends nothing over LVDS"),
        (make_row(card_status=int(Status.NO_HEADER)), "without a header"),
    ],
)
def test_the_error_of_a_radar_that_does_not_stream_has_the_cause(received, cause):
    error = explain_silent_radar(BOARD, received)
    assert cause in error.why
    assert "RH" in error.what


# Run in a network of its own, with two virtual ethernet ports joined by a cable, c0 (the host's) and c1 (the card's):
# report the failed hop (`try`) without an address, without a route, without a link, without a device, and with a device
# that does not answer, which is another network that has c1.
SCRIPT = """
set -e
mount -t sysfs sysfs /sys
try() { "$PYTHON" - "$1" <<'END'
import sys
from pathlib import Path
import msgspec
from polysight.capture.card import survey_cards
from polysight_shared.config import load_instrument
rig = load_instrument(Path("instrument.toml"))
limits = msgspec.structs.replace(rig.limits, command_timeout_s=0.15)
survey = survey_cards(msgspec.structs.replace(rig, limits=limits))[0]
hop = next(hop for hop in survey.hops if hop.level == "error")
print(sys.argv[1], "|", hop.where, "|", hop.what, "|", hop.why, flush=True)
END
}
ip link set lo up
try no-address
ip address add 192.168.33.30/32 dev lo
try no-route
ip link add c0 type veth peer name c1
ip link set c0 up
ip address add 192.168.33.30/24 dev c0
try no-link
ip link set c1 up
try no-device
unshare -n sleep infinity & other=$!
trap 'kill $other' EXIT
until [ "$(readlink /proc/$other/ns/net)" != "$(readlink /proc/self/ns/net)" ]; do :; done
ip link set c1 netns $other
nsenter -t $other -n sh -c 'ip link set c1 up; ip address add 192.168.33.180/24 dev c1'
until nsenter -t $other -n ip link show c1 | grep -q 'state UP'; do :; done
until ip link show c0 | grep -q 'state UP'; do :; done
ip neigh flush dev c0
try mute
"""


def test_each_hop_is_distinguished_on_real_interfaces():
    """The kernel's own files, for a cable that is unplugged, a card that is missing, and one that does not answer."""
    tools = [shutil.which(name) for name in ("unshare", "ip", "nsenter", "mount")]
    make = ["unshare", "-rnm", "sh", "-c", "mount -t sysfs s /sys && ip link add c0 type veth peer name c1"]
    if None in tools or subprocess.run(make, capture_output=True, check=False).returncode:
        pytest.skip("no private network namespace with virtual ethernet on this machine")
    process = subprocess.run(
        ["unshare", "-rnm", "bash", "-c", SCRIPT],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"PYTHON": sys.executable},
        cwd=REPO,
    )
    assert process.returncode == 0, process.stderr
    line_by_hop = {line.split(" | ")[0]: line for line in process.stdout.splitlines()}
    assert "| host | LS commands: 192.168.33.30 is not an address of this machine" in line_by_hop["no-address"]
    for name, hop, cause in (
        ("no-route", "route", "| no route"),
        ("no-link", "link", "| no link: network interface c0"),
        ("no-device", "card", "no device has the address 192.168.33.180"),
        ("mute", "card", "the card is mute"),
    ):
        assert f"| {hop} |" in line_by_hop[name]
        assert cause in line_by_hop[name]
