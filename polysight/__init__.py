"""See what things are made of: bistatic polarimetric SAR with commodity mmWave radars."""

from polysight.shared import __version__

__all__ = ["__version__"]
