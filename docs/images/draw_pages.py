"""Takes pictures of the pages for the documents, with Chromium.

`python docs/images/draw_pages.py preview ADDRESS` takes preview.png and preview-phone.png of a running live view.
ADDRESS is the one that `polysight preview SCAN --control` prints, such as http://127.0.0.1:8080/#token=..., while
`polysight scan` runs on a simulated rig.

`python docs/images/draw_pages.py serve ADDRESS SCAN` takes serve.png: a result on the operator's page. ADDRESS is
the one that `polysight serve` prints, SCAN the name of a processed scan.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from urllib.parse import quote

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1]))

from tests.support.page.chromium import DESK, PHONE, Browser, find_chromium  # noqa: E402

# JavaScript: the pictures of the live view; true once rows are in them; the probe at a place right of the middle.
PICTURES = "[...document.querySelectorAll('.view img')]"
ROWS_IN = "parseInt(document.getElementById('images-note').innerText) > 0"
LOOK = (
    "(() => { const c = document.querySelector('canvas');"
    " const key = (k) => c.dispatchEvent(new KeyboardEvent('keydown', {key: k}));"
    " for (let i = 0; i < 22; i++) key('ArrowRight'); key('Enter'); })()"
)


def take_preview(browser: Browser, address: str) -> None:
    """Take both pictures, once the six images are there and the page says that all of it is simulated."""
    for name, size in (("preview", DESK), ("preview-phone", PHONE)):
        browser.set_size(*size)
        browser.open("about:blank")
        browser.wait("location.href == 'about:blank'", "an empty page")
        browser.open(address)
        browser.wait("document.body?.innerText.toUpperCase().includes('SIMULATED')", "that it is simulated")
        browser.wait(ROWS_IN, "the first row in the images")
        browser.wait(f"{PICTURES}.length >= 6 && {PICTURES}.every(i => i.complete && i.naturalWidth > 1)", "images")
        browser.save_screenshot(HERE / f"{name}.png")


def take_serve(browser: Browser, address: str, scan: str) -> None:
    """Take the picture, once the probe has answered."""
    base, _, token = address.partition("/#")
    browser.set_size(*DESK)
    browser.open(f"{base}/scan?scan={quote(scan)}#{token}")
    browser.wait("document.querySelector('#scale img')?.naturalWidth > 1", "the image")
    browser.evaluate(LOOK)
    browser.wait("document.querySelectorAll('#probe-facts dt').length > 3", "the probe")
    browser.save_screenshot(HERE / "serve.png")


if __name__ == "__main__":
    if find_chromium() is None:
        raise SystemExit("no Chromium here: tests/install-tools.sh installs it")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, Browser(Path(folder)) as chromium:
        {"preview": take_preview, "serve": take_serve}[sys.argv[1]](chromium, *sys.argv[2:])
