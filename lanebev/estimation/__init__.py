"""Estimate the pose from line segments.

``calibrator`` is the interface of the two calibrators, ``joint`` and ``two_stage``, which use ``checks``,
``kalman`` and ``reasons``. ``tracker`` runs one of them over a drive, together with the estimator of the
``mount``, and ``still`` on single images. ``lane_width_prior`` has the lane width where none is given, and
``expected_view`` the point where lanes should meet in the next image.
"""
