"""Takes docs/images/preview.png and preview-phone.png of a running live view, with Chromium.

`python docs/images/draw_preview.py http://127.0.0.1:8080/#token=...`, the address that `polysight preview SCAN
--control` prints, while `polysight scan` runs on a simulated rig. A second word is the folder to write to.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1]))

from tests.support.page.chromium import DESK, PHONE, Browser, find_chromium  # noqa: E402

PICTURES = "[...document.querySelectorAll('.view img')]"
ROWS_IN = "parseInt(document.getElementById('images-note').innerText) > 0"


def take(address: str, to: Path) -> None:
    """Both pictures, once the six images are there and the page says that all of it is simulated."""
    if find_chromium() is None:
        raise SystemExit("no Chromium here: tests/install-tools.sh installs it")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, Browser(Path(folder)) as browser:
        for name, size in (("preview", DESK), ("preview-phone", PHONE)):
            browser.size(*size)
            browser.open("about:blank")
            browser.wait("location.href == 'about:blank'", "an empty page")
            browser.open(address)
            browser.wait("document.body?.innerText.toUpperCase().includes('SIMULATED')", "that it is simulated")
            browser.wait(ROWS_IN, "the first row in the images")
            browser.wait(f"{PICTURES}.length >= 6 && {PICTURES}.every(i => i.complete && i.naturalWidth > 1)", "images")
            browser.screenshot(to / f"{name}.png")


if __name__ == "__main__":
    take(sys.argv[1], Path(sys.argv[2]) if len(sys.argv) > 2 else HERE)
