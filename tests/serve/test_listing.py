"""Changes of the list: a client that applies them has the server's list, whatever it had before."""

import random

from tests.support.page.asking import get
from tests.support.page.live_view import serve_folder
from tests.support.products import write_judged_products

from polysight.serve.site import ChangingList, ListedScan

# Any number: it makes the sequence of requests the same in each run.
SEED = 37


def make_scan(name: str, size: int) -> ListedScan:
    return ListedScan(name=name, seconds=0.0, state="finished", bytes=size)


def test_a_page_that_applies_the_changes_has_the_list_of_the_server():
    rng = random.Random(SEED)
    changing = ChangingList()
    # Pages that send requests in random order; the last one begins with the stamp of another server.
    pages: list[dict[str, ListedScan]] = [{}, {}, {}]
    stamps = ["", "", "00000000-3"]
    for _ in range(200):
        # Scans appear, disappear, and change their size, 0 or 1.
        names = rng.sample("abcdef", rng.randrange(7))
        listed = [make_scan(name, rng.randrange(2)) for name in names]
        page = rng.randrange(3)
        changes = changing.update(listed, stamps[page])
        if changes.whole:
            pages[page] = {}
        for name in changes.gone:
            pages[page].pop(name, None)
        pages[page] |= {scan.name: scan for scan in changes.scans}
        stamps[page] = changes.stamp
        assert pages[page] == {scan.name: scan for scan in listed}


def test_the_stamp_of_every_earlier_state_is_accepted_and_no_other_text():
    """A stamp is the server's random origin and the number of the list's state: "3f2a90c1-11"."""
    changing = ChangingList()
    stamps = [changing.update([make_scan("a", size)], "").stamp for size in range(11)]
    newest = [make_scan("a", 10)]
    assert not any(changing.update(newest, stamp).whole for stamp in stamps)
    origin = stamps[0].partition("-")[0]
    # \u0663 is an Arabic 3; Python's `int` reads it as a number, and refuses one of 5000 digits.
    for number in ("", "-1", "1e1", "\u0663", 5000 * "9"):
        assert changing.update(newest, f"{origin}-{number}").whole


def test_a_list_that_is_unchanged_is_not_sent_again(tmp_path):
    for name in ("one", "two"):
        write_judged_products(tmp_path / name / "products", "care")
    with serve_folder(tmp_path) as view:
        listing = get(view, "/api/scans")
        # The size of a folder comes later than its name, as a change of the list.
        while any(scan["bytes"] is None for scan in listing["scans"]):
            listing = get(view, "/api/scans")
        assert listing["whole"]
        same = get(view, f"/api/scans?since={listing['stamp']}")
        assert not same["whole"]
        assert same["scans"] == []
        assert same["gone"] == []
        assert get(view, "/api/scans?since=wrong")["whole"]
