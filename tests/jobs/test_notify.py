"""The addressees in the rig file are notified of a scan's end; this does not disturb the scan, and is not recorded."""

import json
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

from polysight.jobs.live_scan import notify
from polysight_shared.config import Notify


def test_a_command_and_an_address_get_the_text(tmp_path: Path) -> None:
    """The text is one argument, and no shell interprets it."""
    received: list[dict[str, str]] = []

    class Hook(BaseHTTPRequestHandler):
        """Keeps the JSON of each request."""

        def do_POST(self) -> None:
            received.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(204)
            self.end_headers()

        def log_message(self, format: str, *args: object) -> None:
            pass

    script = tmp_path / "tell"
    script.write_text(f'#!/bin/sh\nprintf "%s|" "$@" > {tmp_path}/told\n')
    script.chmod(0o755)
    with HTTPServer(("127.0.0.1", 0), Hook) as server:
        thread = threading.Thread(target=server.handle_request)
        thread.start()
        settings = Notify(command=f"{script} 'two words'", url=f"http://127.0.0.1:{server.server_port}/hook")
        notify(settings, Path("scans/oak"), "failed", "the Pi is silent; $(rm -r x)")
        thread.join()
    assert (tmp_path / "told").read_text() == "two words|oak: the Pi is silent; $(rm -r x)|"
    assert received == [{"scan": "oak", "state": "failed", "text": "oak: the Pi is silent; $(rm -r x)"}]


def test_a_command_or_address_that_does_not_work_is_only_a_note(capsys) -> None:
    notify(Notify(command="/no/such/program", url="http://127.0.0.1:1/"), Path("oak"), "finished", "done")
    assert capsys.readouterr().err.count("note: notify.") == 2
