"""What goes onto a Pi: the installation script, the systemd unit, the udev rules."""

from __future__ import annotations

import configparser
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from shared.config import load_instrument

ROOT = Path(__file__).parents[2]
PI = ROOT / "pi_controller"
PROGRAM = "/opt/polysight/venv/bin/polysight-pi"
# Stands for a command that would change this machine; what it was asked is kept.
STUB = '#!/bin/sh\necho "$(basename "$0") $*" >> "$LOG"\n'
STUB_PYTHON = STUB + 'if [ "$2" = venv ]; then mkdir -p "$3/bin"; cp "$PIP" "$3/bin/pip"; fi\n'


@pytest.fixture
def unit():
    parser = configparser.ConfigParser(strict=False, interpolation=None)
    parser.optionxform = str  # type: ignore[assignment,method-assign]
    parser.read(PI / "polysight-pi.service")
    return parser


def test_the_unit_is_what_systemd_accepts(tmp_path):
    """With a program in the place of ours: it is not installed here."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze: `apt-get install systemd` runs this test too")
    text = (PI / "polysight-pi.service").read_text()
    assert PROGRAM in text
    (tmp_path / "polysight-pi.service").write_text(text.replace(PROGRAM, "/bin/true"))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", str(tmp_path / "polysight-pi.service")],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert "polysight-pi.service" not in done.stderr, done.stderr
    assert done.returncode == 0, done.stderr


def test_the_unit_gives_what_the_program_asks_for(unit):
    service = unit["Service"]
    assert int(service["LimitRTPRIO"]) >= 50
    assert service["LimitMEMLOCK"] == "infinity"
    assert {"gpio", "dialout"} <= set(service["SupplementaryGroups"].split())
    rig = load_instrument(ROOT / "instrument.toml")
    assert Path(rig.pi.journal_dir).is_relative_to(service["ReadWritePaths"])
    assert Path(rig.pi.journal_dir).is_relative_to(Path("/var/lib") / service["StateDirectory"])


def test_udev_rules_are_well_formed():
    lines = [x for x in (PI / "60-polysight.rules").read_text().splitlines() if x and not x.startswith("#")]
    assert len(lines) >= 4
    pair = r'[A-Z]+(\{[A-Za-z_]+\})?(==|=|\+=)"[^"]*"'
    for line in lines:
        assert re.fullmatch(rf"{pair}(, {pair})*", line), line


def test_installing_twice_keeps_the_rig_file(tmp_path):
    """The script in another root, with every command that changes a machine replaced."""
    commands, log, root = tmp_path / "bin", tmp_path / "log", tmp_path / "root"
    commands.mkdir()
    for name in ("getent", "groupadd", "useradd", "udevadm", "systemctl", "chown", "pip"):
        (commands / name).write_text(STUB + ("exit 2\n" if name == "getent" else ""))
    (commands / "python3").write_text(STUB_PYTHON)
    for path in commands.iterdir():
        path.chmod(0o755)
    environment = {
        **os.environ, "PATH": f"{commands}:{os.environ['PATH']}", "LOG": str(log), "PIP": str(commands / "pip"),
        "ROOT": str(root),
    }  # fmt: skip
    for rig_file in (None, "mine"):
        if rig_file:
            (root / "etc/polysight/instrument.toml").write_text(rig_file)
        done = subprocess.run([PI / "install.sh"], env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    assert (root / "etc/polysight/instrument.toml").read_text() == "mine"
    assert (root / "etc/polysight/keys").stat().st_mode & 0o777 == 0o700
    for name in ("etc/systemd/system/polysight-pi.service", "etc/udev/rules.d/60-polysight.rules"):
        assert (root / name).read_text() == (PI / Path(name).name).read_text()
    asked = log.read_text()
    assert "--groups gpio,dialout" in asked, "by hand, `polysight-pi check` as this user has no group from the unit"
    for words in ("useradd --system", f"venv {root}/opt/polysight/venv", f"{ROOT}/pi_controller", "systemctl enable"):
        assert words in asked
    assert PROGRAM in done.stdout
