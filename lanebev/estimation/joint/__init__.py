"""The default calibrator: one filter over pose, lane position, curvature and lane widths.

docs/method/joint.md defines it. ``calibrator`` passes a frame through these modules, in this order:

- ``observations``: segments as end points in pixels.
- ``prediction``: the state at the time of the frame, by ``dynamics``, ``low_pass`` (pose) and ``road``.
- ``iterated_update``: the state with the frame, by ``lane_change``, ``measurement`` (residuals on a
  ``road_curve``), ``robust`` (weights), ``update`` (Kalman filter), ``evidence`` (process noise) and
  ``scatter`` (boundaries that are not parallel).
- ``status``: whether the frame supports the state.
- ``restart``: whether the state must start again, by ``single_frame`` (``start_search``, ``frame_prior``) and
  ``start``.
- ``output``: the calibration that is given out.
- ``speed``: the state with the vehicle's speed, if it is given.

``config``, ``state`` and ``layout`` (indices of the state) serve all of them. ``averaging`` estimates the
pose of a single image by its ``readings`` (``reading_fit``, ``tempering``), ``smoother`` that of a drive from
all frames, and ``boundary_curves`` the curves of boundaries at a known pose.
"""
