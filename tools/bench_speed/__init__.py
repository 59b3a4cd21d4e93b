"""Time views, extractor and calibrators beside what others take for the same.

``python -m tools.bench_speed`` prints and writes the tables.
"""
