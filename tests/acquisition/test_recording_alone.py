"""A scan that is only recorded does not load or run the processing."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from tests.support.processes import HANG_S

from polysight.store import validate

PROCESSING = (
    "api calibration catalogue imaging materials page pipeline plan polarimetry process products report results"
)
# Folders of the host's program that a recorded scan does not need.
NOT_LOADED = {*PROCESSING.split(), "serve", "sync", "verdict"}
# Runs a command, and writes its exit status and the names of the loaded modules to a file.
PROGRAM = """
import json, sys
from polysight.cli.main import main
status = main(sys.argv[2:])
loaded = [name for name, module in sys.modules.items() if "polysight" in (getattr(module, "__file__", "") or "")]
open(sys.argv[1], "w").write(json.dumps([status, loaded]))
"""


def list_modules_after(*words: object, note: Path) -> list[str]:
    """Run a command of `polysight` in a new process; return those of our modules that it loaded."""
    command = [sys.executable, "-c", PROGRAM, str(note), *map(str, words)]
    process = subprocess.run(command, capture_output=True, text=True, timeout=HANG_S, check=False)
    status, loaded = json.loads(note.read_text())
    assert status == 0, process.stderr
    return loaded


@pytest.mark.parametrize("resumed", [False, True])
def test_a_recorded_scan_loads_nothing_of_the_processing(config, tmp_path, resumed):
    out = tmp_path / "scan"
    loaded = list_modules_after("scan", "--config", config, "--out", out, "--no-process", note=tmp_path / "note")
    if resumed:
        loaded = list_modules_after("resume", out, "--no-process", note=tmp_path / "note")
    rooms = {name.split(".")[1] for name in loaded if name.startswith("polysight.")}
    assert "acquisition" in rooms
    assert rooms & NOT_LOADED == set()
    assert validate(out) == []
