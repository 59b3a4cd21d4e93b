"""The content of scenes, sampled for whole batches.

``world`` puts everything together, by the ``kinds`` of road: the ``road``, ``objects`` beside and on it,
``places`` that change both, ``light`` and ``camera``. ``sampler`` has the randomness.
"""
