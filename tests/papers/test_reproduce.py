"""`polysight reproduce` makes tables and figures of the POLySIGHT paper from simulated scans.

Each table or figure is an item. Its files, and one page for all items, have the published values for comparison and say
that the others are simulated.
"""

import csv
import inspect
import json
import re
import signal
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from polysight.cli.main import main
from polysight.polarimetry import fresnel, ratio_from_permittivity
from polysight_papers.sensys2026 import images, permittivities, run as report, synchronisation
from polysight_papers.sensys2026.item import Item, Picture, Run, Table, new_figure, published_values, style_axes, table2
from polysight_shared.config import load_instrument
from polysight_shared.errors import DataError

# Exit status of a run in which an item could not be made, though others were.
AN_ITEM_FAILED = 1
# The exit status that shells give to a program that Ctrl-C ended.
INTERRUPTED = 128 + signal.SIGINT


def make_item(key="fig3", value=1.0):
    figure = new_figure(3, 2)
    ax = figure.subplots()
    ax.plot([0, value])
    style_axes(ax, "a line", "x (mm)", "y (mm)")
    table = Table("numbers", ("what", "published", "simulated"), (("one, two", "1", f"{value}"),))
    return Item(
        key=key,
        title=f"Fig. 3: {key}",
        text=("text & more",),
        tables=(table,),
        pictures={"line": Picture(figure, "a line")},
        data={"n": value},
    )


def test_every_figure_is_stamped_as_simulated(monkeypatch, tmp_path):
    stamps = []
    print_png = FigureCanvasAgg.print_png

    def print_png_and_note_the_stamp(canvas, *args, **kwargs):
        stamps.append(canvas.figure.get_suptitle())
        return print_png(canvas, *args, **kwargs)

    monkeypatch.setattr(FigureCanvasAgg, "print_png", print_png_and_note_the_stamp)
    report.write_item(tmp_path, make_item())
    assert stamps == ["SIMULATED"]


def test_the_page_loads_no_other_file_says_that_all_is_simulated_and_names_missing_items(tmp_path, monkeypatch):
    def fail(_):
        raise DataError("no such image", "it was not made")

    makers = {"fig3": lambda _: make_item(), "fig20": fail, "fig21": lambda _: make_item("fig21")}
    monkeypatch.setattr(report, "MAKERS", makers)
    assert main(["reproduce", "--out", str(tmp_path), "fig3", "fig20"]) == AN_ITEM_FAILED
    page = (tmp_path / "reproduce.html").read_text(encoding="utf-8")
    # Pictures are embedded, and links lead to places on the page: no other file is loaded.
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    for figure in re.findall(r"<figure>.*?</figure>", page, re.DOTALL):
        assert "Simulated." in figure
    for caption in re.findall(r"<caption>.*?</caption>", page, re.DOTALL):
        assert "(simulated)" in caption
    assert "could not be made" in page
    assert "no such image" in page
    assert "Not made in this run: fig21" in page
    _, after_heading = page.split("not reproduced yet:")
    missing_items, *_ = after_heading.split("</p>")
    for key in set(report.TITLES) - set(makers):
        assert key in missing_items


def interrupt(_):
    raise KeyboardInterrupt


def test_an_interrupted_run_writes_a_page_with_the_items_made_before(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "MAKERS", {"fig3": lambda _: make_item(), "fig20": interrupt})
    assert main(["reproduce", "--out", str(tmp_path)]) == INTERRUPTED
    page = (tmp_path / "reproduce.html").read_text(encoding="utf-8")
    assert 'id="fig3"' in page
    assert "Not made in this run: fig20" in page


