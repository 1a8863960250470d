"""Small scans, and watches of them."""

from tests.support.page.fixtures import finished_scan, growing, processed_scans, samples, watching

__all__ = ["finished_scan", "growing", "processed_scans", "samples", "watching"]
