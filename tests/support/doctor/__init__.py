"""Rigs and benches for the doctor."""
