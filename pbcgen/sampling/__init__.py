"""The linearised loop over sample periods: transition matrices, scans with proof, periods that change."""
