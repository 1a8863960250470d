"""The operator's page: one web server for the catalogue, the live view and the results of scans.

`serve` shows all scans under a folder; a client with the token starts, controls and labels them. `preview` shows one.
Up to three processes (`server`): `door` accepts connections and answers commands to scans; it does not exist with
TLS or if nothing may be controlled, then `front` does both. It passes other requests to `front`, where each request
passes the access checks of `guard`; requests for other things than pages go to the reading process: `reading` answers
GET requests, `commands` POST requests; `site` holds their shared state. `programs` starts the programs that scan and
process, which continue without the server, and has the queue of waiting scans; `stage` homes and jogs the stage.

Threat model: docs/decisions/0014-operators-page.md.
"""

from polysight.serve.server import ServerAddress, preview, serve
