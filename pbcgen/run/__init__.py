"""Compile the C, load it, simulate the closed loop and compare the two."""
