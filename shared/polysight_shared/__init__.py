"""Code that host, Pi and simulators share. Pure Python: the Pi installs it without numpy.

Rig file: `config` declares it, `tables` reads and checks it, `raster` has the grid, the stage and the plan of rows,
`geometry` the positions of the antennas. Communication: `messages` between Pi and host over the sockets of `sockets`,
`stage_line` between Pi and stage, `faults` for their fault numbers, `wires` between simulated parts. General: `files`
reads files with a size limit, `errors` and `error_codes` hold the exceptions, `units` conversions. Import from the
modules; this package has no public names of its own.
"""

__version__ = "0.1.0"
