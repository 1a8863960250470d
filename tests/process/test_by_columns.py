"""A scan recorded column by column: sub-bands and the rig in scan.json have the same axes as the images."""

import numpy as np
import pytest
import tomli_w
from tests.support.pipelines import make_pipeline
from tests.support.processes import read_output
from tests.support.rigs import make_rig_with
from tests.support.scenes import COPPER, PET, make_scene

from polysight.store.open import open_source
from polysight_shared.files import read_json
from polysight_shared.tables import to_builtins

BANDS = 2
COLUMNS = 13
ROWS = 17
IMAGE = {"columns": 50, "rows": 40, "pixel_mm": 4.0}
RIG = make_rig_with(image=IMAGE)


@pytest.fixture(scope="module")
def scan(make_scan, tmp_path_factory):
    scene = make_scene(COPPER, PET, columns=COLUMNS, rows=ROWS)
    return make_scan(tmp_path_factory.mktemp("columns"), scene, RIG, layout="authors", by_columns=True)


def test_sub_bands_have_the_pixels_of_the_whole_band(scan, tmp_path):
    # Inside the copper
    box = (-55.0, -5.0, -25.0, 25.0)
    pipeline = make_pipeline(open_source(scan, RIG), bands=BANDS, model="none", metal_box_mm=box)
    whole_band = pipeline.form_images()
    parts = pipeline.sub_bands.finish(pipeline.source.mirrored)
    assert whole_band.h.shape == (IMAGE["rows"], IMAGE["columns"])
    assert len(parts) == BANDS
    for part in parts:
        np.testing.assert_array_equal(part.x_m, whole_band.x_m)
        np.testing.assert_array_equal(part.y_m, whole_band.y_m)
        assert part.valid.shape == whole_band.valid.shape
        for name in ("h", "v"):
            valid_in_both = whole_band.valid & part.valid
            amplitude_of_part = np.abs(getattr(part, name)[valid_in_both])
            amplitude_of_whole = np.abs(getattr(whole_band, name)[valid_in_both])
            # The correlation is 0.9997 or more; with exchanged axes it would be near 0.
            assert np.corrcoef(amplitude_of_part, amplitude_of_whole)[0, 1] > 0.8
    # scan.json contains the rig of the images: rows along x, as in the rig file.
    pipeline.finish(tmp_path)
    assert read_written_grid(tmp_path) == (COLUMNS, ROWS)
    bands = [s["bands"] for s in read_json(tmp_path / "materials.json")["segments"]]
    assert bands
    assert all(len(bands_of_segment) == BANDS for bands_of_segment in bands)


def test_the_image_command_writes_the_rig_of_its_images(scan, tmp_path):
    (tmp_path / "rig.toml").write_bytes(tomli_w.dumps(to_builtins(RIG)).encode())
    read_output("image", scan, "--config", tmp_path / "rig.toml", "--out", tmp_path / "out")
    assert read_written_grid(tmp_path / "out") == (COLUMNS, ROWS)


def read_written_grid(out) -> tuple[int, int]:
    """Return the columns and rows of the scan's grid in scan.json."""
    rig = read_json(out / "scan.json")["instrument"]
    assert (rig["image"]["columns"], rig["image"]["rows"]) == (IMAGE["columns"], IMAGE["rows"])
    return rig["grid"]["columns"], rig["grid"]["rows"]
