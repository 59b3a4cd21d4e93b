"""The filter: prediction of the state to a frame, its update by the frame, and its start.

- ``prediction``: the state at the time of the frame.
- ``iterated_update``: the state with the frame, by ``lane_change`` (boundary indices), ``update`` (Kalman
  filter), ``evidence`` (process noise) and ``scatter`` (boundaries that are not parallel).
- ``status``: whether the frame supports the state.
- ``restart``: whether the state must start again, and ``start``: the state that starts.
- ``usual_pose``: how far a doubtful roll and height left what the drive has shown.
- ``speed``: the state with the vehicle's speed, if it is given.
"""
