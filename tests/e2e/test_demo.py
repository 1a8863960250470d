"""`polysight demo` starts a simulated rig, scans and reports; when it is stopped, all of its processes end."""

import signal

import pytest
from tests.support.paths import RIG_FILE

from polysight.results.verdict import NoResult
from polysight.store.manifest import decode_line


@pytest.mark.parametrize("stop_signal", [signal.SIGINT, signal.SIGTERM])
def test_a_demo_that_is_stopped_while_scanning_ends_everything(bench, scene_file, stop_signal):
    """Ctrl-C reaches all processes of the demo, SIGTERM only the demo itself."""
    out = bench.folder / "demo"
    # The scan runs at five times the real speed, slow enough to be stopped before its end.
    options = ("--config", RIG_FILE, "--scene", scene_file, "--out", out, "--time-scale", "5")
    demo = bench.start("polysight", "demo", *options)

    def is_scanning() -> bool:
        assert demo.process.poll() is None, demo.err
        return any(out.glob("scan/raw/*/*.part"))

    bench.wait_for(is_scanning, "the demo scans")
    if stop_signal == signal.SIGINT:
        demo.interrupt()
    else:
        demo.process.terminate()
    ended = demo.wait()
    # The exit status that shells give to a program that Ctrl-C stopped; here after SIGTERM, too.
    assert ended.status == 128 + signal.SIGINT
    assert ended.err.splitlines()[-1] == "polysight demo: stopped"
    assert "Traceback" not in ended.err
    assert bench.list_processes() == {}
    for log in (out / "rig" / "logs").iterdir():
        assert "Traceback" not in log.read_text(), log


def test_without_a_cpp_compiler_the_stage_is_simulated_in_python(rig_without_compiler):
    rig = rig_without_compiler
    assert "Python stand-in" in (rig.folder / "rig" / "logs" / "stage.log").read_text()
    ended = rig.scan("--no-process").wait()
    assert ended.status == 0, ended.err
    validated = rig.run_here("validate", rig.folder / "scan")
    assert validated.status == 0
    assert validated.err == ""


def test_a_demo_begins_with_radars_without_firmware_and_ends_with_the_report(bench, scene_file):
    """As with a new rig: the host loads the radars' firmware, configures and arms them, scans, and reports."""
    options = ("--config", RIG_FILE, "--scene", scene_file, "--out", bench.folder / "demo")
    demo = bench.start("polysight", "demo", *options)
    ended = demo.wait()
    assert "Traceback" not in ended.err
    scan = bench.folder / "demo" / "scan"
    lines = [decode_line(line) for line in (scan / "manifest.jsonl").read_bytes().splitlines(keepends=True)]
    first_report = next(line for line in lines if line["fact"] == "radars")
    for answer in first_report["boards"].values():
        assert any("no image header" in line for line in answer["events"])
        assert answer["main_firmware"].endswith("patch 2.2.2.0")
        assert answer["die_id"]
    assert (scan / "products" / "report.html").is_file()
    # A scan as small as this one may have no result, and reports that.
    assert ended.status in (0, NoResult.exit_status), ended.err
