"""Radar samples from DCA1000 capture cards: control, reception, placement by byte count, decoding."""
