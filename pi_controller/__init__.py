"""The Raspberry Pi half: stage link, trigger lines, row executor, journal, publisher. Imports no numpy."""

PROGRAM = "/opt/polysight/venv/bin/polysight-pi"  # where install.sh puts it
AS_THE_SERVICE = f"as the service's user: `sudo -u polysight {PROGRAM} ...`"
