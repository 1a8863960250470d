"""Rigs and contexts for the checks of `polysight doctor`."""
