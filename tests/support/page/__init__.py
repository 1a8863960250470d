"""A browser, scans that grow on demand, and servers of the live view."""
