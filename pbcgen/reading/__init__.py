"""A second reading of a design, from the text that its hash is the hash of; it shares nothing with the first.

model     the text
system    the model as exact functions, at x* in balls, and its closed loop
sums      functions without negative values, as a certificate writes them
settings  what may be set at run time
sectors   loops with functions in sectors
overall   what holds on the whole space
velocity  mechanical systems in positions and velocities
"""
