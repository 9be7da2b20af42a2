"""What a user writes: parameters, a physical system, a law, limits, and the design that joins them."""
