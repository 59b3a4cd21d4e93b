"""From radiance to an image.

``sensor`` combines ``effects`` before the ``glass``, ``exposure``, ``filters`` and ``jpeg``, with
``randomness`` for the noise.
"""
