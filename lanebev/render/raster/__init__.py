"""Images of scenes.

``paint`` gives the radiance of every pixel, made of ``road``, ``objects`` and ``light``; ``sensor`` makes an
image of it. ``base`` has the operations that all of them share.
"""
