"""Seeds and addresses that a simulated rig cannot use are refused or replaced before a process starts."""

import threading

import msgspec
import pytest
from tests.support.paths import RIG_FILE
from tests.support.refusals import expect_refusal
from tests.support.rigs import load_published_rig

from polysight_shared.config import NativeRadar
from polysight_shared.errors import ErrorCode
from polysight_simulators import __main__ as simulate, rig as simulated_rig
from polysight_simulators.cards import __main__ as cards
from polysight_simulators.loopback import move_to_subnet
from polysight_simulators.stage import __main__ as stage
from polysight_simulators.uno import __main__ as uno

# Exit status of a command with wrong arguments
WRONG_ARGUMENTS = 2


@pytest.mark.parametrize(
    ("main", "arguments"),
    [
        (simulate.main, ["simulate", "scene.toml", "--out", "out"]),
        (simulated_rig.main, ["--config", "rig.toml", "--dir", "rig"]),
        (cards.main, ["--config", "rig.toml", "--wires", "wires"]),
    ],
)
@pytest.mark.parametrize("seed", ["-1", "1.5", str(1 << 63)])
def test_a_seed_is_a_whole_number_from_zero(main, arguments, seed, capsys):
    with pytest.raises(SystemExit) as caught:
        main([*arguments, "--seed", seed])
    assert caught.value.code == WRONG_ARGUMENTS
    assert f"--seed: {seed} is not a whole number" in capsys.readouterr().err


def test_the_link_to_a_port_replaces_no_file(tmp_path):
    file = tmp_path / "notes.txt"
    file.write_text("mine")
    arguments = stage.parser().parse_args(["--config", str(RIG_FILE), "--link", str(file)])
    with expect_refusal(ErrorCode.FILE_EXISTS, file):
        stage._run(arguments, threading.Event())
    with expect_refusal(ErrorCode.FILE_EXISTS, file):
        uno._run(arguments)
    assert file.read_text() == "mine"


@pytest.mark.parametrize("speed", ["0", "-1", "nan", "inf"])
def test_a_time_scale_that_is_not_a_positive_number_is_refused_before_a_process_starts(tmp_path, capsys, speed):
    arguments = ["--config", str(RIG_FILE), "--pattern", "--dir", str(tmp_path / "rig"), f"--time-scale={speed}"]
    assert simulated_rig.main(arguments) == WRONG_ARGUMENTS
    assert f"--time-scale {speed}" in capsys.readouterr().err


def move_native(boards):
    """Return the published rig with native control of these boards, moved to a subnet."""
    rig = load_published_rig()
    native = {board.name: identity for board, identity in zip(rig.boards, boards, strict=True)}
    radar = msgspec.structs.replace(rig.radar, control="native", native=native)
    return move_to_subnet(msgspec.structs.replace(rig, radar=radar), "127.3.4")


def test_simulated_boards_replace_boards_identified_by_usb_plug_and_die():
    die = "00000001-00000002-00000003-00000004"
    moved = move_native([NativeRadar(usb_path=f"1-4.{n}", die_id=die, ldo_bypass=True) for n in range(3)])
    for board in moved.boards:
        # The address of the simulated board; the path of the USB plug and the die id are those of real boards.
        place = f"tcp://{board.card_address}:5700"
        assert moved.radar.native[board.name] == NativeRadar(usb_serial=place, ldo_bypass=True)


def test_a_simulated_board_is_acknowledged_if_the_board_that_it_replaces_is():
    """`ldo_bypass_acknowledged` names the board for which a person has acknowledged the bypass: here the second one."""
    serials = ["FT0", "FT1", "FT2"]
    moved = move_native([NativeRadar(s, ldo_bypass=True, ldo_bypass_acknowledged="FT1") for s in serials])
    acknowledged = [n.ldo_bypass_acknowledged == n.usb_serial for n in moved.radar.native.values()]
    assert acknowledged == [False, True, False]
