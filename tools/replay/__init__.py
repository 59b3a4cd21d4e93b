"""Recorded and generated drives through the calibrators, compared with committed references.

``python -m tools.replay`` compares; ``python -m tools.replay --write`` writes the references anew.
"""
