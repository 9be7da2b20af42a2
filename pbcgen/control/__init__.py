"""Claims about the closed loop: limits, stability, sample periods, regions; and the derivation that holds them all."""
