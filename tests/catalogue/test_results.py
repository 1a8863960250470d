"""The values at one place of a scan, and the comparison of two scans, are those of the scans' images."""

import io
import os
import shutil
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread
from tests.support.products import write_judged_products
from tests.support.refusals import expect_refusal
from tests.support.scenes import COPPER, PET

from polysight.catalogue import Pixels, compare, draw_comparison, draw_products, probe, read_result, thumbnail
from polysight.catalogue.pictures import MAPS
from polysight.catalogue.results import SIGNIFICANT_STDS, measure_scatter
from polysight.products import map_permittivity, read_products, write_image
from polysight_shared.errors import DataError, ErrorCode

# Middle of the plate of PET, mm.
CENTRE = tuple(PET["centre_mm"])


def test_a_place_shows_its_own_pixel(processed_scans):
    pixels = Pixels(processed_scans / "one" / "products")
    row, column = pixels.nearest(*CENTRE)
    answer = probe(processed_scans / "one", *CENTRE)
    p = complex(pixels.p[row, column])
    # Answers are rounded to four digits after the point.
    assert answer.p.value == pytest.approx(p, abs=1e-4)
    map_of_scan = map_permittivity(read_products(processed_scans / "one"))
    assert answer.permittivity.value == pytest.approx(complex(map_of_scan.value[row, column]), abs=1e-4)
    assert answer.permittivity_real_std == pytest.approx(map_of_scan.real_std[row, column], abs=1e-4)
    assert answer.permittivity_loss_std == pytest.approx(map_of_scan.loss_std[row, column], abs=1e-4)
    # Places are rounded to a hundredth of a mm.
    assert answer.place_mm == pytest.approx([pixels.x_mm[column], pixels.y_mm[row]], abs=0.01)
    assert answer.patch.truth.name == "PET"
    # PET is among the nearest materials, within two standard deviations.
    assert any(near.name.startswith("PET") and near.sigmas < 2 for near in answer.nearest)


def test_the_image_ends_half_a_pixel_beyond_its_outermost_pixels(processed_scans):
    pixels = Pixels(processed_scans / "one" / "products")
    rows, columns = pixels.p.shape
    pixel_mm = pixels.x_mm[1] - pixels.x_mm[0]
    x_min_mm, x_max_mm, y_min_mm, y_max_mm = pixels.extent_mm
    assert x_max_mm - x_min_mm == pytest.approx(columns * pixel_mm)
    assert y_max_mm - y_min_mm == pytest.approx(rows * (pixels.y_mm[1] - pixels.y_mm[0]))
    assert x_min_mm == pytest.approx(pixels.x_mm[0] - pixel_mm / 2)
    inside_mm = 0.01
    assert pixels.nearest(x_min_mm + inside_mm, y_min_mm + inside_mm) == (0, 0)
    assert pixels.nearest(x_max_mm - inside_mm, y_max_mm - inside_mm) == (rows - 1, columns - 1)
    middle_x = (x_min_mm + x_max_mm) / 2
    middle_y = (y_min_mm + y_max_mm) / 2
    for place in (
        (x_min_mm - inside_mm, middle_y),
        (x_max_mm + inside_mm, middle_y),
        (middle_x, y_min_mm - inside_mm),
        (middle_x, y_max_mm + inside_mm),
    ):
        with expect_refusal(ErrorCode.VALUE_INVALID, "outside the image"):
            pixels.nearest(*place)


def test_the_range_profile_has_its_peak_at_the_plate(processed_scans):
    for plate in (COPPER, PET):
        answer = probe(processed_scans / "one", *plate["centre_mm"]).profile
        for levels in answer.boards.values():
            peak_m = answer.path_m[int(np.argmax(levels))]
            # Paths are relative to that of the place. The peak is less than half of a range cell away.
            assert abs(peak_m) < 0.03


def test_metal_has_no_permittivity_and_the_reason_is_given(processed_scans):
    answer = probe(processed_scans / "one", *COPPER["centre_mm"])
    assert answer.permittivity is None
    assert "metal" in answer.why
    assert answer.patch.metal_reference


