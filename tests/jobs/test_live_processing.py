"""Processing of a scan while it runs: after the last row its images are written, unless somebody else is writing."""

from types import SimpleNamespace
from typing import Any

import pytest

from polysight.jobs import process
from polysight.jobs.process import LiveProcessing
from polysight.settings import DEFAULT
from polysight_shared.errors import ConfigError, ErrorCode


def process_row(tmp_path, monkeypatch, code: ErrorCode | None, complete: bool = True) -> int:
    """Add a row, the last one if `complete`; return how often images were written. Writing fails with `code`."""
    calls = 0

    def publish_images(*_: Any) -> None:
        nonlocal calls
        calls += 1
        if code is not None:
            raise ConfigError("no images", "try", "again", code=code)

    monkeypatch.setattr(process, "publish_images", publish_images)
    live = LiveProcessing(tmp_path, DEFAULT)
    pipeline: Any = SimpleNamespace(quality=SimpleNamespace(boards={}), add_row=lambda _: None)
    source: Any = SimpleNamespace(reload=lambda: None, complete=complete)
    live._pipeline = pipeline
    live._source = source
    live.add_row(0)
    return calls


@pytest.mark.parametrize("complete", [True, False])
def test_images_are_written_only_after_the_last_row(tmp_path, monkeypatch, complete):
    no_error = None
    assert process_row(tmp_path, monkeypatch, no_error, complete) == (1 if complete else 0)


def test_images_that_another_program_is_writing_cause_no_error(tmp_path, monkeypatch):
    assert process_row(tmp_path, monkeypatch, ErrorCode.BUSY) == 1


@pytest.mark.parametrize("code", [code for code in ErrorCode if code is not ErrorCode.BUSY])
def test_any_other_error_of_writing_images_is_raised(tmp_path, monkeypatch, code):
    with pytest.raises(ConfigError):
        process_row(tmp_path, monkeypatch, code)
