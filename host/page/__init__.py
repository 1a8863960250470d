"""`polysight preview`: looks on at a scan, and never stands in its way (docs/decisions/0007-live-view.md)."""
