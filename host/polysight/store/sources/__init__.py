"""Layouts of recorded rows: `open` recognises a folder, `published*` read the published data set as a `Source`."""
