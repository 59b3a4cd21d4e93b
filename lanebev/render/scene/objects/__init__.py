"""What stands or drives beside and on the road: ``surroundings``, ``traffic`` and its ``objects``."""
