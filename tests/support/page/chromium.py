"""Headless Chromium, driven over its DevTools protocol, with the methods that these tests need.

Protocol: https://chromedevtools.github.io/devtools-protocol/ (Page, Runtime, Emulation).
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import signal
import subprocess
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import Any
from urllib.request import urlopen

from websockets.sync.client import connect

from tests.support.paths import REPO
from tests.support.processes import HANG_S, LIMIT_S, read_idle_s, wait_for

# Windows: width and height in CSS pixels, and True for a phone. Many phones have this size.
DESK = (1400, 900, False)
PHONE = (390, 844, True)


def find_chromium() -> str | None:
    """Path of the browser's program; None if it is not installed.

    The headless shell is preferred: it cannot draw windows, and needs a third of the processor time for a page.
    """
    for program in ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome"):
        path = shutil.which(program)
        if path is not None:
            return path
    return None


def find_axe() -> Path | None:
    """The accessibility checker axe-core, as npm installs it in the checkout; None if it is not installed."""
    path = REPO / "node_modules" / "axe-core" / "axe.min.js"
    if not path.is_file():
        return None
    return path


class NavigatedError(Exception):
    """The browser went to another page during the request, which must be repeated."""


class Browser:
    """One window of a browser with its own profile.

    Parameters
    ----------
    folder
        Folder for the profile and the browser's log.
    """

    def __init__(self, folder: Path) -> None:
        program = find_chromium()
        assert program is not None
        profile = folder / "profile"
        command = [
            program,
            "--headless=new",
            # In a container a program may not make a sandbox, and there is little shared memory.
            "--no-sandbox",
            "--disable-dev-shm-usage",
            "--disable-gpu",
            "--no-first-run",
        ]
        # With port 0 the browser chooses one, and writes it into the file DevToolsActivePort of its profile.
        command += ["--disable-background-networking", "--disable-component-update", "--remote-debugging-port=0"]
        command += [f"--user-data-dir={profile}", "about:blank"]
        self._log = (folder / "chromium.log").open("wb")
        # It gets a process group of its own, by which all its processes are ended: Debian starts the headless shell by
        # a script, and a signal to the script alone would not reach it.
        self._process = subprocess.Popen(command, stdout=self._log, stderr=self._log, start_new_session=True)
        try:
            address = self._wait_for_page(profile / "DevToolsActivePort")
            self._stack = ExitStack()
            self._socket = self._stack.enter_context(
                connect(address, max_size=None, open_timeout=HANG_S, ping_interval=None)
            )
        except BaseException:
            self._end()
            raise
        # Number of the last request to the browser.
        self._count = 0
        # Errors that the page reported, and addresses that it requested.
        self.errors: list[str] = []
        self.requests: list[str] = []
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")
        self.call("Emulation.setScrollbarsHidden", hidden=True)
        self.call(
            "Emulation.setEmulatedMedia",
            features=[{"name": "prefers-color-scheme", "value": "light"}],
        )

    def _wait_for_page(self, port_file: Path) -> str:
        """Wait until the browser has a page; return the address of its DevTools socket."""

        def is_ready() -> bool:
            assert self._process.poll() is None, "Chromium ended; see chromium.log"
            return port_file.exists() and "\n" in port_file.read_text()

        wait_for(is_ready, "that Chromium starts")
        port = port_file.read_text().split()[0]
        pages: list[str] = []

        def has_page() -> bool:
            with urlopen(f"http://127.0.0.1:{port}/json/list", timeout=HANG_S) as reply:
                targets = json.load(reply)
            pages.extend(target["webSocketDebuggerUrl"] for target in targets if target["type"] == "page")
            return bool(pages)

        wait_for(has_page, "Chromium's page")
        return pages[0]

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol and return its result. Events that come before it are processed."""
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=HANG_S))
            if answer.get("id") == self._count:
                if "navigated" in str(answer.get("error", "")):
                    raise NavigatedError(method)
                assert "error" not in answer, (method, answer["error"])
                return answer["result"]
            self._add_event(answer.get("method", ""), answer.get("params", {}))

    def _add_event(self, event: str, parameters: dict[str, Any]) -> None:
        """Record an event if it reports an error or a request."""
        if event == "Runtime.exceptionThrown":
            exception = parameters["exceptionDetails"].get("exception", {})
            self.errors.append(str(exception.get("description")))
        elif event == "Log.entryAdded" and parameters["entry"]["level"] == "error":
            entry = parameters["entry"]
            self.errors.append(f"{entry['text']} {entry.get('url', '')}")
        elif event == "Network.requestWillBeSent":
            self.requests.append(parameters["request"]["url"])

    def set_size(self, width: int, height: int, phone: bool) -> None:
        """The window's size in CSS pixels."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=2 if phone else 1,
            mobile=phone,
        )

    def open(self, url: str) -> None:
        """Go to a page."""
        self.call("Page.navigate", url=url)

    def visit(self, url: str, size: tuple[int, int, bool] = DESK) -> None:
        """Go to a page, and forget errors and requests of the previous one."""
        self.set_size(*size)
        # The browser does not load a page again whose address differs in the fragment (after #) only.
        self.open("about:blank")
        self.wait("location.href == 'about:blank'", "an empty page")
        self.errors.clear()
        self.requests.clear()
        self.open(url)

    def forget(self, address: str) -> None:
        """Delete tokens and cookies of an address: an earlier server may have had the same port."""
        self.call("Storage.clearDataForOrigin", origin=address, storageTypes="all")

    def fill(self, selector: str, text: str) -> None:
        """Type into a field, as a person does."""
        self.evaluate(
            f"(() => {{ const f = document.querySelector({json.dumps(selector)}); f.value = {json.dumps(text)};"
            " f.dispatchEvent(new Event('input', {bubbles: true})); })()"
        )

    def click(self, selector: str) -> None:
        """Press a button, once it is shown and enabled."""
        element = f"document.querySelector({json.dumps(selector)})"
        self.wait(f"{element}?.checkVisibility() && !{element}.disabled", f"that {selector} can be pressed")
        self.evaluate(f"{element}.click()")

    def check_whole(self, address: str) -> None:
        """Check that the page fits the window's width, has no errors, and has loaded nothing from another address."""
        assert self.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert self.errors == []
        assert all(url.startswith((address, "about:", "blob:")) for url in self.requests), self.requests

    def set_scheme(self, scheme: str) -> None:
        """Prefer `light` or `dark` colours."""
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        self.call("Emulation.setEmulatedMedia", features=features)

    def find_violations(self, axe: Path) -> list[list[str]]:
        """Rules of axe-core that the page breaks, each with the elements that break it."""
        # The checker is loaded once into each page. Finding a selector for each element would take longer than the
        # rules, so elements are shown as HTML.
        if not self.evaluate("'axe' in window"):
            self.evaluate(f"{axe.read_text(encoding='utf-8')}; 0")
        return self.evaluate(
            "axe.run({resultTypes: ['violations'], selectors: false})"
            ".then(result => result.violations.map(v => [v.id, ...v.nodes.map(node => node.html)]))"
        )

    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression in the page."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def read_text(self, element: str) -> str:
        """Return the text of the element with this id."""
        return self.evaluate(f"document.getElementById('{element}')?.innerText ?? ''")

    def wait(self, expression: str, what: str, limit_s: float = LIMIT_S) -> None:
        """Wait until a JavaScript expression is true in the page. `what` describes it in an error."""
        deadline = read_idle_s() + limit_s
        while not self._is_true(expression):
            assert read_idle_s() < deadline, f"not within {limit_s:g} s: {what}; it says {self.read_text('status')!r}"
            time.sleep(0.05)

    def _is_true(self, expression: str) -> bool:
        """True if an expression is true; False also while the browser goes to another page."""
        try:
            return bool(self.evaluate(f"Boolean({expression})"))
        except NavigatedError:
            return False

    def save_screenshot(self, path: Path) -> None:
        """The whole page as PNG."""
        answer = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=True)
        path.write_bytes(base64.b64decode(answer["data"]))

    @property
    def process_group(self) -> int:
        """Id of the group of all processes of the browser."""
        return self._process.pid

    def _end(self) -> None:
        """End all processes of the browser, also those whose parent has ended before them."""
        try:
            with suppress(ProcessLookupError):
                os.killpg(self.process_group, signal.SIGTERM)
            # It is killed if it has not ended after ten seconds.
            self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            pass
        finally:
            with suppress(ProcessLookupError):
                os.killpg(self.process_group, signal.SIGKILL)
            self._process.wait()
            self._log.close()

    def close(self) -> None:
        """End the browser."""
        self._stack.close()
        self._end()

    def __enter__(self) -> Browser:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
