"""The content of scenes, sampled for whole batches.

- ``world`` puts everything together, by the ``kinds`` of road; ``sampler`` has the randomness.
- Road: ``alignment``, ``layout`` of the boundaries (``city_layout``, ``country``), ``pavement``, ``works``,
  ``winter``, ``tunnel``, and a ``street`` in a ``town`` with painted ``glyphs``.
- Beside and on it: ``surroundings``, ``traffic`` and other ``objects``.
- Light: ``weather`` and ``night``. Camera: ``camera``, ``window``, ``sensor``, ``glass``; ``varied`` cameras.
"""
