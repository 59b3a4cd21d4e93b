"""The rendered road: textures, scene, camera, drive."""

from lanebev.render.frame import RenderedFrame
from lanebev.render.views import render_views

__all__ = ["RenderedFrame", "render_views"]
