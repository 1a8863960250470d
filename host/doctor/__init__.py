"""`polysight doctor`: the rig hop by hop, from the rig file to the direct path.

`walk.py` holds the order of the checks and what each of them needs; `check_host.py`, `check_pi.py` and
`check_capture.py` the checks; `bench.py` what they share.
"""
