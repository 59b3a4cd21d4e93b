"""The content of scenes, sampled for whole batches.

``world`` puts everything together, by the ``kinds`` of road: the ``road``, ``objects`` beside and on it,
``places`` that change both, ``light`` and ``camera``. ``varied`` changes weather and camera of some kinds.
``sampler`` has the randomness.
"""
