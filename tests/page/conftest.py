"""Fixtures: small scans, and watches, which follow a scan for the live view."""

from tests.support.page.fixtures import finished_scan, growing, samples, watching

__all__ = ["finished_scan", "growing", "samples", "watching"]
