"""The page and its files: every item has the published value, and everything is called simulated."""

import csv
import json
import re
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


def make_item(key="fig3", value=1.0):
    figure = new_figure(3, 2)
    ax = figure.subplots()
    ax.plot([0, value])
    style_axes(ax, "a line", "x (mm)", "y (mm)")
    table = Table("numbers", ("what", "published", "simulated"), (("one, two", "1", f"{value}"),))
    return Item(key, f"Fig. 3: {key}", ("text & more",), (table,), {"line": Picture(figure, "a line")}, {"n": value})


def test_every_figure_is_stamped(monkeypatch, tmp_path):
    texts = []
    save = FigureCanvasAgg.print_png

    def spy(canvas, *args, **kwargs):
        texts.append(canvas.figure.get_suptitle())
        return save(canvas, *args, **kwargs)

    monkeypatch.setattr(FigureCanvasAgg, "print_png", spy)
    report.write_item(tmp_path, make_item())
    assert texts == ["SIMULATED"]


def test_the_page_is_one_file_that_calls_everything_simulated_and_names_what_is_missing(tmp_path, monkeypatch):
    def broken(_):
        raise DataError("no such image", "it was not made")

    makers = {"fig3": lambda _: make_item(), "fig20": broken, "fig21": lambda _: make_item("fig21")}
    monkeypatch.setattr(report, "MAKERS", makers)
    assert main(["reproduce", "--out", str(tmp_path), "fig3", "fig20"]) == 1
    page = (tmp_path / "reproduce.html").read_text(encoding="utf-8")
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    for figure in re.findall(r"<figure>.*?</figure>", page, re.DOTALL):
        assert "Simulated." in figure
    for caption in re.findall(r"<caption>.*?</caption>", page, re.DOTALL):
        assert "(simulated)" in caption
    assert "could not be made" in page
    assert "no such image" in page
    assert "Not made in this run: fig21" in page
    missing = page.split("not reproduced yet:")[1].split("</p>")[0]
    assert all(key in missing for key in report.TITLES if key not in makers)


