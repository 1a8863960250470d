"""Every benchmark of the processing runs on a tiny grid, and writes its figures with the machine's name."""

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

MODULES = {"sync": sync, "image": image, "whole": whole, "waits": waits, "demo": demo, "accuracy": accuracy}


@pytest.mark.slow
@pytest.mark.parametrize("name", MODULES)
def test_quick_trial(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Main sets them; here they are put back
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
def test_the_capture_trial_counts_as_lost_only_what_the_kernel_dropped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Packets after the first row were once counted as lost. A busy machine may drop packets."""
    main(["capture", "--seconds", "0.5", "--rate", "20000", "--alone", "--no-compare", "--folder", str(tmp_path)])
    columns = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith("    20000")]
    assert len(columns) == 2
    for _, _, _, _, packets_sent, packets_lost, packets_dropped, *_ in columns:
        assert int(packets_sent) > 0
        assert int(packets_lost) <= int(packets_dropped)


def test_a_repeated_row_counts_every_chirp_of_a_frame(tmp_path: Path) -> None:
    rig = make_rig_with(burst={"pulses": 2, "chirps": 3, "chirp_us": 60.0}, grid={"columns": 5})
    (tmp_path / "row").write_bytes(bytes(rig.frame_bytes))
    row = RepeatedRows(rig, {"RH": [tmp_path / "row"]}).read_row("RH", 0)
    assert row.frames_expected == 5 * 2 * 3
    assert len(row.payload) == rig.row_bytes


@pytest.mark.parametrize(
    ("value", "higher", "verdict"),
    [(30.0, True, "aim"), (20.0, True, "holds"), (5.0, True, "DOES NOT HOLD"), (5.0, False, "aim")],
)
def test_verdict(value: float, higher: bool, verdict: str) -> None:
    limits = (10.0, 25.0) if higher else (25.0, 10.0)
    assert measure.Line("x", "", "", value, *limits, higher_is_better=higher).verdict == verdict


def test_without_a_gpu_nothing_is_claimed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gpu, "libraries", list)
    assert main(["--out", str(tmp_path), "gpu", "--quick"]) == 0
    assert "not measured" in capsys.readouterr().out
    assert not (tmp_path / "gpu.json").exists()


def test_another_library_is_compared_with_numpy_and_the_exact_sum(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    strict = gpu.Library("array-api-strict", importlib.import_module("array_api_strict"), None, "no card")
    monkeypatch.setattr(gpu, "libraries", lambda: [strict])
    assert main(["--out", str(tmp_path), "gpu", "--quick", "--folder", str(tmp_path)]) == 0
    figures = json.loads((tmp_path / "gpu.json").read_text())["array-api-strict"]
    assert set(figures["seconds"]) >= {"image", "cube on disk to image", "exact sum"}
    assert max(figures["differences"].values()) < 1e-4


def test_a_file_in_the_place_of_the_folder_is_a_usage_error(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for variable in THREADS:
        monkeypatch.setenv(variable, "1")
    (tmp_path / "file").touch()
    with pytest.raises(SystemExit) as ended:
        main(["--out", str(tmp_path / "file"), "widths"])
    assert ended.value.code == 2
    assert str(tmp_path / "file") in capsys.readouterr().err