def test_places_outside_the_image_are_refused(processed_scans):
    for place in ((1000.0, 0.0), (0.0, -500.0), (float("nan"), 0.0)):
        with expect_refusal(ErrorCode.VALUE_INVALID):
            probe(processed_scans / "one", *place)


def test_without_a_result_no_material_is_reported(tmp_path):
    write_judged_products(tmp_path, "none", keep_withheld=True)
    answer = probe(tmp_path, 0.0, 0.0)
    assert answer.permittivity is None
    assert answer.patch is None
    assert answer.nearest == []
    # Only the images of H, V and P may be shown; "p_sigma" is the error of a result.
    maps_of_images = {name for name in MAPS if name[0] in "hvp" and name != "p_sigma"}
    assert {picture.name for picture in read_result(tmp_path).pictures} <= maps_of_images


def test_a_scan_does_not_differ_from_itself(processed_scans):
    comparison = compare(processed_scans / "one", processed_scans / "one")
    assert np.nanmax(np.abs(comparison.p)) == 0
    assert comparison.figures.significant_share == 0
    assert all(pair.sigmas == 0 for pair in comparison.figures.patches if pair.difference)


def test_the_same_scene_with_other_noise_differs_by_noise_alone(processed_scans):
    comparison = compare(processed_scans / "one", processed_scans / "two")
    sigmas_of_patches = [pair.sigmas for pair in comparison.figures.patches if pair.sigmas is not None]
    assert sigmas_of_patches
    # With so few patches none differs by three standard deviations by chance.
    assert max(sigmas_of_patches) < 3
    # Neighbouring pixels share their noise, so that a whole spot may differ by chance.
    assert (comparison.sigmas > 5).mean() < 0.05
    back = compare(processed_scans / "two", processed_scans / "one")
    finite_in_both = np.isfinite(comparison.p) & np.isfinite(back.p)
    assert np.array_equal(comparison.p[finite_in_both], -back.p[finite_in_both])


def test_a_changed_plate_is_found_where_it_lies(processed_scans, tmp_path):
    """In a copy, V of the pixels of PET is made 30 per cent stronger."""
    shutil.copytree(processed_scans / "one" / "products", tmp_path / "changed")
    saved = Pixels(processed_scans / "one" / "products")
    v = saved.v.copy()
    x, y = CENTRE
    inside = np.ix_(abs(saved.y_mm - y) < 15, abs(saved.x_mm - x) < 15)
    v[inside] *= 1.3
    with np.errstate(invalid="ignore", divide="ignore"):
        p = saved.h / v
    write_image(tmp_path / "changed" / "image.npz", replace(saved.images, v=v, p=p))
    comparison = compare(processed_scans / "one", tmp_path / "changed")
    sigmas = np.nan_to_num(comparison.sigmas)
    # A copy shares all its errors: unchanged pixels do not scatter. Errors are then taken as a tenth of what is stated,
    # which is the least.
    least_scatter = 0.1
    assert comparison.figures.scatter == least_scatter
    expected = np.abs(saved.p - p) / (np.sqrt(2) * saved.images.p_sigma) / least_scatter
    assert np.allclose(sigmas[inside], expected[inside], rtol=1e-4)
    # All pixels of the plate differ, and no other one.
    assert sigmas[inside].min() > 0.5
    sigmas[inside] = 0
    assert sigmas.max() == 0


