"""What the commands do: each function takes plain values and returns an exit status."""
