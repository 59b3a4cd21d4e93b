"""Estimation from one frame alone, without a state before it.

``single_frame`` fits pose, offset and curvature from the starts that ``start_search`` finds, and ``bends``
averages a fit over straight and bent roads. For a single image, ``averaging`` averages the pose over its
``readings``, which ``reading_fit`` fits. ``boundary_curves`` fits the boundaries at a known pose.
"""
