"""The host half: capture -> store -> sync -> imaging -> polarimetry -> materials -> report.

`pipeline.py` is the whole flow on one screen. Every folder is a room: its `__init__` says what it takes and gives, and
neighbours import from there only (docs/decisions/0008-rooms.md).
"""
