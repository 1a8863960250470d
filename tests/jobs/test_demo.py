"""Messages of `polysight demo` at the end of its programs. Whole demos are in e2e."""

import contextlib
import re
import signal
import time

import pytest
from tests.support.paths import REPO

from polysight.jobs import demo
from polysight.results import NoResult
from polysight_shared.errors import ConfigError


@pytest.mark.parametrize(
    ("status", "exit_status", "names_logs"),
    [
        (0, 0, False),
        (NoResult.exit_status, NoResult.exit_status, False),
        (ConfigError.exit_status, ConfigError.exit_status, True),
        # A program that a signal has ended has the negative number of the signal as its status.
        (-signal.SIGKILL, signal.SIGKILL, True),
    ],
)
def test_a_demo_names_the_logs_of_the_rig_if_its_scan_failed(
    monkeypatch, tmp_path, capsys, status, exit_status, names_logs
):
    started_s = time.monotonic()
    rig_file = tmp_path / "rig.toml"
    monkeypatch.setattr(demo, "run_simulated_rig", lambda *_: contextlib.nullcontext(rig_file))
    monkeypatch.setattr(demo, "_run_to_its_end", lambda _: status)
    out = tmp_path / "demo"
    scene = REPO / "examples" / "demo.toml"
    assert demo.run_demo(scene, REPO / "instrument.toml", out, None) == exit_status
    printed = capsys.readouterr()
    assert (str(out / "rig" / "logs") in printed.err) == names_logs
    # The printed duration is that of the demo, rounded.
    if not names_logs:
        seconds = float(re.search(r"(\d+) s in all", printed.out)[1])
        assert seconds <= time.monotonic() - started_s + 1
