"""The work of the commands: each function takes a typed request or plain values and returns an exit status.

Entered by module, so that a command loads no more than it needs: `process` (images, materials), `label` and `train`,
`batch` and its worker, `live_scan`, `demo`, `materials` (on saved products), `calibrate`, `cards`, `look` (validate,
inspect), `drop_raw`; `steps` shows progress. They print for people or, with `as_json`, for programs; libraries below
them never do.
"""
