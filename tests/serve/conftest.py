"""Small scans to look at, and watches."""

from tests.support.page.fixtures import finished, growing, processed, samples, watching

__all__ = ["finished", "growing", "processed", "samples", "watching"]
