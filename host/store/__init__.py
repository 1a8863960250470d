"""Scan folders: append-only, self-validating, resumable."""
