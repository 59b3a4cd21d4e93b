"""Names of the parts that can be exported. Imports nothing heavy."""

PARTS = ("segmenter", "extractor", "warp", "joint", "two-stage", "step", "speed")