def test_a_run_names_items_of_an_earlier_run_that_are_not_on_its_page(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(report, "MAKERS", {"fig3": lambda _: make_item(), "fig20": interrupt})
    assert main(["reproduce", "--out", str(tmp_path)]) == INTERRUPTED
    monkeypatch.setattr(report, "MAKERS", {"fig21": lambda _: make_item("fig21")})
    capsys.readouterr()
    assert main(["reproduce", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "1 item (simulated)" in out
    assert "not on this page: fig3 of an earlier run" in out


def test_the_json_and_csv_files_of_an_item_have_its_numbers(tmp_path):
    report.write_item(tmp_path, make_item(value=2.5))
    content = json.loads((tmp_path / "fig3.json").read_text())
    assert content["simulated"] is True
    assert content["n"] == 2.5
    title, _, numbers = csv.reader((tmp_path / "fig3.csv").read_text().splitlines())
    assert title == ["simulated: numbers"]
    assert numbers == ["one, two", "1", "2.5"]
    # An empty figure has 852 bytes, and this one 15,582 (measured).
    assert (tmp_path / "figures" / "fig3-line.png").stat().st_size > 1000


def test_an_unknown_item_is_refused_by_name(tmp_path, capsys):
    assert main(["reproduce", "--out", str(tmp_path / "r"), "fig99"]) != 0
    assert "fig99" in capsys.readouterr().err
    assert not (tmp_path / "r").exists()


def test_a_wrong_rig_file_is_refused_before_any_item(tmp_path, capsys):
    rig = tmp_path / "rig.toml"
    rig.write_text("[chirp]\n")
    assert main(["reproduce", "--config", str(rig), "--out", str(tmp_path / "r"), "fig99"]) != 0
    message = capsys.readouterr().err
    assert str(rig) in message
    assert "fig99" not in message


def test_published_numbers_are_in_the_data_file_and_not_in_the_code():
    folder = report.Path(report.__file__).parent
    published = published_values()
    accuracies = [group["all_percent"] for group in published["classification"].values()]
    # The number 100 occurs in the code for other reasons.
    numbers = [str(percent) for percent in accuracies if percent < 100]
    numbers.append(str(published["sugar_median_error_percent"]))
    numbers.append(str(published["location_variance"]["PET"]["real"]))
    numbers.append(str(published["location_variance"]["ceramic"]["loss"]))
    for file in folder.glob("*.py"):
        text = file.read_text(encoding="utf-8")
        assert not [number for number in numbers if number in text], file.name


def test_contrast_of_materials_at_each_incidence_angle_follows_fresnel_s_equations():
    """Fig. 16 shows |H| at 0 degrees, and |P| at 55 and 60 degrees; the medians over a material's pixels are tested."""
    # The largest difference in this test is 0.07 dB (measured).
    max_difference_db = 1.5
    levels = report.MAKERS["fig16"](Run(quick=True)).data["level_db"]
    materials = {material.name: material.permittivity for material in table2()}
    for name in levels["0"]:
        r_s, _ = fresnel(materials[name], 0.0)
        h_db = 20 * np.log10(abs(r_s))
        assert np.median(levels["0"][name]) == pytest.approx(h_db, abs=max_difference_db)
        for angle_deg in (55, 60):
            ratio = ratio_from_permittivity(materials[name], np.radians(angle_deg))
            p_db = 20 * np.log10(abs(ratio))
            assert np.median(levels[str(angle_deg)][name]) == pytest.approx(p_db, abs=max_difference_db)


@pytest.mark.parametrize("key", ["fig3", "fig21", "table2"])
def test_items_are_made_and_compared_with_the_published_values(key, tmp_path):
    item = report.MAKERS[key](Run(quick=True))
    assert item.key == key
    assert item.tables
    assert item.pictures
    assert report.write_item(tmp_path, item)
    if key == "table2":
        errors = [m["relative_error"] for m in item.data["materials"] if "relative_error" in m]
        # All 36 rows except that of metal.
        assert len(errors) == 36 - 1
        # The largest error is 2.4 % (measured).
        assert max(errors) < 0.1
        assert "published ε′" in item.tables[0].head
    if key == "fig21":
        assert item.data["published_median_error_percent"] == 1.548
        # A limit of twice the published error; here it is 0.8 % (measured).
        assert 0 < item.data["median_error_percent"] < 3


def test_the_high_pass_filter_is_fitted_to_tones_in_the_passband_alone(monkeypatch):
    """Of three start frequencies of the receiver only one puts the tone of the direct path into the passband."""
    # With the first one the tone is near 0 Hz; with the last one it is beyond the passband and aliases.
    offsets_hz = (0.0, synchronisation.USUAL_HZ, 1.9e6)
    monkeypatch.setattr(synchronisation, "OFFSETS_HZ", offsets_hz)
    run = Run(quick=True)
    chirp = load_instrument(run.config).chirp
    if_hz, amplitude, example = synchronisation._sweep_start_frequencies(run, chirp)
    assert if_hz.min() > 0.05 * chirp.sample_rate_hz
    assert if_hz.max() < 0.9 * chirp.sample_rate_hz
    assert if_hz.shape == amplitude.shape
    _, chirps_of_one_offset, _ = example.shape
    assert if_hz.size < len(offsets_hz) * chirps_of_one_offset


@pytest.fixture(scope="module")
def small_scan():
    """Images and range profiles, before and after synchronisation, of the scan of Fig. 12 and 15 on a small grid."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(images, "GRID", {"columns": 13, "rows": 13, "step_x_mm": 10.0, "step_y_mm": 6.0})
        # The function itself, not its cache.
        return inspect.unwrap(synchronisation.sync_scan)(Run(quick=True))


def test_range_profiles_show_the_plane_only_after_synchronisation(small_scan):
    """Range is the excess over the direct path. The resolution is 86 mm, and a bin of the profiles 16 mm."""
    echo_m = 0.315
    # The response of the direct path itself ends before that.
    beyond_direct_path = small_scan.range_m > 0.15
    before_sync, after_sync = small_scan.profiles
    assert before_sync.shape == after_sync.shape == (13, small_scan.range_m.size)
    echo_bins = after_sync[:, beyond_direct_path].argmax(axis=1)
    peaks_m = small_scan.range_m[beyond_direct_path][echo_bins]
    # About half of the resolution; here it is less than half a bin (measured).
    assert np.abs(peaks_m - echo_m).max() < 0.05
    # The direct path is the largest peak. After synchronisation it is at bin 0, before it in a bin that changes from
    # position to position: the bins of 13 positions lie up to 129 apart (measured).
    assert not after_sync.argmax(axis=1).any()
    assert np.ptp(before_sync.argmax(axis=1)) > 20


def test_an_image_forms_only_after_synchronisation(small_scan):
    contrasts = [np.abs(image).max() / np.median(np.abs(image)) for image in small_scan.images]
    contrast_before, contrast_after = contrasts
    # Without an image the largest of the random pixels is 2.7 times their median; with one it is 130 times (measured).
    assert contrast_after > 2 * contrast_before


@pytest.mark.parametrize("key", ["fig12", "fig15"])
def test_figures_of_synchronisation_are_made(key, small_scan, tmp_path, monkeypatch):
    monkeypatch.setattr(synchronisation, "sync_scan", lambda _: small_scan)
    assert report.write_item(tmp_path, report.MAKERS[key](Run(quick=True)))


def test_permittivities_at_many_locations_count_only_pixels_of_pet_and_ceramic_with_a_ratio(monkeypatch):
    """Fig. 17 leaves out copper, the metal reference, and patches that are on no plate."""
    p = np.full((8, 8), 2.0 + 0.1j)
    p[0, 0] = np.nan
    on_no_plate = None
    names = ("copper", "PET", on_no_plate, "ceramic")
    patches = []
    for i, name in enumerate(names):
        # Each patch is two rows high and one pixel wider than the one before.
        interior = np.zeros(p.shape, bool)
        interior[2 * i : 2 * i + 2, : 2 + i] = True
        truth = None
        if name is not None:
            truth = SimpleNamespace(name=name)
        patches.append(SimpleNamespace(truth=truth, patch=SimpleNamespace(interior=interior)))
    result = SimpleNamespace(patches=patches, p=p, theta_rad=np.radians(55.0))
    monkeypatch.setattr(permittivities, "simulate_scan", lambda *_, **__: nullcontext((None, None)))
    monkeypatch.setattr(permittivities, "process_scan", lambda *_: SimpleNamespace(result=result))
    # A quick run has three placements of the plates, which all have this result.
    data = permittivities.fig17(Run(quick=True)).data
    assert data["variances"]["PET pixels"] == [2 * 3] * 3
    assert data["variances"]["ceramic pixels"] == [2 * 5] * 3
