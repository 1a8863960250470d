"""Where recorded rows come from: our scan folders, and the published data set read as one."""
