"""Runs that are done in several steps.

``resume`` continues from a state, ``recovery`` after a run that was killed; ``smoothing`` passes over the
frames twice, ``part_observation`` runs the network on parts of long videos. ``source_changes`` notices files
that changed meanwhile.
"""
