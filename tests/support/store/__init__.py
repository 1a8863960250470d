"""A scan without processes, and a disk that fails."""
