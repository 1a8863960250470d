"""`polysight calibrate`: what the rig is, measured with the rig: places, filters, metal, start frequencies."""
