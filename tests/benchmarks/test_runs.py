"""`python -m benchmarks`: each benchmark runs on a tiny scan and writes its figures to a JSON file."""

import importlib
import json
from pathlib import Path

import numpy as np
import pytest
from benchmarks import accuracy, demo, gpu, image, measure, sync, waits, whole
from benchmarks.__main__ import main
from benchmarks.data import RepeatedRows
from benchmarks.measure import THREADS
from tests.support.rigs import make_rig_with

from polysight_shared.errors import ConfigError

MODULES = {"sync": sync, "image": image, "whole": whole, "waits": waits, "demo": demo, "accuracy": accuracy}


@pytest.mark.slow
@pytest.mark.parametrize("name", MODULES)
def test_a_benchmark_writes_finite_figures_with_the_machine_and_removes_its_data(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # `main` sets these variables; after the test they are restored.
    for variable in THREADS:
        monkeypatch.setenv(variable, "1")
    if name == "demo":
        few_rows = demo.QUICK.read_text(encoding="utf-8").replace("rows = 27", "rows = 9")
        monkeypatch.setattr(demo, "QUICK", tmp_path / "few-rows.toml")
        demo.QUICK.write_text(few_rows, encoding="utf-8")
    assert main(["--out", str(tmp_path), name, "--quick", "--folder", str(tmp_path)]) == 0
    result = json.loads((tmp_path / f"{name}.json").read_text())
    printed = capsys.readouterr().out
    assert result["simulated"]
    assert result["machine"]["cores"]
    assert result["lines"]
    for line in result["lines"]:
        assert np.isfinite(line["value"])
        assert line["quantity"] in printed
    assert "not a measurement" in printed
    assert not list(tmp_path.glob("polysight-bench-*")), "its data is removed"


@pytest.mark.slow
def test_the_benchmark_of_capture_counts_as_lost_only_packets_that_the_kernel_dropped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Packets of the rows after the first one are not lost. A busy machine may drop some."""
    rate = 20000
    main(["capture", "--seconds", "0.5", "--rate", str(rate), "--alone", "--no-compare", "--folder", str(tmp_path)])
    # Each trial has a line, which begins with the rate. A trial before the measured one warms up the receivers.
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith(f"    {rate}")]
    assert len(lines) == 2
    for line in lines:
        _, _, _, _, packets_sent, packets_lost, packets_dropped, *_ = line.split()
        assert int(packets_sent) > 0
        assert int(packets_lost) <= int(packets_dropped)


def test_a_row_of_a_repeated_recording_counts_every_chirp_of_a_frame(tmp_path: Path) -> None:
    columns = 5
    pulses = 2
    chirps = 3
    rig = make_rig_with(burst={"pulses": pulses, "chirps": chirps, "chirp_us": 60.0}, grid={"columns": columns})
    (tmp_path / "row").write_bytes(bytes(rig.frame_bytes))
    row = RepeatedRows(rig, {"RH": [tmp_path / "row"]}).read_row("RH", 0)
    assert row.frames_expected == columns * pulses * chirps
    assert len(row.payload) == rig.row_bytes


@pytest.mark.parametrize(("value", "verdict"), [(30.0, "aim"), (20.0, "holds"), (5.0, "DOES NOT HOLD")])
def test_the_verdict_on_a_speed_says_which_of_its_lower_limits_is_reached(value: float, verdict: str) -> None:
    line = measure.Line("speed", ours="", theirs="", value=value, at_least=10.0, aim=25.0)
    assert line.verdict == verdict


def test_a_time_below_the_desired_one_reaches_the_aim() -> None:
    line = measure.Line("time", ours="", theirs="", value=5.0, at_least=25.0, aim=10.0, higher_is_better=False)
    assert line.verdict == "aim"


def test_without_a_gpu_the_benchmark_of_gpus_says_so_and_writes_no_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gpu, "libraries", list)
    assert main(["--out", str(tmp_path), "gpu", "--quick"]) == 0
    assert "not measured" in capsys.readouterr().out
    assert not (tmp_path / "gpu.json").exists()


def test_images_of_another_array_library_are_compared_with_numpy_and_with_the_direct_sum(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A library that runs on the CPU stands for one that runs on a GPU.
    strict = gpu.Library("array-api-strict", importlib.import_module("array_api_strict"), None, "no card")
    monkeypatch.setattr(gpu, "libraries", lambda: [strict])
    assert main(["--out", str(tmp_path), "gpu", "--quick", "--folder", str(tmp_path)]) == 0
    figures = json.loads((tmp_path / "gpu.json").read_text())["array-api-strict"]
    assert set(figures["seconds"]) >= {"image", "cube on disk to image", "exact sum"}
    # Relative differences in single precision: 1.5e-5 at most (measured).
    assert max(figures["differences"].values()) < 1e-4


def test_a_file_in_place_of_the_output_folder_is_a_usage_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for variable in THREADS:
        monkeypatch.setenv(variable, "1")
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit) as exit_info:
        main(["--out", str(tmp_path / "file"), "widths"])
    assert exit_info.value.code == ConfigError.exit_status
    assert str(tmp_path / "file") in capsys.readouterr().err
