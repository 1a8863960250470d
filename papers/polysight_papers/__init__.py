"""Reproductions of published papers with this instrument, one folder a paper."""
