"""Lenses and rays, angles and matrices, great circles, the road plane and points on it.

- Lens: ``distortion`` and its inverse, ``undistortion``; ``lens`` applies both to pixels of a batch.
- Road: ``rotation`` defines the signs of angles, ``road`` has the plane and points on it, ``road_profile``
  its height, ``vanishing_point`` that of the lanes, and ``focal`` the effect of the focal length on a pose.
- Numerics: ``linalg`` and ``precision``.
"""
