"""Small scans to look at, watches, and a browser."""

from tests.support.page.fixtures import browser, finished, growing, samples, watching

__all__ = ["browser", "finished", "growing", "samples", "watching"]
