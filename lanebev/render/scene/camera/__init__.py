"""The camera: ``lens`` and pose, ``window`` of the image, ``sensor``, and ``glass`` before the lens."""
