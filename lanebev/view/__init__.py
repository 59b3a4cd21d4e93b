"""Resample images and maps to the bird's-eye ``grid`` and back.

``warp`` resamples images and feature maps to it, ``frame`` one image of bytes. ``paint`` resamples a map of
the road to the image, ``canonical`` an image as a fixed virtual camera would take it. ``matrices`` are those
of other programs. They share ``cells`` (of the grid), ``projection`` and ``lens`` (to the image), ``blocks``
and ``tiles`` (parts of a view), ``sampling``, ``checks``, ``reused_memory`` and ``thread_limits``.
"""
