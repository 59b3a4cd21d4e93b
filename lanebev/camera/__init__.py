"""A camera and its files."""

from lanebev.camera.model import Camera

__all__ = ["Camera"]
