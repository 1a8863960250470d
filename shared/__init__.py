"""The words both halves of the instrument speak. Pure Python: the Pi installs this without numpy."""

__version__ = "0.1.0"
