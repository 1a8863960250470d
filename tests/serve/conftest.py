"""Small scans, and watches of them."""

from tests.support.page.fixtures import finished, growing, processed, samples, watching

__all__ = ["finished", "growing", "processed", "samples", "watching"]
