"""The motion model: transition matrix and process noise covariance of the filter's state.

``low_pass`` has those of the pose, ``road`` those of the road's shape, and ``dynamics`` those of the whole
state.
"""
