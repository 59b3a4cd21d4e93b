"""The default calibrator: one filter over pose, lane position, curvature and lane widths.

docs/method/joint.md defines it. Each of these uses those above it:

- ``config`` and ``frame_prior``: all settings, and the prior of a frame's parameters.
- ``measurement``: the measurement model, which is residuals of end points and their Jacobian.
- ``layout`` and ``state``: the filter's state vector, and what is kept from one frame to the next.
- ``motion``: the motion model, which is the state's transition and process noise.
- ``frame``: estimation from one frame alone, without a state before it.
- ``filter``: prediction, update and start of the state.
- ``output``: the calibration of a frame. ``smoother``: that of each frame from all frames of a drive.
- ``calibrator``: the module that passes a frame through all of these but the smoother.
"""
