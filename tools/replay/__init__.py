"""Run recorded and generated drives through the calibrators and compare with committed references.

``python -m tools.replay`` compares; ``python -m tools.replay --write`` writes the references anew.
"""
