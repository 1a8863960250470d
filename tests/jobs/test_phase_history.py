"""A scan as CPHD: the file is consistent by the standard's own checks, and another processor's image of it is ours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import sarkit.cphd
from sarkit.verification import CphdConsistency
from tests.support.rigs import rig_with

from polysight.cli.main import main
from polysight.jobs.phase_history import FILE
from polysight.pipeline import Pipeline
from polysight.store import ScanFolder
from polysight_simulators.scene import decode_scene, simulate

C_M_S = 299_792_458.0
SCENE = {
    "name": "points",
    "points": [
        {"name": "a", "position_mm": [20.0, 10.0], "amplitude": [1.0, 0.0]},
        {"name": "b", "position_mm": [-15.0, -5.0], "amplitude": [0.5, 0.0]},
    ],
    "disturbances": {"packet_loss": 0.02},
}
GRID = {"columns": 12, "rows": 9, "step_x_mm": 9.0, "step_y_mm": 8.0}


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rig = rig_with(grid=GRID, image={"columns": 24, "rows": 16, "pixel_mm": 4.0, "apodisation": "none"})
    return simulate(rig, decode_scene(SCENE, "points"), tmp_path_factory.mktemp("scan") / "scan")


@pytest.fixture(scope="module")
def exported(scan: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out")
    assert main(["export", str(scan), "--cphd", "--out", str(out)]) == 0
    return out / FILE


@pytest.fixture(scope="module")
def pipeline(scan: Path) -> Pipeline:
    """A pipeline with all rows of the scan."""
    made = Pipeline(ScanFolder.load(scan))
    for row in made.source.rows():
        made.add_row(row)
    return made


def test_the_file_is_consistent_by_the_standards_own_checks(exported: Path) -> None:
    with exported.open("rb") as file:
        checker = CphdConsistency.from_file(file)
        checker.check()
    assert not checker.failures()
    assert checker.passes()


def image_of(file: Path, channels: str) -> np.ndarray:
    """What any processor makes of the file: the matched filter at every point of its image grid, as it says itself.

    Nothing but the file is known here: places, times of arrival, frequencies and the grid are read from it.
    """
    with file.open("rb") as f, sarkit.cphd.Reader(f) as reader:
        helper = sarkit.cphd.XmlHelper(reader.metadata.xmltree)
        scene = "{*}SceneCoordinates/{*}"
        origin = helper.load(f"{scene}IARP/{{*}}ECF")
        axes = [helper.load(f"{scene}ReferenceSurface/{{*}}Planar/{{*}}u{axis}") for axis in ("IAX", "IAY")]
        at = helper.load(f"{scene}ImageGrid/{{*}}IARPLocation")
        lines = int(helper.load(f"{scene}ImageGrid/{{*}}IAXExtent/{{*}}NumLines"))
        columns = int(helper.load(f"{scene}ImageGrid/{{*}}IAYExtent/{{*}}NumSamples"))
        pitch = helper.load(f"{scene}ImageGrid/{{*}}IAXExtent/{{*}}LineSpacing")
        line, sample = np.meshgrid(np.arange(lines) - at[0], np.arange(columns) - at[1], indexing="ij")
        places = origin + pitch * (line[..., None] * axes[0] + sample[..., None] * axes[1])
        total, count = np.zeros(line.shape, complex), 0
        for node in reader.metadata.xmltree.findall("{*}Data/{*}Channel/{*}Identifier"):
            if not node.text.startswith(channels):
                continue
            signal, vectors = reader.read_channel(node.text)
            for one, vector in zip(signal, vectors, strict=True):
                if not vector["SIGNAL"]:
                    continue
                apart = [np.linalg.norm(places - vector[k], axis=-1) for k in ("TxPos", "RcvPos")]
                known = [np.linalg.norm(vector["SRPPos"] - vector[k]) for k in ("TxPos", "RcvPos")]
                later = (sum(apart) - sum(known)) / C_M_S
                f = vector["SC0"] + vector["SCSS"] * np.arange(one.size)
                total += (one * np.exp(-2j * np.pi * later[..., None] * f)).sum(-1)
                count += 1
    return total / count


@pytest.mark.parametrize("channels", ["RH", "RV"])
def test_another_processors_image_of_the_file_is_ours(exported: Path, pipeline: Pipeline, channels: str) -> None:
    images = pipeline.form_images()
    ours = {"RH": images.h_raw, "RV": images.v_raw}[channels]
    theirs = image_of(exported, channels)
    assert np.abs(theirs - ours).max() < 1e-4 * np.abs(ours).max()


def test_positions_without_data_are_said_to_hold_no_signal(exported: Path, pipeline: Pipeline) -> None:
    with exported.open("rb") as file, sarkit.cphd.Reader(file) as reader:
        for board in ("RH", "RV"):
            signal, vectors = reader.read_channel(f"{board}-1")
            missing = vectors["SIGNAL"] == 0
            assert missing.sum() == (~pipeline.images.boards[board].valid).sum()
            assert not signal[missing].any()


def test_products_without_rows_have_no_phase_history(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(tmp_path), "--cphd"]) == 3
    assert "rows" in capsys.readouterr().err
