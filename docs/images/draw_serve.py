"""Takes docs/images/serve.png: a scan's result on the operator's page, with Chromium.

`python docs/images/draw_serve.py http://127.0.0.1:8080/#token=... SCAN`, the address that `polysight serve` prints and
the name of a processed scan. A third word is the folder to write to.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from urllib.parse import quote

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1]))

from tests.support.page.chromium import DESK, Browser, find_chromium  # noqa: E402

LOOK = (
    "(() => { const c = document.querySelector('canvas');"
    " const key = (k) => c.dispatchEvent(new KeyboardEvent('keydown', {key: k}));"
    " for (let i = 0; i < 22; i++) key('ArrowRight'); key('Enter'); })()"
)


def take(address: str, scan: str, to: Path) -> None:
    """The picture, once the probe has answered."""
    if find_chromium() is None:
        raise SystemExit("no Chromium here: tests/install-tools.sh installs it")
    base, _, token = address.partition("/#")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, Browser(Path(folder)) as browser:
        browser.size(*DESK)
        browser.open(f"{base}/scan?scan={quote(scan)}#{token}")
        browser.wait("document.querySelector('#scale img')?.naturalWidth > 1", "the image")
        browser.value(LOOK)
        browser.wait("document.querySelectorAll('#probe-facts dt').length > 3", "the probe")
        browser.screenshot(to / "serve.png")


if __name__ == "__main__":
    take(sys.argv[1], sys.argv[2], Path(sys.argv[3]) if len(sys.argv) > 3 else HERE)
