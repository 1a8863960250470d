"""Two processed scans of one scene, with other noise."""

from tests.support.page.fixtures import processed_scans

__all__ = ["processed_scans"]