def test_errors_that_both_scans_share_do_not_hide_a_change():
    """Stated errors are three times as large as the scatter of unchanged pixels; a fifth of the pixels has changed."""
    rng = np.random.default_rng(3)
    # Differences in units of their stated errors.
    stated = np.abs(rng.standard_normal(20_000) + 1j * rng.standard_normal(20_000)) / 3
    changed = slice(None, 4000)
    unchanged = slice(4000, None)
    # The change is five standard deviations of the true scatter.
    stated[changed] += 5 / 3
    sigmas = stated / measure_scatter(stated)
    # The scatter of 16,000 values is known to better than 3 per cent.
    assert measure_scatter(stated[unchanged]) == pytest.approx(1 / 3, rel=0.03)
    # 5 per cent of a Rayleigh distribution lie beyond sqrt(-2 ln 0.05) = 2.448. They are fewer here, as the changed
    # pixels widen the scatter a little.
    assert (sigmas[unchanged] > 2.448).mean() == pytest.approx(0.03, abs=0.025)
    assert (sigmas[changed] > SIGNIFICANT_STDS).mean() > 0.95
    # Scatter that is larger than the stated errors is not reduced, and without numbers there is none.
    assert measure_scatter(3 * stated) == 1.0
    assert np.isnan(measure_scatter(np.array([np.nan])))


def test_a_scan_without_a_result_cannot_be_compared(processed_scans, tmp_path):
    write_judged_products(tmp_path / "none", "none")
    with expect_refusal(ErrorCode.NO_DATA):
        compare(processed_scans / "one", tmp_path / "none")


def test_every_map_is_drawn_in_the_size_of_the_image(processed_scans):
    pixels = Pixels(processed_scans / "one" / "products")
    for name in MAPS:
        picture = draw_products(pixels, name)
        assert imread(io.BytesIO(picture.png)).shape[:2] == pixels.valid.shape
        assert picture.low < picture.high
    shared = draw_products(pixels, "h_amplitude", (-20.0, 0.0))
    assert (shared.low, shared.high) == (-20.0, 0.0)
    comparison = compare(processed_scans / "one", processed_scans / "two")
    for name in ("p", "sigmas", "permittivity", "loss"):
        assert imread(io.BytesIO(draw_comparison(comparison, name).png)).shape[:2] == pixels.valid.shape
    for draw in (lambda: draw_products(pixels, "x"), lambda: draw_comparison(comparison, "x")):
        with pytest.raises(DataError):
            draw()


def test_colours_of_differences_in_standard_deviations_reach_twice_the_significant_one(processed_scans):
    """A map without a significant difference looks like one; a larger difference widens the scale."""
    comparison = compare(processed_scans / "one", processed_scans / "two")
    shape = comparison.sigmas.shape
    for sigmas, high in ((0.5, 2 * SIGNIFICANT_STDS), (30.0, 30.0)):
        picture = draw_comparison(replace(comparison, sigmas=np.full(shape, sigmas)), "sigmas")
        assert (picture.low, picture.high) == (0.0, pytest.approx(high))


# What is done to the arrays of an image; those of one dimension are its axes.
DAMAGED = {
    "smaller": lambda image: image | {"h": image["h"][:3, :3]},
    "of words": lambda image: image | {"h": image["h"].astype(str)},
    "empty": lambda image: {k: a[:0] if a.ndim == 1 else a[:0, :0] for k, a in image.items()},
    "of one pixel": lambda image: {k: a[:1] if a.ndim == 1 else a[:1, :1] for k, a in image.items()},
}


@pytest.mark.parametrize("change", DAMAGED.values(), ids=DAMAGED)
def test_images_whose_arrays_do_not_belong_together_are_refused(tmp_path, change):
    folder = write_judged_products(tmp_path / "a", "good")
    with np.load(folder / "image.npz") as stored:
        image = dict(stored)
    np.savez(folder / "image.npz", **change(image))
    for look in (
        lambda: probe(folder, 0.0, 0.0),
        lambda: compare(folder, folder),
        lambda: thumbnail(Pixels(folder)),
    ):
        with pytest.raises(DataError):
            look()


def test_a_pipe_in_place_of_the_image_blocks_no_reader(tmp_path):
    folder = write_judged_products(tmp_path / "a", "good")
    (folder / "image.npz").unlink()
    os.mkfifo(folder / "image.npz")
    for look in (lambda: probe(folder, 0.0, 0.0), lambda: thumbnail(Pixels(folder))):
        with expect_refusal(ErrorCode.FILE_FOREIGN):
            look()
