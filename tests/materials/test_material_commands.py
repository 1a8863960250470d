"""The commands `polysight permittivity`, `polysight concentration` and `polysight classify`."""

import json

import numpy as np
import pytest
from tests.support.refusals import expect_refusal

from polysight.cli.main import main
from polysight.jobs import materials as jobs
from polysight.jobs.materials import report
from polysight.materials import Entry, Library
from polysight_shared.errors import ErrorCode


def test_a_report_of_a_folder_with_images_alone_is_refused(tmp_path):
    (tmp_path / "image.npz").touch()
    with expect_refusal(ErrorCode.FILE_MISSING, "report.html"):
        report(tmp_path)


def test_the_command_judges_classifiers_by_scans_left_out_and_by_pixels_left_out(tmp_path, capsys):
    """A library of two materials that are far from each other, in three scans."""
    rng = np.random.default_rng(4)

    def make_entry(scan: int, name: str, v_over_h: complex) -> Entry:
        drawn_v_over_h = v_over_h + 0.01 * (rng.standard_normal(12) + 1j * rng.standard_normal(12))
        h = (0.7 + 0.01 * rng.standard_normal(12)).astype(np.float32)
        return Entry(
            name=name,
            scan=f"scan {scan}",
            h=h,
            v=np.abs(h * drawn_v_over_h).astype(np.float32),
            p=(1 / drawn_v_over_h).astype(np.complex64),
            incidence_deg=55.0,
            simulated=True,
        )

    entries = []
    for scan in range(3):
        entries += [make_entry(scan, "near", 0.2), make_entry(scan, "far", 0.4 + 0.1j)]
    Library(tuple(entries)).save(tmp_path / "two.npz")
    assert main(["classify", str(tmp_path / "two.npz"), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["source"] == "simulated"
    assert {s["split"] for s in answer["scores"]} == {"whole scans left out, 3 scans", "by pixel (optimistic)"}
    # The materials differ by more than 20 standard deviations of a pixel: no name is wrong.
    assert all(s["pixels"] == 1 for s in answer["scores"])
    assert np.shape(answer["confusion_of_best"]) == (2, 2)
    assert main(["classify", str(tmp_path / "two.npz")]) == 0
    out = capsys.readouterr().out
    assert out.startswith("simulated: 2 materials, 3 scans")
    assert "whole scans left out" in out
    assert "by pixel (optimistic)" in out


@pytest.mark.parametrize(("source", "head"), [("simulated", "simulated: 0 patches"), ("measured", "0 patches")])
def test_names_of_simulated_data_are_headed_as_such(capsys, source, head):
    content = {"incidence_deg": [54.9], "patches": [], "source": source, "contradictions": [], "refused": []}
    jobs._print_names(content, several=False)
    assert capsys.readouterr().out == f"{head} at 54.9 degrees\n"
