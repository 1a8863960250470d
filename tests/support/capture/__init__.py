"""Simulated capture cards in this process; recordings made by formula."""
