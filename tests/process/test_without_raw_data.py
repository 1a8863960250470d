"""Images of a scan are formed from its samples also after its raw data was dropped."""

from types import SimpleNamespace

from tests.support.refusals import expect_refusal
from tests.support.store.plain_scan import write_scan

from polysight.jobs import process
from polysight.store import ScanFolder, open_source
from polysight.store.manifest import DroppedFile, RawDropped
from polysight_shared.errors import ErrorCode


def test_images_need_no_raw_data(monkeypatch, tmp_path):
    folder = write_scan(tmp_path / "s")
    files = {name: DroppedFile(f"raw/{name}/0000.bin", 1, "00000000") for name in ("RH", "RV")}
    with ScanFolder.load(folder).writer() as writer:
        writer.append(RawDropped(row=0, take=1, boards=files, products="products", dropped_utc="2026-01-01"))
    with expect_refusal(ErrorCode.NO_DATA, "the raw data of 1 rows was dropped"):
        open_source(folder)
    monkeypatch.setattr(
        process, "process_rows", lambda source, *_: SimpleNamespace(source=source, form_images=lambda: "images")
    )
    pipeline, images = process.form_scan_images(folder)
    assert (pipeline.source.path, images) == (folder, "images")
