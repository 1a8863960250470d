"""Small scans to look at, and watches."""

from tests.support.page.fixtures import finished, growing, samples, watching

__all__ = ["finished", "growing", "samples", "watching"]
