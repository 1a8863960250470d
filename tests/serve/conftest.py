"""Small scans to look at, watches, and a browser."""

from tests.support.page.fixtures import browser, finished, growing, processed, samples, watching

__all__ = ["browser", "finished", "growing", "processed", "samples", "watching"]
