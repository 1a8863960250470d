"""A scan as row transactions between the host, the Pi and the capture cards."""
