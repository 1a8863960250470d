"""The work of the commands: each function takes a typed request or plain values and returns an exit status.

Entered by module, so that a command loads no more than it needs: `process` (images, materials), `label` and `train`,
`batch` and its worker, `live_scan`, `demo`, `materials` and `classify` (on saved products), `calibrate`, `cards`,
`radar`, `recordings` (validate, inspect), `scans` (lists, notes, comparison), `phase_history`, `drop_raw`; `output`
has what they print with. They print for people or, with `as_json`, for programs; libraries below them never do.
"""
