"""The instruction tape of a CasADi expression, and what it is run over: exact functions, exact numbers and balls."""
