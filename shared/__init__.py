"""What both halves of the instrument speak. Pure Python: the Pi installs this without numpy.

`config` is the rig file, checked by `tables`; `raster` the grid, the stage and the plan of rows; `geometry` where the
antennas are. `messages` go between Pi and host over `sockets`; `stage_line` goes to the stage, `faults` numbers what it
refuses; `wires` connects simulated parts; `files` reads what others made, within limits. `errors` are for people,
`units` for numbers. Import from the modules.
"""

__version__ = "0.1.0"
