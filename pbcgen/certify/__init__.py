"""Certificates: witnesses for the claims, found with the prover's means and written for the checker."""
