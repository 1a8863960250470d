"""The documented reverse proxy in front of a server, in a real browser: pages, live updates, commands."""

import os
import re
import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.support.page.asking import TOKEN
from tests.support.page.chromium import Browser
from tests.support.page.live_view import open_control, serve_folder
from tests.support.paths import REPO
from tests.support.processes import wait_for

from polysight.catalogue import read_notes
from polysight.serve.guard import Access

# Browsers resolve every name under `localhost` to this machine.
NAME = "lab.localhost"
# Options of Caddy for a test: it uses no system port, gets no certificate from the network, and installs none.
GLOBAL_OPTIONS = """{
  admin off
  skip_install_trust
  auto_https disable_redirects
}
"""


def find_free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def read_example(port: int, served_port: int) -> str:
    """Return the Caddyfile of the how-to with these ports, and with a certificate that Caddy makes itself."""
    page = (REPO / "docs/how-to/reverse-proxy.md").read_text(encoding="utf-8")
    block = re.search(r"```text\n(.*?)```", page, re.DOTALL)
    assert block is not None
    example = block.group(1).replace("lab.example.org {", f"{NAME}:{port} {{\n  tls internal")
    return GLOBAL_OPTIONS + example.replace("127.0.0.1:8080", f"127.0.0.1:{served_port}")


@pytest.fixture
def scans(finished_scan: Path, tmp_path: Path) -> Path:
    shutil.copytree(finished_scan, tmp_path / "scans" / "one")
    return tmp_path / "scans"


@pytest.fixture
def address(scans: Path, tmp_path: Path, browser: Browser) -> Iterator[str]:
    """The address of a server behind the proxy."""
    caddy = shutil.which("caddy")
    if caddy is None:
        pytest.skip("no caddy here: sudo apt-get install caddy")
    port = find_free_port()
    places = {f"XDG_{kind}_HOME": str(tmp_path / kind) for kind in ("DATA", "CONFIG")}
    # As `polysight serve --allow-host` makes it: all clients have this machine's address.
    access = Access(TOKEN, loopback=False, hosts=(NAME,), control=True)
    with serve_folder(scans, access=access) as view, (tmp_path / "caddy.log").open("wb") as log:
        (tmp_path / "Caddyfile").write_text(read_example(port, view.port))
        command = [caddy, "run", "--config", str(tmp_path / "Caddyfile")]
        proxy = subprocess.Popen(command, env=os.environ | places, stdout=log, stderr=log)
        browser.call("Security.setIgnoreCertificateErrors", ignore=True)
        try:
            wait_for(lambda: _is_listening(port), "the proxy")
            yield f"https://{NAME}:{port}"
        finally:
            browser.open("about:blank")
            browser.call("Security.setIgnoreCertificateErrors", ignore=False)
            proxy.terminate()
            proxy.wait()


def _is_listening(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port)).close()
    except OSError:
        return False
    return True


def test_behind_the_documented_proxy_everything_works_with_the_token(browser, address, scans):
    browser.forget(address)
    browser.visit(f"{address}/watch?scan=one")
    browser.wait("document.getElementById('token-bar')", "that it asks for the token")
    browser.visit(f"{address}/watch?scan=one#token={TOKEN}")
    browser.wait("document.querySelectorAll('.view img').length == 6", "the live view's events and pictures")

    browser.visit(f"{address}/scan?scan=one")
    browser.wait("document.getElementById('save-notes')?.checkVisibility()", "the notes")
    browser.fill("#notes-text", "from outside")
    browser.click("#save-notes")
    wait_for(lambda: read_notes(scans / "one").notes == "from outside", "the notes")

    with open_control(scans / "one") as stop:
        browser.click("#running button.danger")
        browser.click("#confirm button[value=yes]")
        wait_for(lambda: stop.now, "the abort")
    browser.check_whole(address)
    cookies = browser.call("Network.getCookies", urls=[address])["cookies"]
    assert [cookie["secure"] for cookie in cookies] == [True]
