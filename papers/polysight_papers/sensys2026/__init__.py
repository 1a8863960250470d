"""Reproduction of the paper's tables and figures by simulation, beside the published values."""
