"""Find lane boundaries in images, as line segments.

An image passes these modules, in this order:

- ``frames``: the network's input.
- ``segmenter``: probability maps, by a ``resnet``.
- ``lines``: points on each boundary, by ``scans`` (rows and columns) and ``vertices`` (means of these).
- ``boundary_vertices``: the common output of all detectors; those of others come from ``polylines`` and
  ``boundary_order``.
- ``segments``: pairs of vertices, which calibrators take.

``boundary_detector`` combines network and extraction, also with a ``far_view``; ``paper_vertices`` has the
paper's own vertices.
"""
