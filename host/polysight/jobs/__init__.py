"""The work of the commands: each function takes settings or plain values and returns an exit status.

Import the modules, not this package, so that a command loads no more than it needs: `process` (images, materials),
`batch` (many scans), `live_scan` (a scan while it runs), `label` and `train`, `materials` (on saved products),
`calibrate`, `devices` (cards and radars), `recordings` (validate, inspect), `scans` (lists, notes, comparison,
drop-raw), `demo`; `output` has the functions that print. These commands print for people or, with `as_json`, for
programs; the packages that they use print nothing.
"""
