"""However a file comes, byte by byte or at once: the same records, once each, in order."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.support.store.facts import typed

from polysight.page.watch import EventTail, ManifestTail
from polysight.store import manifest
from polysight.store.events import read_events
from polysight.store.scan_folder import EVENTS, MANIFEST

CUTS = st.lists(st.floats(0, 1), max_size=12)


@pytest.mark.parametrize(("name", "tail"), [(MANIFEST, ManifestTail), (EVENTS, EventTail)])
def test_any_pieces_give_the_whole(finished, tmp_path_factory, name, tail):
    raw = (finished / name).read_bytes()
    whole = manifest.parse(raw).facts if name == MANIFEST else read_events(finished / name).events
    assert len(whole) > 4

    @settings(max_examples=20)
    @given(CUTS)
    def pieces(cuts: list[float]) -> None:
        path = tmp_path_factory.mktemp("pieces") / name
        tailing, found = tail(path), []
        ends = sorted({int(c * len(raw)) for c in cuts} | {len(raw)})
        for before, end in zip([0, *ends], ends, strict=False):
            with path.open("ab") as f:
                f.write(raw[before:end])
            found += tailing.look()
            assert found == whole[: len(found)]
        assert found == whole
        assert tailing.look() == []

    pieces()


def test_another_file_in_its_place_is_read_from_the_beginning(finished, tmp_path):
    path = tmp_path / MANIFEST
    raw = (finished / MANIFEST).read_bytes()
    path.write_bytes(raw)
    tail = ManifestTail(path)
    first = tail.look()
    path.unlink()
    assert tail.look() == []
    first_line = raw.splitlines(keepends=True)[0]
    (tmp_path / "new").write_bytes(first_line)
    (tmp_path / "new").rename(path)
    assert tail.look() == first[:1]
    assert tail.file.replaced


def test_another_and_longer_file_is_found_after_a_single_look(finished, tmp_path):
    """Before anything else was appended to the one that was read."""
    path = tmp_path / MANIFEST
    raw = (finished / MANIFEST).read_bytes()
    others = [{"fact": "scan_ended", "reason": "another scan" * 50} for _ in raw.splitlines()]
    path.write_bytes(raw)
    tail = ManifestTail(path)
    assert len(tail.look()) == len(others)
    (tmp_path / "new").write_bytes(b"".join(map(manifest.encode_line, others)))
    (tmp_path / "new").rename(path)
    assert tail.look() == [typed(fact) for fact in others]
    assert tail.file.replaced
