"""Simulators of stage, radars, capture cards and scenes. They import no host code, so that errors are not shared.

Programs: `rig` starts a whole simulated rig: `wires` (the hub for GPIO edges), `stage` or `uno` (the motion stage), and
`cards` (radars with capture cards). `polysight_simulators` itself writes the raw data of a scene without sockets.
Packages: `scene` (physics and file layouts), `cards`, `radars`, `stage`, `uno` (the firmware on an emulated board),
`gpio` (a GPIO chip for the Pi's program).
"""
