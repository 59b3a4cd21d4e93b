"""Operations on pixels.

- Geometry: ``rays`` of pixels, ``footprint`` on the ground, ``coverage`` of stripes and edges in it.
- Pixels of a batch: ``select`` by a mask, in ``blocks`` or ``tiles``; ``canvas`` is what they are painted on.
- ``features`` lists what a batch of scenes has; ``colour`` and ``noise``.
"""
