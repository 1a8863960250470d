"""Stand-ins for the stage, the wires and the host around the Pi's program, and the program itself as a process."""
