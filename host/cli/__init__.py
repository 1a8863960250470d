"""`polysight`: the command line. It parses, and calls `polysight.host.jobs`."""
