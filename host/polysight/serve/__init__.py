"""The operator's page: one web server for the catalogue, the live view and the results of scans.

`serve` shows all scans under a folder; a client with the token starts, controls and labels them. `preview` shows one.
Up to three processes (`server`): `door` accepts connections and answers commands to scans (with TLS, or where nothing
may be controlled, there is none, and `front` does both). It hands the rest to `front`, where each request passes the
access checks of `guard`; requests for other things than pages go to the reading process: `reading` answers GET
requests, `commands` POST requests; `site` holds their shared state. `programs` has what scans and processes, which
outlives the server, and the queue of scans that wait; `stage` homes and jogs the stage.

Threat model: docs/decisions/0014-operators-page.md.
"""

from polysight.serve.server import Place, preview, serve
