"""Stand-ins for everything around the Pi's program, and the program as a process."""
