"""The instruction tape of a CasADi expression and the arithmetics that run it: exact rationals and balls."""
