"""The tests of the instrument: one folder for each room of the code, and `support` for all of them."""
