"""Shared helpers: paths, rigs, scenes, processes, and stand-ins for devices. Import them as `tests.support`.

paths, rigs, scenes
    Paths; the published rig and changed ones; scene files small enough for a test.
processes, simulated_rig, killed_at
    Commands, in this process or as separate processes; the whole simulated rig as processes.
acquisition, capture, doctor, page, pi, radar, stage, store
    Stand-ins and helpers of the test folder of the same name, used by other folders too.

Nothing here is a test or a fixture: fixtures are in `tests/conftest.py` and in the `conftest.py` of each folder.
"""
