"""The commands `polysight permittivity`, `polysight concentration` and `polysight classify`."""

import json

import numpy as np
from tests.support.refusals import expect_refusal

from polysight.cli.main import main
from polysight.jobs.materials import report
from polysight.materials import Entry, Library
from polysight_shared.errors import ErrorCode


def test_a_report_of_images_alone_lists_the_missing_results(tmp_path):
    (tmp_path / "image.npz").touch()
    with expect_refusal(ErrorCode.FILE_MISSING, "report.html"):
        report(tmp_path)


def test_classifiers_are_judged_under_both_splits_as_typed(tmp_path, capsys):
    rng = np.random.default_rng(4)

    def make_entry(scan: int, name: str, q: complex) -> Entry:
        inverse = q + 0.01 * (rng.standard_normal(12) + 1j * rng.standard_normal(12))
        h = (0.7 + 0.01 * rng.standard_normal(12)).astype(np.float32)
        p = (1 / inverse).astype(np.complex64)
        return Entry(name, f"scan {scan}", h, np.abs(h * inverse).astype(np.float32), p, 55.0, simulated=True)

    entries = [make_entry(i, name, q) for i in range(3) for name, q in (("near", 0.2), ("far", 0.4 + 0.1j))]
    Library(tuple(entries)).save(tmp_path / "two.npz")
    assert main(["classify", str(tmp_path / "two.npz"), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["source"] == "simulated"
    assert {s["split"] for s in answer["scores"]} == {"whole scans left out, 3 scans", "by pixel (optimistic)"}
    assert all(s["pixels"] > 0.95 for s in answer["scores"])
    assert np.shape(answer["confusion_of_best"]) == (2, 2)
    assert main(["classify", str(tmp_path / "two.npz")]) == 0
    out = capsys.readouterr().out
    assert out.startswith("simulated: 2 materials, 3 scans")
    assert "whole scans left out" in out
    assert "by pixel (optimistic)" in out