def test_a_run_that_is_interrupted_has_a_page_and_a_second_one_names_what_is_not_on_its_page(
    tmp_path, monkeypatch, capsys
):
    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(report, "MAKERS", {"fig3": lambda _: make_item(), "fig20": interrupt})
    assert main(["reproduce", "--out", str(tmp_path)]) == 130
    page = (tmp_path / "reproduce.html").read_text(encoding="utf-8")
    assert 'id="fig3"' in page
    assert "Not made in this run: fig20" in page

    monkeypatch.setattr(report, "MAKERS", {"fig21": lambda _: make_item("fig21")})
    capsys.readouterr()
    assert main(["reproduce", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "1 item (simulated)" in out
    assert "not on this page: fig3 of an earlier run" in out


def test_the_files_hold_the_numbers(tmp_path):
    report.write_item(tmp_path, make_item(value=2.5))
    content = json.loads((tmp_path / "fig3.json").read_text())
    assert content["simulated"] is True
    assert content["n"] == 2.5
    rows = list(csv.reader((tmp_path / "fig3.csv").read_text().splitlines()))
    assert rows[0] == ["simulated: numbers"]
    assert rows[2] == ["one, two", "1", "2.5"]
    assert (tmp_path / "figures" / "fig3-line.png").stat().st_size > 1000


def test_an_unknown_item_is_refused_by_name(tmp_path, capsys):
    assert main(["reproduce", "--out", str(tmp_path / "r"), "fig99"]) != 0
    assert "fig99" in capsys.readouterr().err
    assert not (tmp_path / "r").exists()


def test_a_wrong_rig_file_is_refused_before_any_item(tmp_path, capsys):
    rig = tmp_path / "rig.toml"
    rig.write_text("[chirp]\n")
    assert main(["reproduce", "--config", str(rig), "--out", str(tmp_path / "r"), "fig99"]) != 0
    said = capsys.readouterr().err
    assert str(rig) in said
    assert "fig99" not in said


def test_published_numbers_stand_in_the_data_file_alone():
    folder = report.Path(report.__file__).parent
    numbers = [str(g["all_percent"]) for g in published_values()["classification"].values() if g["all_percent"] < 100]
    numbers += [str(published_values()["sugar_median_error_percent"]), "0.0021", "0.1081"]
    for file in folder.glob("*.py"):
        text = file.read_text(encoding="utf-8")
        assert not [n for n in numbers if n in text], file.name


def test_contrast_under_each_angle_is_that_of_eq_2():
    """The middle pixel is |H| at 0 degrees, |P| at 55 and 60 degrees, of the published permittivity (fig. 16)."""
    levels = report.MAKERS["fig16"](Run(quick=True)).data["level_db"]
    materials = {material.name: material.permittivity for material in table2()}
    for name in levels["0"]:
        r_s, _ = fresnel(materials[name], 0.0)
        assert np.median(levels["0"][name]) == pytest.approx(20 * np.log10(abs(r_s)), abs=1.5)
        for angle in (55, 60):
            ratio = ratio_from_permittivity(materials[name], np.radians(angle))
            assert np.median(levels[str(angle)][name]) == pytest.approx(20 * np.log10(abs(ratio)), abs=1.5)


@pytest.mark.parametrize("key", ["fig3", "fig21", "table2"])
def test_items_are_made_and_compared_with_the_published_values(key, tmp_path):
    item = report.MAKERS[key](Run(quick=True))
    assert item.key == key
    assert item.tables
    assert item.pictures
    assert report.write_item(tmp_path, item)
    if key == "table2":
        errors = [m["relative_error"] for m in item.data["materials"] if "relative_error" in m]
        assert len(errors) == 35
        assert max(errors) < 0.1
        assert "published ε′" in item.tables[0].head
    if key == "fig21":
        assert item.data["published_median_error_percent"] == 1.548
        assert 0 < item.data["median_error_percent"] < 3


def test_a_filter_is_fitted_to_tones_in_the_passband_alone(monkeypatch):
    """At the first start frequency tones are near zero, at the last they alias."""
    monkeypatch.setattr(synchronisation, "OFFSETS_HZ", (0.0, synchronisation.USUAL_HZ, 1.9e6))
    run = Run(quick=True)
    chirp = load_instrument(run.config).chirp
    if_hz, amplitude, example = synchronisation._sweep_start_frequencies(run, chirp)
    assert if_hz.min() > 0.05 * chirp.sample_rate_hz
    assert if_hz.max() < 0.9 * chirp.sample_rate_hz
    assert if_hz.shape == amplitude.shape
    assert if_hz.size < 3 * example.shape[1]


@pytest.fixture(scope="module")
def small_scan():
    """The scan of Fig. 12 and 15 on a small grid."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(images, "GRID", {"columns": 13, "rows": 13, "step_x_mm": 10.0, "step_y_mm": 6.0})
        return synchronisation.sync_scan.__wrapped__(Run(quick=True))


def test_range_profiles_show_the_plane_only_after_synchronisation(small_scan):
    """The plane is 0.315 m behind the direct path; a cell of the range is 86 mm wide, a bin 16 mm."""
    behind = small_scan.range_m > 0.15
    before_sync, after_sync = small_scan.profiles
    assert before_sync.shape == after_sync.shape == (13, small_scan.range_m.size)
    peaks_m = small_scan.range_m[behind][after_sync[:, behind].argmax(axis=1)]
    assert np.abs(peaks_m - 0.315).max() < 0.05
    assert not after_sync.argmax(axis=1).any()
    assert np.ptp(before_sync.argmax(axis=1)) > 20


def test_an_image_forms_only_after_synchronisation(small_scan):
    contrast_before, contrast_after = (np.abs(image).max() / np.median(np.abs(image)) for image in small_scan.images)
    assert contrast_after > 2 * contrast_before


@pytest.mark.parametrize("key", ["fig12", "fig15"])
def test_figures_of_synchronisation_are_made(key, small_scan, tmp_path, monkeypatch):
    monkeypatch.setattr(synchronisation, "sync_scan", lambda _: small_scan)
    assert report.write_item(tmp_path, report.MAKERS[key](Run(quick=True)))


def test_location_independence_counts_pixels_of_its_materials_alone(monkeypatch):
    """Copper, and a patch on no plate, are left out; of each material the pixels that have a ratio are counted."""
    p = np.full((8, 8), 2.0 + 0.1j)
    p[0, 0] = np.nan
    names = ("copper", "PET", None, "ceramic")
    patches = []
    for i, name in enumerate(names):
        interior = np.zeros(p.shape, bool)
        interior[2 * i : 2 * i + 2, : 2 + i] = True
        truth = None if name is None else SimpleNamespace(name=name)
        patches.append(SimpleNamespace(truth=truth, patch=SimpleNamespace(interior=interior)))
    result = SimpleNamespace(patches=patches, p=p, theta_rad=np.radians(55.0))
    monkeypatch.setattr(permittivities, "simulate_scan", lambda *_, **__: nullcontext((None, None)))
    monkeypatch.setattr(permittivities, "process_scan", lambda *_: SimpleNamespace(result=result))
    data = permittivities.fig17(Run(quick=True)).data
    assert data["variances"]["PET pixels"] == [6, 6, 6]
    assert data["variances"]["ceramic pixels"] == [10, 10, 10]
