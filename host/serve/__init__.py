"""The operator's page: one web server for the catalogue, the live view and the results of scans.

`serve` shows all scans under a folder, and starts, asks and labels them for who holds the token; `preview` shows one.
Requests pass `guard` (who may ask, from where, how much) and `connections` (how slowly). `reading` answers what is
looked at, `control` does what is asked; scans and processing run as programs of their own (`programs`), which outlive
this server. What it is safe against: docs/decisions/0014-operators-page.md.
"""

from polysight.host.serve.server import Place, preview, serve

__all__ = [
    "Place",
    "preview",
    "serve",
]
