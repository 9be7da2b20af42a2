"""Measurements that the documentation quotes; each script writes its table to ``benchmarks/results``."""
