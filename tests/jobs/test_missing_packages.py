"""A wheel that is not installed ends a command with one message that names it, not with a traceback."""

import sys
from pathlib import Path

import pytest

from polysight.cli.main import main
from polysight_shared.errors import ConfigError

COMMANDS = {
    "simulate examples/point-targets.toml --out out": "polysight_simulators",
    "demo --out out": "polysight_simulators",
    "reproduce --out out": "polysight_papers",
    "train --authors . --out out.npz": "polysight_papers",
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_missing_package_is_named(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    package = COMMANDS[command]
    for module in [m for m in sys.modules if m.startswith(f"{package}.")]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.chdir(tmp_path)
    assert main(command.split()) == ConfigError.exit_status
    message = capsys.readouterr().err
    assert f"the package {package} is not installed" in message
    assert "pip install" in message
