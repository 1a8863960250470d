"""Small scans, and watches of them."""

from tests.support.page.fixtures import finished, growing, samples, watching

__all__ = ["finished", "growing", "samples", "watching"]
