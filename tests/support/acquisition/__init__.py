"""A fake Pi with fake capture cards, and a model of late frames."""
