"""A camera and its files.

- ``model`` is the camera, ``parameters`` its numbers with checks of their range, and ``plausibility`` remarks
  on unusual ones.
- ``files`` finds out the format of a file, whose syntax is read by ``parsing``, and ``choice`` takes one of
  several cameras. Formats: ``formats`` (OpenCV, ROS, our own) and ``several`` of these, ``datasets``,
  ``programs``, ``reconstruction``, ``records`` (JSON) and ``slam``. ``named_lens`` reads coefficients by
  name, and ``approximation`` finds the nearest lens of a model that we have.
"""

from lanebev.camera.model import Camera

__all__ = ["Camera"]
