"""The published method, plainly: what the instrument's processing is measured against.

Written from the paper's description (sections 5.2 and 6.1), not from the authors' code; their steps and sizes are
kept: a loop over positions, division by a reference chirp, 16,384-point transforms, two zoom transforms, and one
full-size convolution for each range bin and RX.
"""
