"""The host half: capture -> store -> sync -> imaging -> polarimetry -> materials -> report."""
