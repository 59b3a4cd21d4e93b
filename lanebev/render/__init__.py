"""The rendered road: textures, scene, camera, drive.

Rendering is on the CPU, in the workers of a data loader; frames go to a device as batches do.
"""

from lanebev.render.drive import Drive
from lanebev.render.frame import RenderedFrame
from lanebev.render.masks import boundary_masks, draw_stripes
from lanebev.render.scene.window import WindowConfig
from lanebev.render.views import render_views

__all__ = ["Drive", "RenderedFrame", "WindowConfig", "boundary_masks", "draw_stripes", "render_views"]
