"""`polysight doctor`: the rig hop by hop, from the rig file to the direct path. One check, one file."""
