"""Stand-ins for everything that is not there. Their physics is their own: nothing here imports host code."""
