"""The work of the commands: each function takes settings or plain values and returns an exit status.

Entered by module, so that a command loads no more than it needs: `process` (images, materials), `batch` (many scans),
`live_scan` (a scan while it runs), `label` and `train`, `materials` (on saved products), `calibrate`, `devices` (cards
and radars), `recordings` (validate, inspect), `scans` (lists, notes, comparison, drop-raw), `demo`; `output` has
the functions that print. Commands print for people or, with `as_json`, for programs; libraries below them never do.
"""
