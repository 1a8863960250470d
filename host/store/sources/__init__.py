"""Where recorded rows come from: `open` recognises a folder, `published*` read the published data set as a `Source`."""
