"""Claims for all positive values of the parameters."""
