"""From radiance to an image.

``sensor`` combines ``effects`` before the ``glass``, ``exposure``, ``filters``, noise and ``jpeg``.
"""
