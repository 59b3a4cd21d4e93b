"""The rendered road: scenes, their images and their ground truth.

Scenes are sampled on the CPU, the same on every machine; whole batches of them are rendered on any device.

``scene`` samples, ``raster`` computes images, ``truth`` the ground truth of a ``frame``, ``masks`` labels.
``views`` are independent; a ``drive`` has a ``course`` and a ``camera_motion``. ``rows`` selects of batches.
"""

from lanebev.render.drive import Drive
from lanebev.render.frame import RenderedFrame
from lanebev.render.masks import boundary_masks, draw_stripes
from lanebev.render.scene.camera.window import WindowConfig
from lanebev.render.views import render_views

__all__ = ["Drive", "RenderedFrame", "WindowConfig", "boundary_masks", "draw_stripes", "render_views"]
