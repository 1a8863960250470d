"""Two processed scans of one scene, with other noise."""

from tests.support.page.fixtures import processed

__all__ = ["processed"]
