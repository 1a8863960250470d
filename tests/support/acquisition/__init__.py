"""A fake Pi, fake capture cards and late frames."""
