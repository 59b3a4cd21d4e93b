"""A run's results in formats of other programs, a module for each."""
