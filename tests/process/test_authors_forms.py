"""Recordings in the published layouts give the same images as the same scene recorded row by row."""

import json

import msgspec
import numpy as np
import pytest
import tomli_w
from tests.support.pipelines import make_pipeline
from tests.support.refusals import expect_refusal
from tests.support.rigs import load_published_rig

from polysight.cli.main import main
from polysight.store.open import open_source
from polysight.store.published import PublishedCubes
from polysight.sync.cubes import detect_form
from polysight_shared.config import Image
from polysight_shared.errors import DataError, ErrorCode
from polysight_shared.tables import to_builtins
from polysight_simulators.scene import decode_scene, simulate, write_cube

RIG = load_published_rig()
# The rig with an image of few pixels, which is formed quickly.
RIG_WITH_SMALL_IMAGE = msgspec.structs.replace(RIG, image=Image(columns=60, rows=50, pixel_mm=4.0))
SCENE = {
    "name": "two plates",
    "grid": {"columns": 17, "rows": 21, "step_x_mm": 16.0, "step_y_mm": 8.0},
    "burst": {"pulses": 2},
    "plates": [
        {"name": "copper", "centre_mm": [-40.0, 20.0], "size_mm": [50.0, 30.0], "metal": True},
        {"name": "PET", "centre_mm": [40.0, -25.0], "size_mm": [30.0, 50.0], "permittivity": [3.8, 0.7]},
    ],
}


def read_images(folder):
    """Return both images of a recording, and its pipeline."""
    pipeline = make_pipeline(open_source(folder, RIG_WITH_SMALL_IMAGE))
    return pipeline.form_images(), pipeline


def correlate(a, b, channel):
    """Return the normalised correlation of two images where both are valid; 1 if they are equal up to a factor."""
    valid_in_both = a.valid & b.valid
    x = getattr(a, channel)[valid_in_both]
    y = getattr(b, channel)[valid_in_both]
    return abs(np.vdot(x, y)) / np.sqrt(np.vdot(x, x).real * np.vdot(y, y).real)


@pytest.fixture(scope="module")
def undisturbed_images(tmp_path_factory):
    """Images of a scan without disturbances, recorded row by row: the reference for the other forms."""
    scene = decode_scene(SCENE, "t").with_disturbances(ideal=True)
    return read_images(simulate(RIG, scene, tmp_path_factory.mktemp("rows"), layout="authors"))[0]


def test_a_scan_by_columns_makes_the_image_of_one_by_rows(undisturbed_images, tmp_path):
    scene = decode_scene(SCENE, "t").with_disturbances(packet_loss=0.002)
    # RV lacks positions 0 and 7 of its fourth column.
    folder = simulate(
        RIG, scene, tmp_path, layout="authors", by_columns=True, zero_filling=False, skipped={("RV", 3): {0, 7}}
    )
    image, pipeline = read_images(folder)
    small_image = RIG_WITH_SMALL_IMAGE.image
    assert image.h.shape == (small_image.rows, small_image.columns)
    assert undisturbed_images.h.shape == image.h.shape
    np.testing.assert_allclose(image.x_m, undisturbed_images.x_m, atol=1e-12)
    np.testing.assert_allclose(image.y_m, undisturbed_images.y_m, atol=1e-12)
    # Noise, the disturbances and lost packets leave a correlation of 0.992 and 0.997.
    for channel in ("h", "v"):
        assert correlate(image, undisturbed_images, channel) > 0.98
    facts = pipeline.quality.notes["recording"]
    assert facts.direction == "col"
    assert facts.boards["RV"]["positions_missing"] == 2
    assert facts.boards["RH"]["packets_lost"] > 0
    assert pipeline.rig.grid.columns == 17


@pytest.mark.parametrize(
    "form",
    [{}, {"keep_direct": False, "from_transmitter": True}, {"common_reference": True, "conjugate": True}],
)
def test_a_synchronised_cube_of_any_convention_makes_the_same_image(undisturbed_images, tmp_path, form):
    folder = write_cube(RIG, decode_scene(SCENE, "t"), tmp_path, **form)
    image, pipeline = read_images(folder)
    # The correlation is 0.9999.
    for channel in ("h", "v"):
        assert correlate(image, undisturbed_images, channel) > 0.999
    assert set(pipeline.quality.notes["recording"].cubes) == {"RH", "RV"}
    assert pipeline.quality.result().boards["RH"].positions_masked == 0


def test_a_cube_without_reference_is_referenced_to_the_direct_path_and_its_zeros_are_masked(
    undisturbed_images, tmp_path
):
    """Each position has a random phase and delay, as before synchronisation; one is zero and one is not a number."""
    folder = write_cube(RIG, decode_scene(SCENE, "t"), tmp_path)
    rng = np.random.default_rng(1)
    for board in ("RH", "RV"):
        file = folder / f"{board}_synced.npy"
        cube = np.load(file)
        phase_turns = rng.uniform(0, 1, cube.shape[1:3])
        # Delays of 40 to 60 of the 256 bins of the range transform, far from its ends
        range_bins = rng.uniform(40, 60, cube.shape[1:3])
        part_of_chirp = np.arange(256) / 256
        turns = phase_turns[..., None] + range_bins[..., None] * part_of_chirp
        cube *= np.exp(2j * np.pi * turns).astype(np.complex64)
        cube[:, 4, 5] = 0
        cube[:, 5, 6] = np.nan
        np.save(file, cube)
    image, pipeline = read_images(folder)
    # Two masked positions of 17 x 21 leave 0.996. Positions with their random phases would not be correlated at all.
    for channel in ("h", "v"):
        assert correlate(image, undisturbed_images, channel) > 0.99
    assert pipeline.quality.result().boards["RH"].positions_masked == 2


def test_a_cube_of_zeros_is_refused(tmp_path):
    folder = write_cube(RIG, decode_scene(SCENE, "t"), tmp_path)
    source = open_source(folder, RIG_WITH_SMALL_IMAGE)
    assert isinstance(source, PublishedCubes)
    with expect_refusal(ErrorCode.NO_DATA):
        detect_form([0 * source.read_row("RH", 0).cube], source.instrument, source.instrument.receivers[0])


def test_cubes_are_processed_like_any_scan_but_have_no_sync_report(tmp_path):
    folder = write_cube(RIG, decode_scene(SCENE, "t"), tmp_path)
    config = tmp_path / "rig.toml"
    config.write_bytes(tomli_w.dumps(to_builtins(RIG_WITH_SMALL_IMAGE)).encode())
    assert main(["process", str(folder), "--out", str(tmp_path / "out"), "--config", str(config)]) == 0
    assert len(json.loads((tmp_path / "out" / "materials.json").read_text())["segments"]) == 2
    quality = json.loads((tmp_path / "out" / "quality.json").read_text())
    assert quality["boards"]["RH"]["positions"] == SCENE["grid"]["columns"] * SCENE["grid"]["rows"]
    assert set(quality["recording"]["cubes"]) == {"RH", "RV"}
    status = main(["sync-report", str(folder), "--out", str(tmp_path / "sync"), "--config", str(config)])
    assert status == DataError.exit_status
