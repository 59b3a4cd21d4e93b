"""Lane segments with known truth, for tests and benchmarks.

``segments`` draws single frames. Drives are lists of ``moments``, with ``motions`` of the camera, the
difficulties of ``scenarios`` and ``streets``. ``experiment`` is the paper's. ``evaluation`` runs a calibrator
on a drive and computes statistics.
"""
