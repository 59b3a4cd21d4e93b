"""Lane segments with known truth, for tests and benchmarks."""
