"""The parts of a run on one drive, made from its settings.

``sources`` gives the frames, ``observers`` find boundaries, by a ``shared_network`` for several drives;
``build`` makes the camera, the observer and the calibrator. ``upside_down`` images are noticed.
"""
