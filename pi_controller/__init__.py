"""The Raspberry Pi half: stage link, trigger lines, row executor, journal, publisher. Imports no numpy."""
